"""The command ``python -m torchcloth.training.validation.trials``: run the tests of all trials, write the table."""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from xml.etree import ElementTree

from torchcloth._utils.files import write_text

from .table import BASE_COMMIT, TRIALS, Trial

TESTS_FOLDER = Path("tests")  # of the repository
WHOLE_FILE = "*"
ALL_OF_FILE = f"::{WHOLE_FILE}"
NOT_TESTED, MET, PARTLY, FAILED, SKIPPED = "not tested here", "met", "partly met", "**not met**", "skipped"
KINDS = {
    "A": "Wrong answers that look right",
    "B": "Crashes and tracebacks",
    "C": "Trust",
    "D": "What recorders leave behind",
}
HEAD = f"""# Trials by strangers

**Question.** What do strangers' habits and hostile inputs break?

**Method.** Each line was tried at {BASE_COMMIT}: public reports of users of similar software, a newcomer's trial with
her own arm and camera, and an attack on every reader. The tests of a line hold its input, or the smallest one of its
kind. Most run several cases: the same check with other inputs of that kind. *met (13 cases)* says that 13 cases ran,
and that all of them showed what the column *now* says; *partly met* says that the column *now* is less than what the
user asked for. One command runs the tests and writes this page:

    python -m torchcloth.training.validation.trials --out docs/validation/trials.md
"""


def main(argv: list[str] | None = None) -> int:
    """Run the command, and return its exit code: 0, or 1 if a line is not met, or 2 for wrong input."""
    parser = argparse.ArgumentParser(
        prog="python -m torchcloth.training.validation.trials",
        description="Run the tests of every trial, and print the table. Exit code: 0, 1 a test failed, 2 wrong input.",
    )
    parser.add_argument("--out", type=Path, metavar="FILE", help="also write the page as Markdown")
    options = parser.parse_args(argv)
    if not TESTS_FOLDER.is_dir():
        print("trials: no folder tests; run it at the root of the repository", file=sys.stderr)
        return 2
    outcomes = run_tests(TRIALS)
    page = to_markdown(TRIALS, outcomes)
    print(page)
    if options.out is not None:
        try:
            write_text(options.out, page)
        except OSError as error:
            print(f"trials: {error}", file=sys.stderr)
            return 2
    return int(any(describe_result(trial, outcomes).startswith(FAILED) for trial in TRIALS))


def run_tests(trials: Sequence[Trial]) -> dict[str, list[str]]:
    """Run the tests of all trials in one process.

    Returns:
        Outcomes of the cases of each test, by its file and function: "passed", "failed" or "skipped".
    """
    names = dict.fromkeys(name.removesuffix(ALL_OF_FILE) for trial in trials for name in trial.tests)
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.xml"
        options = ["-q", "-p", "no:cacheprovider", "-m", "not gpu", f"--junitxml={report}"]
        command = [sys.executable, "-m", "pytest", *options, *(str(TESTS_FOLDER / name) for name in names)]
        environment = {"OMP_NUM_THREADS": "1", **os.environ}
        subprocess.run(command, stdout=sys.stderr, env=environment)
        cases = ElementTree.parse(report).getroot().iter("testcase") if report.is_file() else ()
        outcomes: defaultdict[str, list[str]] = defaultdict(list)
        for case in cases:
            file = case.get("classname", "").removeprefix(f"{TESTS_FOLDER}.").replace(".", "/") + ".py"
            children = {child.tag for child in case}
            outcome = "failed" if children & {"failure", "error"} else "skipped" if "skipped" in children else "passed"
            for name in (case.get("name", "").partition("[")[0], WHOLE_FILE):
                outcomes[f"{file}::{name}"].append(outcome)
    return dict(outcomes)


def describe_result(trial: Trial, outcomes: Mapping[str, Sequence[str]]) -> str:
    """Return whether a line is met, and by how many cases of its tests."""
    if not trial.tests:
        return NOT_TESTED
    missing = [name for name in trial.tests if not outcomes.get(name)]
    results = [outcome for name in trial.tests for outcome in outcomes.get(name, ())]
    if missing or "failed" in results:
        return f"{FAILED} ({results.count('failed')} of {len(results)} fail, {len(missing)} tests are missing)"
    passed = results.count("passed")
    counted = f"{passed} case{'s' if passed > 1 else ''}"
    return f"{PARTLY if trial.is_partial else MET} ({counted})" if passed else SKIPPED


def to_markdown(trials: Sequence[Trial], outcomes: Mapping[str, Sequence[str]]) -> str:
    """Format the page with the table of each kind."""
    results = {trial.id: describe_result(trial, outcomes) for trial in trials}
    parts = [HEAD, "**Result.** Tests lie in `tests/`.\n"]
    for letter, title in KINDS.items():
        rows = [trial for trial in trials if trial.id.startswith(letter)]
        parts.append(f"## {letter}. {title}\n")
        parts.append(f"| id | input | at {BASE_COMMIT} | now | result | tests |\n|---|---|---|---|---|---|")
        parts += [
            f"| {t.id} | {t.tried} | {t.before} | {t.now} | {results[t.id]} | "
            f"{'<br>'.join(f'`{name.removesuffix(ALL_OF_FILE)}`' for name in t.tests) or '–'} |"
            for t in rows
        ]
        parts.append("")
    met = sum(result.startswith(MET) for result in results.values())
    others = ", ".join(id for id, result in results.items() if not result.startswith(MET))
    end = f"**Conclusion.** {met} of {len(trials)} lines are met"
    parts.append(f"{end}. Met in part, not met, or not tested here: {others}.\n" if others else f"{end}.\n")
    return "\n".join(parts)
