"""``torchcloth diagnose``: what the simulation gets wrong in recorded episodes, and why."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from .._utils.files import PROGRESS
from ..errors import InvalidInput
from .folders import check_apart, check_folder, how_to_go_on, place, say

LONG = 10.0  # s, of an episode


def add(verbs: Any) -> None:
    """The verb and its options."""
    parser = verbs.add_parser(
        "diagnose",
        help="find what a simulation of recorded episodes gets wrong, and why",
        description="Find what a simulation of one cloth's episodes gets wrong, and why. At least two motions "
        "(split.motion in episode.json). Writes diagnosis.json, report.html, base.tcm and extended.tcm, and the motion "
        "to record next.",
    )
    parser.add_argument("episodes", nargs="+", metavar="EPISODE", help="folders of one cloth's episodes")
    parser.add_argument("--model", metavar="MODEL", help="a .tcm file to start from (default: A-EP in vacuum)")
    parser.add_argument("--out", type=place, required=True, metavar="DIR", help="folder for the result")
    parser.add_argument("--resume", action="store_true", help="go on with a diagnosis that was stopped")
    parser.set_defaults(run=_diagnose, stopped=how_to_go_on)


def _diagnose(options: argparse.Namespace) -> int:
    import torch

    from .. import diagnosis
    from .._utils.resume import clear
    from ..diagnosis.experiment.feasibility import FOLDER
    from ..diagnosis.report.html_report import REPORT
    from ..diagnosis.run import RESULT

    torch.set_default_dtype(torch.float64)
    torch.set_num_threads(1)
    check_apart(options.out, *options.episodes)
    check_folder(options.out)
    _refuse_own_result(options)
    replaced = (options.out / RESULT).exists()
    if replaced:
        say(f"{options.out} holds a diagnosis, which this one will replace")
    episodes, faults = diagnosis.read_episodes(options.episodes)
    if faults:
        answer = diagnosis.refused(faults)
    else:
        model = None
        if options.model is not None:
            model, episodes = diagnosis.begin_with(options.model, episodes)
        streams = [e.markers if e.points is None else e.points for e in episodes]
        seen = [float(s.t[-1] - s.t[0]) for s in streams if s is not None]
        seconds, longest = sum(seen), max(seen, default=0.0)
        print(
            f"{len(episodes)} episodes, seen for {seconds:.0f} s: some {max(1, round(seconds / 1.5)):.0f} minutes of "
            "a core, up to three times as many where causes are found",
            flush=True,
        )
        if longest > LONG:
            print(f"one lasts {longest:.0f} s: time and memory grow with the cube of that", flush=True)
        with progress_line() as progress:
            answer = diagnosis.diagnose(
                episodes, model, progress=progress, journal=options.out / PROGRESS, resume=options.resume or None
            )
    written = diagnosis.write_diagnosis(answer, episodes, options.out)
    if answer.searched is not None:  # a stopped diagnosis goes on once the episodes can be read
        clear(options.out / PROGRESS)
    print(f"verdict: {answer.verdict}")
    print(answer.summary())
    amiss = [text for text in written.content["warnings"] if text not in answer.content["warnings"]]
    print("".join(f"Warning: {text}.\n" for text in amiss), end="")
    proposed = FOLDER if answer.experiment is not None and not amiss else None
    files = (RESULT, REPORT, answer.content.get("base"), answer.content["model"], proposed)
    print("\n".join(str(options.out / name) for name in files if name))
    if replaced:
        print("the last diagnosis there is replaced")
    return 0


def _refuse_own_result(options: argparse.Namespace) -> None:
    """A model to start from that the result would replace."""
    from ..diagnosis.run import BASE, EXTENDED

    own = [(options.out / name).resolve() for name in (BASE, EXTENDED)]
    if options.model is not None and Path(options.model).resolve() in own:
        raise InvalidInput(
            "--out",
            got=f"{options.out}, where the result would replace {options.model}",
            expected="another folder than that of --model",
        )


@contextmanager
def progress_line() -> Iterator[Callable[[str], None]]:
    """One line that changes on a terminal; in a log, a line for every stage."""
    if not sys.stderr.isatty():
        yield lambda text: None if text.endswith("left") else say(text)
        return
    from rich.console import Console
    from rich.markup import escape

    with Console(stderr=True).status("") as status:
        yield lambda text: status.update(escape(text))
