"""The table and the progress in the terminal."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

from .assessment import UNMET_VERDICTS, TableLine

VERDICT_COLOURS = {
    "pass": "green",
    "missed": "bold red",
    "failed": "bold red",
    "finding": "cyan",
}


class ProgressReport:
    """Shows which case runs, and prints one line when it is finished."""

    def __init__(self, progress: Progress, total: int) -> None:
        self._progress, self._task = progress, progress.add_task("", total=total)

    def start_case(self, name: str) -> None:
        """Show the name of the case that runs."""
        self._progress.update(self._task, description=name)

    def finish_case(self, name: str, lines: Sequence[TableLine], seconds: float | None) -> None:
        """Print the worst verdict of a case and its CPU time; None: its outcome was stored."""
        worst = next((line.verdict for line in lines if line.verdict in UNMET_VERDICTS), "pass")
        time = "finished before" if seconds is None else f"{seconds:.1f} s of CPU"
        self._progress.console.print(f"{name:28} [{VERDICT_COLOURS[worst]}]{worst:8}[/] {time}", highlight=False)
        self._progress.advance(self._task)


@contextmanager
def show_progress(total: int) -> Iterator[ProgressReport]:
    """Show a progress bar over ``total`` cases."""
    columns = (
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=_console(), transient=True) as progress:
        yield ProgressReport(progress, total)


def print_table(lines: Sequence[TableLine]) -> None:
    """Print the table of all figures."""
    table = Table("case", "", "measured", "truth", "error", "tolerance", "", title="Verification")
    last = None
    for line in lines:
        name = line.case if line.case != last else ""
        if last is not None and name:
            table.add_section()
        last = line.case
        verdict = f"[{VERDICT_COLOURS[line.verdict]}]{line.verdict}[/]"
        table.add_row(name, line.label, line.measured, line.truth, line.error, line.tolerance, verdict)
    _console().print(table)


def _console() -> Console:
    console = Console()
    return console if console.is_terminal else Console(width=150)
