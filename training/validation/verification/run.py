"""``make verify``: run every case, print one table, write the page.

The exit code is 1 when a tolerance is missed, 2 on bad usage.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch

from .assessment import UNMET_VERDICTS, TableLine, assess_outcome, failed_line
from .registry import CASES, Case
from .result_store import ResultStore

REPOSITORY = Path(__file__).resolve().parents[3]


def main(argv: Sequence[str] | None = None, cases: Mapping[str, Case] | None = None) -> int:
    """Run the cases that ``argv`` names, and return the exit code.

    Args:
        argv: of the command line; None: the process's.
        cases: replace the registered ones.
    """
    if cases is None:
        from . import all_cases  # noqa: F401 - registers the cases

        cases = CASES
    options = _parse(argv, cases)
    if options.list:
        for case in cases.values():
            print(f"{case.name:28} {case.title}{'' if case.fast else '  (not in --fast)'}")
        return 0
    torch.set_default_dtype(torch.float64)
    torch.set_num_threads(1)
    chosen = [c for c in cases.values() if c.name in options.only] if options.only else list(cases.values())
    if options.fast:
        chosen = [c for c in chosen if c.fast]
    lines = _run(chosen, ResultStore(options.out, options.fast, options.resume, options.fresh))
    if not options.only and not options.fast:
        _publish(options.out, options.docs)
    missed = sorted({line.case for line in lines if line.verdict in UNMET_VERDICTS})
    print(f"missed: {', '.join(missed)}" if missed else f"all {len(chosen)} cases meet their tolerances")
    return 1 if missed else 0


def _parse(argv: Sequence[str] | None, cases: Mapping[str, Case]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="make verify", description=__doc__)
    parser.add_argument("--only", nargs="+", metavar="NAME", default=[], help="these cases (--list names them)")
    parser.add_argument("--list", action="store_true", help="name the cases and stop")
    parser.add_argument("--fast", action="store_true", help="coarser, and without the long cases")
    parser.add_argument("--out", type=Path, default=REPOSITORY / "out/verification", help="results, pictures and page")
    parser.add_argument(
        "--docs", type=Path, default=REPOSITORY / "docs/validation", help="folder for the page of a complete run"
    )
    again = parser.add_mutually_exclusive_group()
    again.add_argument("--fresh", action="store_true", help="use no stored outcome")
    again.add_argument(
        "--resume",
        action="store_true",
        help="use stored outcomes of your own even if the library has changed since",
    )
    options = parser.parse_args(argv)
    unknown = [name for name in options.only if name not in cases]
    if unknown:
        parser.error(f"unknown case {', '.join(unknown)}; --list names them")
    return options


def _run(chosen: Sequence[Case], store: ResultStore) -> list[TableLine]:
    """Run what is not stored yet; table, pictures and page are written even if a case fails."""
    from . import console_table, report_page
    from .case_figures import draw_case

    reports: list[report_page.CaseReport] = []
    with console_table.show_progress(len(chosen)) as progress:
        for case in chosen:
            progress.start_case(case.name)
            start, note, has_picture, was_stored = time.process_time(), "", False, False
            try:
                outcome, was_stored = store.get_or_run(case)
                lines, note = assess_outcome(case, outcome), outcome.note
                has_picture = draw_case(case, outcome, store.folder)
            except Exception as error:  # a case that breaks must not hide the others
                lines = failed_line(case, f"{type(error).__name__}: {error}".splitlines()[0])
            reports.append(report_page.CaseReport(case, note, lines, has_picture))
            progress.finish_case(case.name, lines, None if was_stored else time.process_time() - start)
    all_lines = [line for report in reports for line in report.lines]
    console_table.print_table(all_lines)
    report_page.write_page(reports, store.folder)
    return all_lines


def _publish(out: Path, docs: Path) -> None:
    """Copy the page and its pictures, and delete pictures of former cases."""
    pictures = docs / "verification"
    shutil.rmtree(pictures, ignore_errors=True)
    pictures.mkdir(parents=True)
    shutil.copy(out / "verification.md", docs)
    for picture in sorted((out / "verification").glob("*.png")):
        shutil.copy(picture, pictures)


if __name__ == "__main__":
    sys.exit(main())
