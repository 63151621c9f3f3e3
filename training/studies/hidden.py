"""Hidden effects: another engine hides one in recordings, ``torchcloth diagnose`` answers, then the truth is revealed.

One process makes a case. Another diagnoses it and gets only the episodes. A third reveals the truth after the answer is
on disk (validation.hidden). Sealed cases are drawn from a secret. Thresholds are tuned on other cases.
"""

from __future__ import annotations

import argparse
import json
import os
import secrets
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from torchcloth._utils.files import PROGRESS_FOLDER_NAME, write_text
from torchcloth.diagnosis.experiment.motions import list_experiments, measure_heading
from torchcloth.errors import InvalidInput
from torchcloth.recordings import read

from ..resumable import ResumableStudy
from ..validation.hidden import case_sampling
from ..validation.independent import motions
from . import hidden_archive, hidden_tables
from .hidden_gain import relative_gain
from .hidden_scores import is_resolved, observable_effects, score_case

DEFAULT_CASES = 60
# For the tests, seeds of sealed cases on which thresholds were tuned: a null and two hard ones, added mass and a hem,
# both large, a misplaced camera, and the four faults.
FAST_SEEDS = tuple(10_089_647_160 + k for k in (0, 4, 5, 11, 68, 15, 18, 38, 58, 78))
REFUSED_EXIT_CODE = 2
ANSWER_FILE = "diagnosis.json"
# Exit codes of an interrupted process, and of one that was ended by others. Other codes are failures of the program.
STOPPED_EXIT_CODES = (130, *(-s for s in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGKILL)))
MAX_ERROR_LINES = 20  # stored lines of an error
HEADINGS_DEG = (0.0, 90.0, 180.0, 270.0)  # of random experiments


class Round(NamedTuple):
    """Cases of a round.

    Attributes:
        seeds: by the case's name.
        fast: small cases.
        settings: of the study.
    """

    seeds: dict[str, int]
    fast: bool
    settings: dict[str, Any]


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options of the study."""
    parser.add_argument(
        "--cases", type=int, metavar="N", help=f"number of cases ({DEFAULT_CASES}; more can be added later)"
    )
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="number of cases at a time (1)")
    which = parser.add_mutually_exclusive_group()
    which.add_argument(
        "--seed", type=int, metavar="SECRET", help="secret from which sealed cases are drawn (default: a new one)"
    )
    which.add_argument("--dev", action="store_true", help="cases for development, on which thresholds may be tuned")
    which.add_argument(
        "--answers",
        type=Path,
        nargs="+",
        metavar="ROUND",
        help="only score finished rounds again, each one and all together: archives "
        "(docs/validation/blind-rounds/answers) or folders of the study",
    )


def run(options: argparse.Namespace) -> None:
    """Make, diagnose and reveal the missing cases; print and write hidden.json and hidden.md."""
    if options.answers:
        rounds = score_rounds(options)
        report(options.out, [{**c, "name": f"{name}/{c['name']}"} for name, cases in rounds.items() for c in cases])
        every = [case for cases in rounds.values() for case in cases]
        tables = hidden_tables.tabulate_rounds(rounds), hidden_tables.tabulate_effects(every)
        write_text(options.out / "rounds.md", "\n\n".join(tables) + "\n")
        write_text(options.out / "rounds.csv", hidden_tables.rounds_csv(rounds))
        print(f"all rounds: {options.out / 'rounds.md'}, {options.out / 'rounds.csv'}")
        return
    chosen = draw_round(options)
    study = ResumableStudy(options.out, chosen.settings)
    study.start()
    work: dict[str, Callable[[], dict[str, Any]]] = {
        name: partial(run_case, options.out, name, seed, chosen.fast) for name, seed in chosen.seeds.items()
    }
    report(options.out, [score_answer(name, case) for name, case in study.run(work, options.jobs).items()])


def report(out: Path, cases: Sequence[Mapping[str, Any]]) -> None:
    """Print tables of scored cases and write them to files."""
    out.mkdir(parents=True, exist_ok=True)
    write_text(out / "hidden.json", json.dumps(cases, indent=1, allow_nan=False, ensure_ascii=False) + "\n")
    write_text(out / "hidden.md", hidden_tables.to_markdown(cases))
    hidden_tables.print_tables(cases)
    print(f"result: {out / 'hidden.json'}, {out / 'hidden.md'}")


def score_rounds(options: argparse.Namespace) -> dict[str, list[dict[str, Any]]]:
    """Score finished rounds with today's scores; return the cases by the round's name, sorted by date."""
    if options.fast or options.cases is not None or options.jobs != 1:
        raise InvalidInput("--answers", got="with --fast, --cases or --jobs", expected="alone: no case is drawn")
    if (options.out / "study.json").exists():
        raise InvalidInput("--out", got=f"{options.out}, which holds a round", expected="a folder for the tables")
    rounds = [hidden_archive.read_round(path) for path in options.answers]
    names = [r.name for r in rounds]
    if len(set(names)) < len(names):
        raise InvalidInput("--answers", got=f"rounds named {', '.join(names)}", expected="rounds of different names")
    rounds.sort(key=lambda r: (not r.date, r.date))  # folders have no date and stay in the given order
    try:
        return {r.name: [score_answer(name, case) for name, case in r.cases.items()] for r in rounds}
    except (ValueError, LookupError, TypeError, AttributeError) as error:
        raise InvalidInput("--answers", got=f"{error!r}", expected="cases as `hidden` writes them") from None


def draw_round(options: argparse.Namespace) -> Round:
    """Draw the cases that the options ask for. The secret is read from the folder's study.json if there is one."""
    fixed = options.fast and options.seed is None and not options.dev
    usual = len(FAST_SEEDS) if fixed else DEFAULT_CASES
    count = usual if options.cases is None else options.cases
    for option, number in (("--cases", count), ("--jobs", options.jobs)):
        if number < 1:
            raise InvalidInput(option, got=number, expected="1 or more")
    if options.seed is not None and options.seed < 0:
        raise InvalidInput("--seed", got=options.seed, expected="0 or more")
    if fixed:
        secret, seeds = "fixed", list(FAST_SEEDS)[:count]
        if count > usual:
            raise InvalidInput("--cases", got=count, expected=f"at most {usual}", remedy="or --seed")
    elif options.dev:
        secret, seeds = None, list(range(count))
        if count > case_sampling.DEVELOPMENT_SEEDS:
            raise InvalidInput(
                "--cases", got=count, expected=f"at most {case_sampling.DEVELOPMENT_SEEDS} for development"
            )
    else:
        secret = _secret(options)
        seeds = case_sampling.draw_sealed_seeds(secret, count)
    settings = {"study": "hidden", "secret": secret, "fast": options.fast}
    return Round({f"{k:03d}": seed for k, seed in enumerate(seeds, 1)}, options.fast, settings)


