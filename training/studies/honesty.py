"""Honesty: recordings as a stranger has them, with faults of a rig. Do the intervals hold what they should?

MuJoCo makes one short recording for each seed, without a stated noise, with one to three faults (lag, jitter of the
stamps, hinge or clamp, first shape, density, camera, lost or frozen frames, robot points, coarse mesh, start, a search
that is cut short). The command ``torchcloth identify`` fits every recording, as a stranger would. ``--compare`` runs
another installation of torchcloth on the same recordings, without and with the true noise stated. On some of them
``torchcloth pose`` estimates every vertex, whose standard errors are compared with the true places.

``--towel`` fits two recordings of a newcomer's towel instead. It hangs from a bar or from one corner as from a hinge.
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

import numpy as np

from torchcloth import recordings
from torchcloth._utils.constants import Z_95
from torchcloth._utils.files import to_json, write_atomically, write_text
from torchcloth.errors import InvalidInput
from torchcloth.identification.uncertainty.likely_reasons import REASONS_LEAD
from torchcloth.inspection.corrections import find_frozen_clouds

from ..resumable import ResumableStudy, check_jobs, write_result
from ..validation.independent.rig_recording import GRIP_RADIUS_M, MeshSize, RigRecording, make_rig_recording
from ..validation.independent.towel import TOWEL_CASES, TRUTH_NODES, make_towel_recording
from .fabric_tables import NO_VALUE, make_markdown_table, make_table
from .hidden_rates import Rate

RIG_COUNT, FAST_RIG_COUNT = 40, 2
POSE_COUNT, FAST_POSE_COUNT = 10, 1
FAST_SIZE, FAST_TOWEL_NODES = MeshSize(truth=13, fit=9, coarse=7), (13, 10)
PARAMETER_SYMBOLS = {"membrane_stiffness": "E h", "poisson_ratio": "ν", "bending.stiffness": "B", "air.normal": "C_n"}
MAX_STD_ERRORS = 3.0
THIS_VERSION, NOISE_STATED, POSE_CASE = "this version", "noise stated", "pose"
MAX_MESSAGE_CHARACTERS = 300
UNUSABLE_POSE_WORDS = "do not use this estimate"
REPORTED_FIT_ENTRIES = ("iterations", "simulations", "converged", "rms_after", "points_residual", "points_misfit")


def add(parser: argparse.ArgumentParser) -> None:
    """Add the study's options."""
    parser.add_argument("--rigs", type=int, metavar="N", help=f"recordings ({RIG_COUNT}; more can be added later)")
    parser.add_argument("--poses", type=int, metavar="N", help=f"recordings whose poses are estimated ({POSE_COUNT})")
    parser.add_argument("--first", type=int, default=0, metavar="SEED", help="seed of the first recording (0)")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="number of fits at a time (1)")
    parser.add_argument("--towel", action="store_true", help="two recordings of a newcomer's towel, and no rigs")
    parser.add_argument(
        "--compare",
        metavar="NAME=PYTHON",
        help="interpreter of another installation of torchcloth, which fits the same recordings",
    )


def run(options: argparse.Namespace) -> None:
    """Fit every recording that is missing; print and write the tables."""
    check_jobs(options.jobs)
    count = (FAST_RIG_COUNT if options.fast else RIG_COUNT) if options.rigs is None else options.rigs
    poses = (FAST_POSE_COUNT if options.fast else POSE_COUNT) if options.poses is None else options.poses
    if count < 1 or options.first < 0 or not 0 <= poses <= count:
        got = f"{count}, {options.first}, {poses}"
        expected = "1 or more; 0 or more; at most as many as rigs"
        raise InvalidInput("--rigs, --first, --poses", got=got, expected=expected)
    if options.towel:
        run_towels(options)
        return
    interpreters = {THIS_VERSION: sys.executable}
    if options.compare is not None:
        name, python = parse_comparison(options.compare)
        interpreters |= {name: python, f"{name}, {NOISE_STATED}": python}
    study = ResumableStudy(options.out, {"study": "honesty", "fast": options.fast})
    study.start()
    seeds = range(options.first, options.first + count)
    cases: dict[str, Callable[[], dict[str, Any]]] = {
        case_name(seed, name): partial(run_case, options.out, seed, options.fast, name, python)
        for seed in seeds
        for name, python in interpreters.items()
    }
    pose_seeds = seeds[:poses]
    cases |= {case_name(seed, POSE_CASE): partial(run_pose, options.out, seed, options.fast) for seed in pose_seeds}
    finished = study.run(cases, options.jobs)
    answers = {name: {seed: finished[case_name(seed, name)] for seed in seeds} for name in interpreters}
    pose_cases = {seed: finished[case_name(seed, POSE_CASE)] for seed in pose_seeds}
    print_tables(answers, pose_cases)
    path = write_result(options.out / "honesty.json", "honesty", {"answers": answers, "poses": pose_cases})
    write_text(options.out / "honesty.md", to_markdown(answers, pose_cases))
    print(f"result: {path}, {options.out / 'honesty.md'}")


