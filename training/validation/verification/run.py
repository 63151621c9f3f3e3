"""``make verify``: run every case, print one table, write the page.

Exit code 1 when a mark is missed, 2 on bad usage.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch

from .assessment import OPEN, Line, lines, unfinished
from .registry import CASES, Case, NotThere
from .result_store import Results

ROOT = Path(__file__).resolve().parents[3]


def main(argv: Sequence[str] | None = None, cases: Mapping[str, Case] | None = None) -> int:
    """Run the cases that ``argv`` names (``cases`` replaces the registered ones); returns the exit code."""
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
    table = _run(chosen, Results(options.out, options.fast, options.resume, options.fresh))
    if not options.only and not options.fast:
        _publish(options.out, options.docs)
    missed = sorted({line.case for line in table if line.verdict in OPEN})
    print(f"missed: {', '.join(missed)}" if missed else f"all {len(chosen)} cases meet their marks")
    return 1 if missed else 0


def _parse(argv: Sequence[str] | None, cases: Mapping[str, Case]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="make verify", description=__doc__)
    parser.add_argument("--only", nargs="+", metavar="NAME", default=[], help="these cases (--list names them)")
    parser.add_argument("--list", action="store_true", help="name the cases and stop")
    parser.add_argument("--fast", action="store_true", help="coarser, and without the long cases")
    parser.add_argument("--out", type=Path, default=ROOT / "out/verification", help="results, pictures and page")
    parser.add_argument("--docs", type=Path, default=ROOT / "docs/validation", help="where a complete run puts the page")
    again = parser.add_mutually_exclusive_group()
    again.add_argument("--fresh", action="store_true", help="use no finished case of an earlier run")
    again.add_argument(
        "--resume",
        action="store_true",
        help="use finished cases even if the library changed since (they must be yours)",
    )
    options = parser.parse_args(argv)
    unknown = [name for name in options.only if name not in cases]
    if unknown:
        parser.error(f"unknown case {', '.join(unknown)}; --list names them")
    return options


def _run(chosen: Sequence[Case], results: Results) -> list[Line]:
    """Run what is not finished yet; table, pictures and page go out even when some case fails."""
    from . import console_table, report_page
    from .case_figures import draw

    found: list[tuple[Case, str, list[Line], bool]] = []
    with console_table.progress(len(chosen)) as report:
        for case in chosen:
            report.begin(case.name)
            start, note, picture = time.process_time(), "", False
            try:
                outcome, reused = results.get(case)
                rows, note = lines(case, outcome), outcome.note
                picture = draw(case, outcome, results.folder)
            except NotThere as error:
                rows, reused = unfinished(case, "absent", str(error)), False
            except Exception as error:  # a case that breaks must not hide the others
                rows, reused = unfinished(case, "failed", f"{type(error).__name__}: {error}".splitlines()[0]), False
            found.append((case, note, rows, picture))
            report.end(case.name, rows, None if reused else time.process_time() - start)
    console_table.show([line for _, _, rows, _ in found for line in rows])
    report_page.write(found, results.folder)
    return [line for _, _, rows, _ in found for line in rows]


def _publish(out: Path, docs: Path) -> None:
    """Copy the page and its pictures; pictures of cases that are no more go away."""
    pictures = docs / "verification"
    shutil.rmtree(pictures, ignore_errors=True)
    pictures.mkdir(parents=True)
    shutil.copy(out / "verification.md", docs)
    for picture in sorted((out / "verification").glob("*.png")):
        shutil.copy(picture, pictures)


if __name__ == "__main__":
    sys.exit(main())
