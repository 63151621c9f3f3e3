"""``torchcloth diagnose``: find what the simulation gets wrong in recorded episodes, and why."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from .._utils.files import PROGRESS_FOLDER_NAME
from ..errors import InvalidInput
from .output_paths import check_output_folder, check_outside_episodes, output_path, print_line, resume_hint
from .recording_checks import add_checks_option

LATER_EPISODE = re.compile(r", (?!1 )\d+ of \d+")  # a line of the same stage
LONG_EPISODE_S = 10.0  # longer episodes are announced, because their cost grows with the cube of the duration


def add(verbs: Any) -> None:
    """Add the verb and its options."""
    parser = verbs.add_parser(
        "diagnose",
        help="find what a simulation of recorded episodes gets wrong, and why",
        description="Find what a simulation of one cloth's episodes gets wrong, and why. A cause is named only if the "
        "episodes show at least two motions (split.motion in episode.json); one motion gives a ranking of what would "
        "explain it. Writes diagnosis.json, report.html, base.tcm, extended.tcm and the motion to record next.",
    )
    parser.add_argument("episodes", nargs="+", metavar="EPISODE", help="folders of episodes of one cloth")
    parser.add_argument("--model", metavar="MODEL", help="a .tcm file to start from (default: A-EP in vacuum)")
    parser.add_argument("--out", type=output_path, required=True, metavar="DIR", help="folder for the result")
    parser.add_argument("--resume", action="store_true", help="resume a diagnosis that was stopped")
    add_checks_option(parser)
    parser.set_defaults(run=_diagnose, stopped=resume_hint)


def _diagnose(options: argparse.Namespace) -> int:
    import torch

    from .. import diagnosis
    from .._utils.resume import clear_store
    from ..diagnosis.experiment.feasibility import EXPERIMENT_FOLDER
    from ..diagnosis.report.html_report import REPORT_FILE
    from ..diagnosis.run import RESULT_FILE

    torch.set_default_dtype(torch.float64)
    torch.set_num_threads(1)
    check_outside_episodes(options.out, *options.episodes)
    check_output_folder(options.out)
    _check_model_not_replaced(options)
    replaced = (options.out / RESULT_FILE).exists()
    if replaced:
        print_line(f"{options.out} holds a diagnosis, which this one will replace")
    episodes, faults = diagnosis.read_episodes(options.episodes)
    if faults:
        answer = diagnosis.refuse(faults)
    else:
        model = None
        if options.model is not None:
            model, episodes = diagnosis.start_from_model(options.model, episodes)
        streams = [e.markers if e.points is None else e.points for e in episodes]
        durations = [float(s.t[-1] - s.t[0]) for s in streams if s is not None]
        seconds, longest = sum(durations), max(durations, default=0.0)
        count = f"{len(episodes)} episode{'s' if len(episodes) > 1 else ''}"
        print(
            f"{count}, observed for {seconds:.0f} s: the time left is estimated from the first simulation, and grows "
            "where several causes are found",
            flush=True,
        )
        if longest > LONG_EPISODE_S:
            print(f"the longest lasts {longest:.0f} s: time and memory grow with the cube of this", flush=True)
        with show_progress_line() as progress:
            answer = diagnosis.diagnose(
                episodes,
                model,
                progress=progress,
                journal=options.out / PROGRESS_FOLDER_NAME,
                resume=options.resume or None,
                checks=options.checks,
            )
    written = diagnosis.write_diagnosis(answer, episodes, options.out)
    if answer.optional_search is not None:  # a stopped diagnosis goes on once the episodes can be read
        clear_store(options.out / PROGRESS_FOLDER_NAME)
    print(f"verdict: {answer.verdict}")
    print(answer.summary())
    new_warnings = [text for text in written.content["warnings"] if text not in answer.content["warnings"]]
    print("".join(f"Warning: {text}.\n" for text in new_warnings), end="")
    experiment_folder = EXPERIMENT_FOLDER if answer.experiment is not None and not new_warnings else None
    files = (RESULT_FILE, REPORT_FILE, answer.content.get("base"), answer.content["model"], experiment_folder)
    print("\n".join(str(options.out / name) for name in files if name))
    if replaced:
        print("the earlier diagnosis in this folder was replaced")
    return 0


def _check_model_not_replaced(options: argparse.Namespace) -> None:
    """Refuse an output folder whose new model files would replace the file of --model."""
    from ..diagnosis.run import BASE_MODEL_FILE, EXTENDED_MODEL_FILE

    replaced_models = [(options.out / name).resolve() for name in (BASE_MODEL_FILE, EXTENDED_MODEL_FILE)]
    if options.model is not None and Path(options.model).resolve() in replaced_models:
        raise InvalidInput(
            "--out",
            got=f"{options.out}, where the result would replace {options.model}",
            expected="another folder than that of --model",
        )


@contextmanager
def show_progress_line() -> Iterator[Callable[[str], None]]:
    """Show progress in one changing line on a terminal, or in one line for each stage in a log.

    Yields:
        A function that takes the text to show.
    """
    if not sys.stderr.isatty():
        yield lambda text: None if LATER_EPISODE.search(text) else print_line(text)
        return
    from rich.console import Console
    from rich.markup import escape

    with Console(stderr=True).status("") as status:
        yield lambda text: status.update(escape(text))