def parse_comparison(text: str) -> tuple[str, str]:
    """Return name and interpreter of another installation, from NAME=PYTHON.

    Raises:
        InvalidInput: another form, or no such interpreter.
    """
    name, _, python = text.partition("=")
    if not name or not python or shutil.which(python) is None:
        raise InvalidInput("--compare", got=repr(text), expected="NAME=PYTHON, an interpreter")
    return name, python


def case_name(seed: int, version: str) -> str:
    """Return the name of a case."""
    return f"{seed:03d}, {version}"


def run_case(out: Path, seed: int, fast: bool, version: str, python: str) -> dict[str, Any]:
    """Make the recording of a seed if it is missing, and fit it with one installation of torchcloth."""
    episode, truth = find_or_make_recording(out, seed, fast)
    folder = out / "fits" / case_name(seed, version)
    return fit_recording(episode, truth, folder, version, python)


def fit_recording(
    episode: Path,
    truth: Mapping[str, Any],
    folder: Path,
    version: str,
    python: str = sys.executable,
    options: Sequence[str] = (),
) -> dict[str, Any]:
    """Fit a recording with one installation of torchcloth, and return what it says beside what is hidden.

    Args:
        episode: the recording's folder.
        truth: what is hidden.
        folder: of the fit.
        version: name of the installation.
        python: its interpreter.
        options: further options of ``identify``.
    """
    if version.endswith(NOISE_STATED):
        episode = _state_noise(episode, folder.with_name(f"{folder.name}-episode"), truth["noise_std"])
    shutil.rmtree(folder, ignore_errors=True)
    arguments = [*options, *([] if truth["iterations"] is None else ["--iterations", str(truth["iterations"])])]
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


def run_pose(out: Path, seed: int, fast: bool) -> dict[str, Any]:
    """Estimate the pose of a seed's recording, and compare every free vertex with its true place."""
    episode, truth = find_or_make_recording(out, seed, fast)
    folder = out / "poses" / f"{seed:03d}"
    shutil.rmtree(folder, ignore_errors=True)
    seconds, message = run_command(sys.executable, ["pose", str(episode), "--out", str(folder)])
    case = {"motion": truth["motion"], "faults": truth["faults"], "cpu_seconds": seconds}
    if not (folder / "pose.npz").exists():
        return {**case, "refused": message}
    warnings = json.loads((folder / "pose.json").read_text())["warnings"]
    recording = recordings.read(episode)
    true_vertices = np.load(out / "truth" / f"{seed:03d}.npy")
    with np.load(folder / "pose.npz") as pose:
        x, std, uncorrected = (pose[key].astype(float) for key in ("x", "std", "uncorrected"))
    if len(x) < len(true_vertices):  # a pose has no frames where clouds were frozen
        true_vertices = true_vertices[~find_frozen_clouds(recording.require("points"))]
    places = np.concatenate([np.asarray(grasp.uv) for grasp in recording.grasps.values()])
    uv = np.asarray(recording.cloth.uv)
    is_free = np.linalg.norm(uv[:, None] - places, axis=-1).min(1) > GRIP_RADIUS_M
    error, std = (x - true_vertices)[:, is_free], std[:, is_free]
    simulated = (uncorrected - true_vertices)[:, is_free]
    return {
        **case,
        "refused": "",
        "seconds_recorded": float(np.ptp(recording.require("points").t)),
        "rms": _rms(error),
        "rms_simulated": _rms(simulated),
        "std_rms": _rms(std),
        "coverage": float((np.abs(error) < Z_95 * std).mean()),
        "is_unusable": any(UNUSABLE_POSE_WORDS in warning for warning in warnings),
    }


def _rms(vectors: np.ndarray) -> float:
    """Root mean square length of vectors [..., 3]."""
    return float(np.sqrt(np.square(vectors).sum(-1).mean()))


def find_or_make_recording(out: Path, seed: int, fast: bool) -> tuple[Path, dict[str, Any]]:
    """Return the folder of a seed's recording, and what is hidden in it."""
    return _find_or_make(out, f"{seed:03d}", lambda: make_rig_recording(seed, FAST_SIZE if fast else None))


def _find_or_make(out: Path, name: str, make: Callable[[], RigRecording]) -> tuple[Path, dict[str, Any]]:
    episode = out / "episodes" / name
    truth_path = out / "truth" / f"{name}.json"
    if not (truth_path.exists() and truth_path.with_suffix(".npy").exists()):
        made = make()
        recordings.write(made.recording, episode, overwrite=True)
        truth_path.parent.mkdir(parents=True, exist_ok=True)
        with write_atomically(truth_path.with_suffix(".npy")) as part:
            np.save(part, made.vertices)
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


# -- the towel --------------------------------------------------------------------------------------------------------


