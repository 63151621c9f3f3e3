"""The table and the progress in the terminal."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

from .assessment import OPEN, Line

COLOURS = {"pass": "green", "missed": "bold red", "absent": "bold yellow", "failed": "bold red", "finding": "cyan"}


class Report:
    """Says which case runs, and one line when it is done."""

    def __init__(self, progress: Progress, total: int) -> None:
        self._progress, self._task = progress, progress.add_task("", total=total)

    def begin(self, name: str) -> None:
        self._progress.update(self._task, description=name)

    def end(self, name: str, rows: Sequence[Line], seconds: float | None) -> None:
        worst = next((line.verdict for line in rows if line.verdict in OPEN), "pass")
        took = "finished before" if seconds is None else f"{seconds:.1f} s of CPU"
        self._progress.console.print(f"{name:28} [{COLOURS[worst]}]{worst:8}[/] {took}", highlight=False)
        self._progress.advance(self._task)


@contextmanager
def progress(total: int) -> Iterator[Report]:
    columns = (
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=_console(), transient=True) as shown:
        yield Report(shown, total)


def show(lines: Sequence[Line]) -> None:
    """Print the table."""
    table = Table("case", "", "measured", "truth", "error", "mark", "", title="Verification")
    last = None
    for line in lines:
        name = line.case if line.case != last else ""
        if last is not None and name:
            table.add_section()
        last = line.case
        verdict = f"[{COLOURS[line.verdict]}]{line.verdict}[/]"
        table.add_row(name, line.label, line.measured, line.truth, line.error, line.mark, verdict)
    _console().print(table)


def _console() -> Console:
    console = Console()
    return console if console.is_terminal else Console(width=150)