def _secret(options: argparse.Namespace) -> int:
    if options.seed is not None:
        return options.seed
    try:
        secret = json.loads((options.out / "study.json").read_text())["secret"]
    except (FileNotFoundError, NotADirectoryError, ValueError, LookupError, TypeError):
        secret = None  # a damaged file is refused by its next reader
    return secret if isinstance(secret, int) else secrets.randbits(48)


def run_case(out: Path, name: str, seed: int, fast: bool) -> dict[str, Any]:
    """Make, diagnose and reveal one case."""
    episodes, answer = out / "episodes" / name, out / "answers" / name
    make = partial(_run_program, "make_case", "--seed", str(seed), *(["--fast"] if fast else []))
    given = _parse_episodes(make("--out", str(episodes)))
    begun = time.perf_counter()
    # The duration of a resumed diagnosis is not known.
    was_stopped = (answer / PROGRESS_FOLDER_NAME).exists() or (answer / ANSWER_FILE).exists()
    content = diagnose_episodes(given, answer)
    spent = None if was_stopped else round(time.perf_counter() - begun, 1)
    # The truth is revealed only after the answer.
    truth = json.loads(_run_program("reveal_truth", "--seed", str(seed), *(["--fast"] if fast else [])))
    schema = hidden_archive.CURRENT_SCHEMA
    case = {"schema": schema, "truth": truth, "answer": content, "seconds": spent, "gain": None}
    if truth["family"] == "next experiment":
        case["next"] = answer_after_experiments(out, name, make, given, content, seed)
    if truth["family"] in ("single", "double") and not fast:
        case["gain"] = _compute_gain(out, name, make, given, content, truth)
    if truth["family"] in ("single", "double", "outside") and not fast:
        case["sizes"] = json.loads(_run_program("visibility", "--seed", str(seed)))
    return case


def answer_after_experiments(
    out: Path, name: str, make: Callable[..., str], given: list[Path], answer: Mapping[str, Any], seed: int
) -> dict[str, Any]:
    """Return the answers after the proposed experiment and after a random one; None if none was proposed."""
    proposed = answer.get("next_experiment")
    if not proposed:
        return {"proposed": None, "random": None}
    rng = np.random.default_rng([seed, 17])
    motion, heading = str(rng.choice(motions.MOTION_NAMES)), float(rng.choice(HEADINGS_DEG))
    random = {"motion": motion, "heading": heading, "speed": 1.0}
    answers = {}
    for which, plan in (("proposed", rotate_heading(proposed, given)), ("random", random)):
        folder = out / "episodes" / f"{name}-{which}"
        asked = [part for key in random if plan.get(key) is not None for part in (f"--{key}", str(plan[key]))]
        more = _parse_episodes(make(*asked, "--out", str(folder)))
        answers[which] = diagnose_episodes([*given, *more], out / "answers" / f"{name}-{which}")
    return answers


