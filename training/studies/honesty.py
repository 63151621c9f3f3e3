"""Honesty: recordings as a stranger has them, with faults of a rig. Do the intervals hold what they should?

MuJoCo makes one short recording for each seed, without a stated noise, with one to three faults (lag, jitter of the
stamps, hinge or clamp, first shape, density, camera, lost or frozen frames, robot points, coarse mesh, start, a search
that is cut short). The command ``torchcloth identify`` fits every recording, as a stranger would. ``--compare`` runs
another installation of torchcloth on the same recordings, without and with the true noise stated.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from torchcloth import recordings
from torchcloth._utils.files import to_json, write_text
from torchcloth.errors import InvalidInput

from ..resumable import ResumableStudy, check_jobs, write_result
from ..validation.independent.rig_recording import MeshSize, make_rig_recording
from .fabric_tables import NO_VALUE, make_table
from .hidden_rates import Rate

RIGS, FAST_RIGS = 40, 2
FAST_SIZE = MeshSize(truth=13, fit=9, coarse=7)
PARAMETER_SYMBOLS = {"membrane_stiffness": "E h", "poisson_ratio": "ν", "bending.stiffness": "B", "air.normal": "C_n"}
MAX_STD_ERRORS = 3.0
THIS_VERSION, NOISE_STATED = "this version", "noise stated"
MAX_MESSAGE_CHARACTERS = 300
REPORTED_FIT_ENTRIES = ("iterations", "simulations", "converged", "rms_after", "points_residual", "points_misfit")


def add(parser: argparse.ArgumentParser) -> None:
    """Add the study's options."""
    parser.add_argument("--rigs", type=int, metavar="N", help=f"number of recordings ({RIGS}; more can be added later)")
    parser.add_argument("--first", type=int, default=0, metavar="SEED", help="seed of the first recording (0)")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="number of fits at a time (1)")
    parser.add_argument(
        "--compare",
        metavar="NAME=PYTHON",
        help="interpreter of another installation of torchcloth, which fits the same recordings",
    )


def run(options: argparse.Namespace) -> None:
    """Fit every recording that is missing; print and write the tables."""
    check_jobs(options.jobs)
    count = (FAST_RIGS if options.fast else RIGS) if options.rigs is None else options.rigs
    if count < 1 or options.first < 0:
        raise InvalidInput("--rigs, --first", got=f"{count}, {options.first}", expected="1 or more; 0 or more")
    interpreters = {THIS_VERSION: sys.executable}
    if options.compare is not None:
        name, _, python = options.compare.partition("=")
        if not name or not python or shutil.which(python) is None:
            raise InvalidInput("--compare", got=repr(options.compare), expected="NAME=PYTHON, an interpreter")
        interpreters |= {name: python, f"{name}, {NOISE_STATED}": python}
    study = ResumableStudy(options.out, {"study": "honesty", "fast": options.fast})
    study.start()
    seeds = range(options.first, options.first + count)
    cases: dict[str, Callable[[], dict[str, Any]]] = {
        case_name(seed, name): partial(run_case, options.out, seed, options.fast, name, python)
        for seed in seeds
        for name, python in interpreters.items()
    }
    finished = study.run(cases, options.jobs)
    answers = {name: {seed: finished[case_name(seed, name)] for seed in seeds} for name in interpreters}
    print_tables(answers)
    path = write_result(options.out / "honesty.json", "honesty", {"answers": answers})
    write_text(options.out / "honesty.md", to_markdown(answers))
    print(f"result: {path}, {options.out / 'honesty.md'}")


def case_name(seed: int, version: str) -> str:
    """Return the name of a case."""
    return f"{seed:03d}, {version}"


def run_case(out: Path, seed: int, fast: bool, version: str, python: str) -> dict[str, Any]:
    """Make the recording of a seed if it is missing, and fit it with one installation of torchcloth."""
    episode, truth = find_or_make_recording(out, seed, fast)
    folder = out / "fits" / case_name(seed, version)
    if version.endswith(NOISE_STATED):
        episode = _state_noise(episode, folder.with_name(f"{folder.name}-episode"), truth["noise_std"])
    shutil.rmtree(folder, ignore_errors=True)
    arguments = [] if truth["iterations"] is None else ["--iterations", str(truth["iterations"])]
    seconds, message = run_command(python, ["identify", str(episode), "--out", str(folder), *arguments])
    case = {**truth, "cpu_seconds": seconds}
    try:
        fit = json.loads((folder / "identification.json").read_text())
    except FileNotFoundError:
        return {**case, "refused": message, "parameters": {}}
    keys = ("value", "std", "ci95", "identifiable")
    fitted = {name: {key: e[key] for key in keys} for name, e in fit["parameters"].items() if name in truth["truth"]}
    return {
        **case,
        "refused": "",
        "parameters": fitted,
        "fit": {key: fit["fit"].get(key) for key in REPORTED_FIT_ENTRIES},
        "warnings": fit["warnings"],
    }


def find_or_make_recording(out: Path, seed: int, fast: bool) -> tuple[Path, dict[str, Any]]:
    """Return the folder of a seed's recording, and what is hidden in it."""
    episode = out / "episodes" / f"{seed:03d}"
    truth_path = out / "truth" / f"{seed:03d}.json"
    if not truth_path.exists():
        made = make_rig_recording(seed, FAST_SIZE if fast else None)
        recordings.write(made.recording, episode, overwrite=True)
        truth_path.parent.mkdir(parents=True, exist_ok=True)
        hidden = {"motion": made.motion, "faults": made.faults, "truth": made.truth}
        write_text(truth_path, to_json({**hidden, "noise_std": made.noise_std, "iterations": made.iterations}))
    return episode, json.loads(truth_path.read_text())


