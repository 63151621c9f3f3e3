"""Hidden effects: another engine hides one in recordings, ``torchcloth diagnose`` answers, then the truth is opened.

Each case is made by a process of its own, diagnosed by another that gets the episodes alone, and revealed by a third
once the answer is on disk (validation.hidden). Sealed cases are drawn from a secret; the program is tuned on others.
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
from .hidden_gain import gain
from .hidden_scores import judged, shows, told_apart

CASES = 60
# for the tests, numbers of sealed ones that thresholds have seen: a null and two hard ones, added mass and a hem, both
# large, a camera that stands elsewhere, and the four faults
FAST = tuple(10_089_647_160 + k for k in (0, 4, 5, 11, 68, 15, 18, 38, 58, 78))
REFUSED = 2  # exit code
ANSWER = "diagnosis.json"
# exit codes of who was stopped, or ended by others; a crash of its own is an answer that failed
STOPPED = (130, *(-s for s in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGKILL)))
LINES = 20  # of an error that are kept
HEADINGS = (0.0, 90.0, 180.0, 270.0)  # degrees, of random experiments


class Round(NamedTuple):
    """Which cases, and how large."""

    seeds: dict[str, int]  # by the case's name
    fast: bool
    settings: dict[str, Any]


def add(parser: argparse.ArgumentParser) -> None:
    """Options."""
    parser.add_argument("--cases", type=int, metavar="N", help=f"how many ({CASES}; more may be added later)")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="cases at a time (1)")
    which = parser.add_mutually_exclusive_group()
    which.add_argument(
        "--seed", type=int, metavar="SECRET", help="that sealed cases are drawn from (default: a new one)"
    )
    which.add_argument("--dev", action="store_true", help="cases for development, on which thresholds may be tuned")
    which.add_argument(
        "--answers",
        type=Path,
        nargs="+",
        metavar="ROUND",
        help="only score finished rounds again, each and all together: archives (docs/validation/blind-rounds/answers) or study folders",
    )


def run(options: argparse.Namespace) -> None:
    """Make, diagnose and reveal what is missing, then print and write hidden.json and hidden.md."""
    if options.answers:
        rounds = score_rounds(options)
        report(options.out, [{**c, "name": f"{name}/{c['name']}"} for name, cases in rounds.items() for c in cases])
        every = [case for cases in rounds.values() for case in cases]
        tables = hidden_tables.beside(rounds), hidden_tables.by_effect(every)
        write_text(options.out / "rounds.md", "\n\n".join(tables) + "\n")
        write_text(options.out / "rounds.csv", hidden_tables.rounds_csv(rounds))
        print(f"all rounds: {options.out / 'rounds.md'}, {options.out / 'rounds.csv'}")
        return
    chosen = drawn(options)
    study = ResumableStudy(options.out, chosen.settings)
    study.start()
    work: dict[str, Callable[[], dict[str, Any]]] = {
        name: partial(one, options.out, name, seed, chosen.fast) for name, seed in chosen.seeds.items()
    }
    report(options.out, [scored(name, case) for name, case in study.run(work, options.jobs).items()])


def report(out: Path, cases: Sequence[Mapping[str, Any]]) -> None:
    """Tables of judged cases, on the terminal and in files."""
    out.mkdir(parents=True, exist_ok=True)
    write_text(out / "hidden.json", json.dumps(cases, indent=1, allow_nan=False, ensure_ascii=False) + "\n")
    write_text(out / "hidden.md", hidden_tables.markdown(cases))
    hidden_tables.show(cases)
    print(f"result: {out / 'hidden.json'}, {out / 'hidden.md'}")


def score_rounds(options: argparse.Namespace) -> dict[str, list[dict[str, Any]]]:
    """Score the cases of finished rounds as they are scored today; by the round's name, in the order of their dates."""
    if options.fast or options.cases is not None or options.jobs != 1:
        raise InvalidInput("--answers", got="with --fast, --cases or --jobs", expected="alone: no case is drawn")
    if (options.out / "study.json").exists():
        raise InvalidInput("--out", got=f"{options.out}, which holds a round", expected="a folder for the tables")
    rounds = [hidden_archive.read_round(path) for path in options.answers]
    names = [r.name for r in rounds]
    if len(set(names)) < len(names):
        raise InvalidInput("--answers", got=f"rounds named {', '.join(names)}", expected="rounds of different names")
    rounds.sort(key=lambda r: (not r.date, r.date))  # folders have no date, and stay in the order given
    try:
        return {r.name: [scored(name, case) for name, case in r.cases.items()] for r in rounds}
    except (ValueError, LookupError, TypeError, AttributeError) as error:
        raise InvalidInput("--answers", got=f"{error!r}", expected="cases as `hidden` writes them") from None