def rotate_heading(plan: Mapping[str, Any], given: Sequence[Path]) -> dict[str, Any]:
    """Return an experiment with its heading from the world's x axis, not from the heading of the repeated episode."""
    template = next(r for e, r in list_experiments([read(path) for path in given]) if e.motion == plan["motion"])
    return {**plan, "heading": plan["heading"] + float(np.rad2deg(measure_heading(template)))}


def _compute_gain(
    out: Path, name: str, make: Callable[..., str], given: list[Path], answer: Mapping[str, Any], truth: Mapping
) -> float | None:
    """Return the gain of the answer relative to the oracle's; 0 if there is no answer."""
    if not answer.get("model"):
        return 0.0
    (unseen,) = _parse_episodes(make("--unseen", "--out", str(out / "episodes" / f"{name}-unseen")))
    named, folder = {cause["effect"] for cause in answer["causes"]}, out / "answers" / name
    return relative_gain(given, folder / str(answer["base"]), folder / str(answer["model"]), named, unseen, truth)


def _parse_episodes(output: str) -> list[Path]:
    """Return the episodes that make_case prints. The folder may also contain leftovers of a stopped run."""
    return sorted(Path(line.rpartition(": ")[0]) for line in output.splitlines())


def diagnose_episodes(episodes: list[Path], out: Path) -> dict[str, Any]:
    """Return what ``torchcloth diagnose`` writes, or how it ended instead.

    An answer on disk is never replaced, because its truth may already be revealed.
    """
    begun = (out / PROGRESS_FOLDER_NAME).exists()
    if (out / ANSWER_FILE).exists() and not begun:
        return json.loads((out / ANSWER_FILE).read_text())
    command = [sys.executable, "-m", "torchcloth.cli", "diagnose", *map(str, episodes), "--out", str(out)]
    command.append("--no-checks")  # a clock that is off is one of the hidden effects
    done = _run([*command, "--resume"] if begun else command)
    if begun and done.returncode == REFUSED_EXIT_CODE:  # another version of the program wrote the journal
        shutil.rmtree(out / PROGRESS_FOLDER_NAME)
        done = _run(command)
    if done.returncode in STOPPED_EXIT_CODES:  # stopped by the user, or by the system if memory ran out: not an answer
        raise KeyboardInterrupt
    if done.returncode == 0:
        return json.loads((out / ANSWER_FILE).read_text())
    lines, ending = done.stderr.strip().splitlines() or ["nothing"], "failed"
    if done.returncode == REFUSED_EXIT_CODE:
        ending = "refused"
    answer: dict[str, Any] = {ending: lines[-1], "stderr": lines[-MAX_ERROR_LINES:]}
    out.mkdir(parents=True, exist_ok=True)
    write_text(out / ANSWER_FILE, json.dumps(answer) + "\n")
    return answer


def _run_program(name: str, *arguments: str) -> str:
    """Return the output of a program of validation.hidden."""
    done = _run([sys.executable, "-m", f"torchcloth.training.validation.hidden.{name}", *arguments])
    if done.returncode:
        raise InvalidInput(f"validation.hidden.{name} {' '.join(arguments)}", got=done.stderr.strip()[-300:])
    return done.stdout


def _run(command: list[str]) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    return subprocess.run(command, capture_output=True, text=True, env=environment, check=False)


def score_answer(name: str, case: Mapping[str, Any]) -> dict[str, Any]:
    """Return a case with its scores, as the tables need it."""
    truth, later = case["truth"], case.get("next")
    rest: dict[str, Any] = {key: case.get(key) for key in ("seconds", "gain")}
    if rest["gain"] is not None and not case["answer"].get("causes"):
        rest["gain"] = 0.0  # an effect that is not named gains nothing; rounds up to b3f2eda counted it
    rest["are_observable"] = observable_effects(truth, case.get("sizes"))
    if later is not None:
        asked = later["proposed"] is not None
        was_resolved = is_resolved(truth, case["answer"])
        rest["resolved"] = None if was_resolved else asked and is_resolved(truth, later["proposed"])
        rest["random_resolved"] = None if later["random"] is None else is_resolved(truth, later["random"])
    sealed = {"seed": truth["seed"], "sealed": truth["sealed"] and truth["seed"] not in FAST_SEEDS}
    return {"name": name, **sealed, **score_case(truth, case["answer"]), **rest}