def _state_noise(episode: Path, copy: Path, std: float) -> Path:
    """Write a copy of an episode that states its noise."""
    shutil.copytree(episode, copy, dirs_exist_ok=True)
    description = json.loads((copy / "episode.json").read_text())
    (copy / "episode.json").write_text(json.dumps({**description, "observation_noise": {"std": std}}))
    return copy


def run_command(python: str, arguments: Sequence[str]) -> tuple[float, str]:
    """Run a command of torchcloth in one thread; return its seconds of a core, and its last words on stderr."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    command = [python, "-m", "torchcloth.cli", *arguments]
    process = subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, env=environment, cwd="/"
    )
    assert process.stderr is not None
    message = process.stderr.read()
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode not in (0, 2):
        raise InvalidInput(
            " ".join(command), got=f"exit code {process.returncode}: {message[-MAX_MESSAGE_CHARACTERS:]}"
        )
    return used.ru_utime + used.ru_stime, message.strip()[-MAX_MESSAGE_CHARACTERS:]


# -- scores -----------------------------------------------------------------------------------------------------------

Answers = Mapping[str, Mapping[int, Mapping[str, Any]]]  # version -> seed -> case


def identified_numbers(cases: Mapping[int, Mapping[str, Any]]) -> list[tuple[float, bool]]:
    """Return error over standard error, and whether the interval holds the truth, of each identifiable number."""
    out = []
    for case in cases.values():
        for name, e in case["parameters"].items():
            if e["identifiable"]:
                truth, (low, high) = case["truth"][name], e["ci95"]
                out.append(((e["value"] - truth) / e["std"], low <= truth <= high))
    return out


def summarise(answers: Answers) -> list[tuple[str, ...]]:
    """Return a row for each version."""
    rows = []
    for name, cases in answers.items():
        numbers = identified_numbers(cases)
        holds = Rate(sum(hold for _, hold in numbers), len(numbers))
        far = Rate(sum(abs(z) > MAX_STD_ERRORS for z, _ in numbers), len(numbers))
        asked = sum(len(case["truth"]) for case in cases.values())
        refused = sum(bool(case["refused"]) for case in cases.values())
        seconds = sum(case["cpu_seconds"] for case in cases.values())
        row = (f"{len(numbers)} of {asked}", _format(holds), _format(far), str(refused), f"{seconds:.0f}")
        rows.append((name, str(len(cases)), *row))
    return rows


def _format(rate: Rate) -> str:
    if rate.bounds is None or rate.share is None:
        return NO_VALUE
    low, high = rate.bounds
    return f"{rate.hits} of {rate.of} = {100 * rate.share:.0f} % ({100 * low:.0f} to {100 * high:.0f})"


SUMMARY_HEADINGS = (
    "version",
    "recordings",
    "identifiable",
    "95 % intervals that hold the truth",
    "more than 3 standard errors off",
    "refused",
    "CPU s",
)
CASE_HEADINGS = ("seed", "motion", "faults", "version", *PARAMETER_SYMBOLS.values(), "CPU s")


def _case_rows(answers: Answers) -> list[tuple[str, ...]]:
    """Return the ratio to the truth of every number; brackets where it is not identifiable."""
    rows = []
    for seed in next(iter(answers.values())):
        for k, (name, cases) in enumerate(answers.items()):
            case = cases[seed]
            faults = ", ".join(f"{fault} {size}" for fault, size in case["faults"].items())
            first = (str(seed), case["motion"], faults) if k == 0 else ("", "", "")
            ratios = [_ratio(case, parameter) for parameter in PARAMETER_SYMBOLS]
            rows.append((*first, name, *ratios, f"{case['cpu_seconds']:.0f}"))
    return rows


def _ratio(case: Mapping[str, Any], name: str) -> str:
    e, truth = case["parameters"].get(name), case["truth"][name]
    if e is None:
        return "refused" if case["refused"] else NO_VALUE
    if not e["identifiable"]:
        return NO_VALUE
    holds = e["ci95"][0] <= truth <= e["ci95"][1]
    return f"{e['value'] / truth:.2f} ± {e['std'] / truth:.2f}" + ("" if holds else " !")


def print_tables(answers: Answers) -> None:
    """Print the summary and every number."""
    from rich.console import Console
    from rich.markup import escape

    console = Console(highlight=False)
    console.width = max(console.width, 190)
    summary = make_table("Numbers that are called identifiable", *SUMMARY_HEADINGS, left=1)
    for row in summarise(answers):
        summary.add_row(*map(escape, row))
    table = make_table(
        "Ratio to the truth where identifiable; !: the interval does not hold it", *CASE_HEADINGS, left=4
    )
    for row in _case_rows(answers):
        table.add_row(*map(escape, row))
    console.print(summary)
    console.print(table)


def to_markdown(answers: Answers) -> str:
    """Return both tables as Markdown."""

    def table(headings: Sequence[str], rows: Sequence[Sequence[str]], left: int) -> str:
        rule = ["---" if k < left else "---:" for k in range(len(headings))]
        return "".join(f"| {' | '.join(line)} |\n" for line in (headings, rule, *rows))

    return table(SUMMARY_HEADINGS, summarise(answers), 1) + "\n" + table(CASE_HEADINGS, _case_rows(answers), 4)