def drawn(options: argparse.Namespace) -> Round:
    """The cases that were asked for; a folder remembers its secret."""
    fixed = options.fast and options.seed is None and not options.dev
    usual = len(FAST) if fixed else CASES
    count = usual if options.cases is None else options.cases
    for option, number in (("--cases", count), ("--jobs", options.jobs)):
        if number < 1:
            raise InvalidInput(option, got=number, expected="1 or more")
    if options.seed is not None and options.seed < 0:
        raise InvalidInput("--seed", got=options.seed, expected="0 or more")
    if fixed:
        secret, seeds = "fixed", list(FAST)[:count]
        if count > usual:
            raise InvalidInput("--cases", got=count, expected=f"at most {usual}", remedy="or --seed")
    elif options.dev:
        secret, seeds = None, list(range(count))
        if count > case_sampling.DEVELOPMENT_SEEDS:
            raise InvalidInput("--cases", got=count, expected=f"at most {case_sampling.DEVELOPMENT_SEEDS} for development")
    else:
        secret = _secret(options)
        seeds = case_sampling.draw_sealed_seeds(secret, count)
    settings = {"study": "hidden", "secret": secret, "fast": options.fast}
    return Round({f"{k:03d}": seed for k, seed in enumerate(seeds, 1)}, options.fast, settings)


def _secret(options: argparse.Namespace) -> int:
    if options.seed is not None:
        return options.seed
    try:
        found = json.loads((options.out / "study.json").read_text())["secret"]
    except (FileNotFoundError, NotADirectoryError, ValueError, LookupError, TypeError):
        found = None  # a damaged one is refused by who reads it next
    return found if isinstance(found, int) else secrets.randbits(48)


def one(out: Path, name: str, seed: int, fast: bool) -> dict[str, Any]:
    """One case from making to revealing."""
    episodes, answer = out / "episodes" / name, out / "answers" / name
    make = partial(_script, "make_case", "--seed", str(seed), *(["--fast"] if fast else []))
    given = _made(make("--out", str(episodes)))
    begun = time.perf_counter()
    stopped = (answer / PROGRESS_FOLDER_NAME).exists() or (answer / ANSWER).exists()  # and what it took before is not known
    found = answered(given, answer)
    spent = None if stopped else round(time.perf_counter() - begun, 1)
    # only now
    truth = json.loads(_script("reveal_truth", "--seed", str(seed), *(["--fast"] if fast else [])))
    schema = hidden_archive.CURRENT_SCHEMA
    case = {"schema": schema, "truth": truth, "answer": found, "seconds": spent, "gain": None}
    if truth["family"] == "next experiment":
        case["next"] = experiments(out, name, make, given, found, seed)
    if truth["family"] in ("single", "double") and not fast:
        case["gain"] = _gain(out, name, make, given, found, truth)
    if truth["family"] in ("single", "double", "outside") and not fast:
        case["sizes"] = json.loads(_script("visibility", "--seed", str(seed)))
    return case


def experiments(
    out: Path, name: str, make: Callable[..., str], given: list[Path], answer: Mapping[str, Any], seed: int
) -> dict[str, Any]:
    """Answers after the experiment that was proposed, and after a random one; None where none was proposed."""
    proposed = answer.get("next_experiment")
    if not proposed:
        return {"proposed": None, "random": None}
    rng = np.random.default_rng([seed, 17])
    drawn = {"motion": str(rng.choice(motions.MOTION_NAMES)), "heading": float(rng.choice(HEADINGS)), "speed": 1.0}
    found = {}
    for which, plan in (("proposed", turned(proposed, given)), ("random", drawn)):
        folder = out / "episodes" / f"{name}-{which}"
        asked = [part for key in drawn if plan.get(key) is not None for part in (f"--{key}", str(plan[key]))]
        more = _made(make(*asked, "--out", str(folder)))
        found[which] = answered([*given, *more], out / "answers" / f"{name}-{which}")
    return found