def run_towels(options: argparse.Namespace) -> None:
    """Fit both recordings of the towel; print and write a table."""
    study = ResumableStudy(options.out, {"study": "honesty", "fast": options.fast})
    study.start()
    cases = {f"towel, {name}": partial(run_towel, options.out, name, options.fast) for name in TOWEL_CASES}
    finished = study.run(cases, options.jobs)
    print_towels(finished)
    print(f"result: {write_result(options.out / 'towel.json', 'honesty', finished)}")


def run_towel(out: Path, name: str, fast: bool) -> dict[str, Any]:
    """Make a recording of the towel if it is missing, and fit it; a second fit takes its bench as exact."""
    nodes = FAST_TOWEL_NODES if fast else TRUTH_NODES
    episode, truth = _find_or_make(out, f"towel-{name}", partial(make_towel_recording, name, nodes=nodes))
    folder = out / "fits" / f"towel-{name}"
    case = fit_recording(episode, truth, folder, THIS_VERSION)
    exact_folder = folder.with_name(f"{folder.name}-exact")
    exact = fit_recording(episode, truth, exact_folder, THIS_VERSION, options=["--exact-bench"])
    return {**case, "exact": exact, "reasons": named_reasons(exact.get("warnings", []))}


def named_reasons(warnings: Sequence[str]) -> str:
    """Return what a fit says would explain its misfit, without the remedy; empty where it says nothing."""
    statements = [warning.partition(REASONS_LEAD)[2] for warning in warnings]
    return next(filter(None, statements), "").partition(";")[0]


def print_towels(cases: Mapping[str, Mapping[str, Any]]) -> None:
    """Print the ratio to the truth of every number with its interval, and the reasons that are named."""
    from rich.console import Console
    from rich.markup import escape

    table = make_table(
        "Ratio to the truth where identifiable, with its 95 % interval",
        *("case", "faults", *PARAMETER_SYMBOLS.values(), "CPU s"),
        left=2,
    )
    for name, case in cases.items():
        faults = ", ".join(f"{fault} {size}" for fault, size in case["faults"].items())
        ratios = [_ratio_with_interval(case, parameter) for parameter in PARAMETER_SYMBOLS]
        table.add_row(*map(escape, (name, faults, *ratios, f"{case['cpu_seconds']:.0f}")))
    console = Console(highlight=False)
    console.width = max(console.width, 120)
    console.print(table)
    for name, case in cases.items():
        console.print(
            escape(f"{name}, reasons named with --exact-bench: {case['reasons'] or NO_VALUE}"), soft_wrap=True
        )


def _ratio_with_interval(case: Mapping[str, Any], name: str) -> str:
    e, truth = case["parameters"].get(name), case["truth"][name]
    if e is None or not e["identifiable"]:
        return "refused" if case["refused"] else NO_VALUE
    low, high = (end / truth for end in e["ci95"])
    return f"{e['value'] / truth:.2f} [{low:.2f}, {high:.2f}]" + ("" if low <= 1 <= high else " !")


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


POSE_HEADINGS = (
    "seed",
    "motion",
    "faults",
    "recorded, s",
    "simulated, mm",
    "estimate, mm",
    "std. error, mm",
    "in 95 %",
    "CPU s",
)


def _pose_rows(poses: Mapping[int, Mapping[str, Any]]) -> list[tuple[str, ...]]:
    rows = []
    for seed, case in poses.items():
        first = (str(seed), case["motion"], ", ".join(f"{fault} {size}" for fault, size in case["faults"].items()))
        numbers = ("refused", *[NO_VALUE] * 4)
        if not case["refused"]:
            lengths = (f"{1e3 * case[key]:.2f}" for key in ("rms_simulated", "rms", "std_rms"))
            coverage = "says: not to be used" if case["is_unusable"] else f"{100 * case['coverage']:.0f} %"
            numbers = (f"{case['seconds_recorded']:.1f}", *lengths, coverage)
        rows.append((*first, *numbers, f"{case['cpu_seconds']:.0f}"))
    return rows


def print_tables(answers: Answers, poses: Mapping[int, Mapping[str, Any]]) -> None:
    """Print the summary, every number, and the poses."""
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
    pose_table = make_table("Distance of vertices from the truth, root mean square", *POSE_HEADINGS, left=3)
    for row in _pose_rows(poses):
        pose_table.add_row(*map(escape, row))
    for part in (summary, table, pose_table):
        console.print(part)


def to_markdown(answers: Answers, poses: Mapping[int, Mapping[str, Any]]) -> str:
    """Return the tables as Markdown."""
    parts = (
        make_markdown_table(SUMMARY_HEADINGS, summarise(answers), 1),
        case_table(answers),
        make_markdown_table(POSE_HEADINGS, _pose_rows(poses), 3),
    )
    return "\n".join(parts)


def case_table(answers: Answers) -> str:
    """Return the table of every number as Markdown."""
    return make_markdown_table(CASE_HEADINGS, _case_rows(answers), 4)
