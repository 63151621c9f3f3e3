"""Strangers' benches: three commands make an episode and a fit of the files of a bench. Are the answers right?

MuJoCo moves a sheet for each seed: on a bar, by two corners or by one corner. A Kinect or a stereo camera is rendered,
with arms, table and wall. Two to four things are off: the grip, and lag, jitter, camera, gripper, mass, lost or frozen
frames. The files are written as a stranger has them. ``torchcloth new``, ``inspect`` and ``identify`` make a fit of
them. ``--compare`` lets the ``identify`` of another installation fit the same episodes.
"""

from __future__ import annotations

import argparse
import sys
import threading
from collections import defaultdict
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from torchcloth._utils.files import write_text
from torchcloth.errors import InvalidInput

from ..resumable import ResumableStudy, check_jobs, write_result
from .honesty import THIS_VERSION, case_name, fit_recording, parse_comparison
from .strangers_episodes import find_or_make_episode
from .strangers_tables import print_tables, write_markdown

BENCH_COUNT, FAST_BENCH_COUNT, TOWEL_COUNT = 66, 1, 4
BENCHES_FOLDER = "benches"


def add(parser: argparse.ArgumentParser) -> None:
    """Add the study's options."""
    parser.add_argument("--benches", type=int, metavar="N", help=f"benches ({BENCH_COUNT}; more can be added later)")
    parser.add_argument("--first", type=int, default=0, metavar="SEED", help="seed of the first bench (0)")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="number of benches at a time (1)")
    parser.add_argument(
        "--episodes",
        type=Path,
        metavar="DIR",
        help=f"folder of benches with their episodes, from another run or new (default: {BENCHES_FOLDER} in --out)",
    )
    parser.add_argument(
        "--towel",
        action="store_true",
        help=f"a newcomer's towel on a bar instead, {TOWEL_COUNT} motions of it: nothing is off but a grip that turns",
    )
    parser.add_argument("--episodes-only", action="store_true", help="make benches and episodes, and fit none")
    parser.add_argument(
        "--compare",
        metavar="NAME=PYTHON",
        help="interpreter of another installation of torchcloth, whose identify fits the same episodes",
    )


def run(options: argparse.Namespace) -> None:
    """Make every episode that is missing, fit each one; print and write the tables."""
    check_jobs(options.jobs)
    usual_count = FAST_BENCH_COUNT if options.fast else TOWEL_COUNT if options.towel else BENCH_COUNT
    count = usual_count if options.benches is None else options.benches
    if count < 1 or options.first < 0:
        raise InvalidInput("--benches, --first", got=f"{count}, {options.first}", expected="1 or more; 0 or more")
    interpreters = {THIS_VERSION: sys.executable}
    if options.compare is not None:
        name, python = parse_comparison(options.compare)
        interpreters[name] = python
    settings = {"study": "strangers", "fast": options.fast, **({"towel": True} if options.towel else {})}
    study = ResumableStudy(options.out, settings)
    study.start()
    benches = _Benches(options.episodes or options.out / BENCHES_FOLDER, options.fast, options.towel)
    seeds = range(options.first, options.first + count)
    if options.episodes_only:
        study.run({case_name(seed, "episode"): partial(benches.find_or_make, seed) for seed in seeds}, options.jobs)
        print_tables({}, {seed: benches.find_or_make(seed) for seed in seeds})
        return
    cases: dict[str, Callable[[], dict[str, Any]]] = {
        case_name(seed, name): partial(run_case, benches, options.out, seed, name, python)
        for seed in seeds
        for name, python in interpreters.items()
    }
    finished = study.run(cases, options.jobs)
    answers = {name: {seed: finished[case_name(seed, name)] for seed in seeds} for name in interpreters}
    episodes = {seed: benches.find_or_make(seed) for seed in seeds}
    print_tables(answers, episodes)
    path = write_result(options.out / "strangers.json", "strangers", {"answers": answers, "episodes": episodes})
    write_text(options.out / "strangers.md", write_markdown(answers, episodes))
    print(f"result: {path}, {options.out / 'strangers.md'}")


class _Benches:
    """The benches of a folder; each is made once, also where several fits ask for it at a time."""

    def __init__(self, folder: Path, fast: bool, is_towel: bool) -> None:
        self.folder, self.fast, self.is_towel = folder, fast, is_towel
        self._locks: defaultdict[int, threading.Lock] = defaultdict(threading.Lock)

    def bench_folder(self, seed: int) -> Path:
        return self.folder / (f"towel-{seed}" if self.is_towel else f"{seed:03d}")

    def find_or_make(self, seed: int) -> dict[str, Any]:
        with self._locks[seed]:
            return find_or_make_episode(self.bench_folder(seed), seed, self.fast, self.is_towel)


def run_case(benches: _Benches, out: Path, seed: int, version: str, python: str) -> dict[str, Any]:
    """Fit the episode of a seed with one installation of torchcloth."""
    truth = benches.find_or_make(seed)
    if truth["refused"]:
        return {**truth, "parameters": {}, "cpu_seconds": truth["seconds_new"]}
    episode = benches.bench_folder(seed).resolve() / "episode"
    return fit_recording(episode, truth, out.resolve() / "fits" / case_name(seed, version), version, python)