def turned(plan: Mapping[str, Any], given: Sequence[Path]) -> dict[str, Any]:
    """An experiment with its heading from the world's x, which is not where the episode that it repeats begins."""
    template = next(r for e, r in list_experiments([read(path) for path in given]) if e.motion == plan["motion"])
    return {**plan, "heading": plan["heading"] + float(np.rad2deg(measure_heading(template)))}


def _gain(
    out: Path, name: str, make: Callable[..., str], given: list[Path], answer: Mapping[str, Any], truth: Mapping
) -> float | None:
    """Of the answer, over the oracle's; 0 of one that is none."""
    if not answer.get("model"):
        return 0.0
    (unseen,) = _made(make("--unseen", "--out", str(out / "episodes" / f"{name}-unseen")))
    named, folder = {cause["effect"] for cause in answer["causes"]}, out / "answers" / name
    return gain(given, folder / str(answer["base"]), folder / str(answer["model"]), named, unseen, truth)


def _made(said: str) -> list[Path]:
    """The episodes that make_case names; what a stopped one has left lies in the same folder."""
    return sorted(Path(line.rpartition(": ")[0]) for line in said.splitlines())


def answered(episodes: list[Path], out: Path) -> dict[str, Any]:
    """What ``torchcloth diagnose`` writes, or how it ended instead. What is written stays: its truth may be open."""
    begun = (out / PROGRESS_FOLDER_NAME).exists()
    if (out / ANSWER).exists() and not begun:
        return json.loads((out / ANSWER).read_text())
    command = [sys.executable, "-m", "torchcloth.cli", "diagnose", *map(str, episodes), "--out", str(out)]
    done = _run([*command, "--resume"] if begun else command)
    if begun and done.returncode == REFUSED:  # another version of the program left it
        shutil.rmtree(out / PROGRESS_FOLDER_NAME)
        done = _run(command)
    if done.returncode in STOPPED:  # by who stops the study, or the system for want of memory: that is no answer
        raise KeyboardInterrupt
    if done.returncode == 0:
        return json.loads((out / ANSWER).read_text())
    said = done.stderr.strip().splitlines() or ["nothing"]
    answer: dict[str, Any] = {"refused" if done.returncode == REFUSED else "failed": said[-1], "stderr": said[-LINES:]}
    out.mkdir(parents=True, exist_ok=True)
    write_text(out / ANSWER, json.dumps(answer) + "\n")
    return answer


def _script(name: str, *arguments: str) -> str:
    """Output of a program of validation.hidden."""
    done = _run([sys.executable, "-m", f"torchcloth.training.validation.hidden.{name}", *arguments])
    if done.returncode:
        raise InvalidInput(f"validation.hidden.{name} {' '.join(arguments)}", got=done.stderr.strip()[-300:])
    return done.stdout


def _run(command: list[str]) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    return subprocess.run(command, capture_output=True, text=True, env=environment, check=False)


def scored(name: str, case: Mapping[str, Any]) -> dict[str, Any]:
    """Return a case as the tables have it."""
    truth, later = case["truth"], case.get("next")
    rest: dict[str, Any] = {key: case.get(key) for key in ("seconds", "gain")}
    if rest["gain"] is not None and not case["answer"].get("causes"):
        rest["gain"] = 0.0  # what an answer does not name counts for nothing: in rounds up to b3f2eda it did
    rest["shows"] = shows(truth, case.get("sizes"))
    if later is not None:
        asked = later["proposed"] is not None
        needless = told_apart(truth, case["answer"])
        rest["resolved"] = None if needless else asked and told_apart(truth, later["proposed"])
        rest["random_resolved"] = None if later["random"] is None else told_apart(truth, later["random"])
    sealed = {"seed": truth["seed"], "sealed": truth["sealed"] and truth["seed"] not in FAST}
    return {"name": name, **sealed, **judged(truth, case["answer"]), **rest}
