"""``torchcloth inspect``: report what an episode contains and how far it can be trusted."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from .._utils.files import write_text
from ..errors import TorchclothError
from .output_paths import check_output_folder, check_outside_episodes, output_path, replacement_note

if TYPE_CHECKING:
    from ..recordings import Recording

INSPECTION_FILE_NAME = "inspection.json"


def add(verbs: Any) -> None:
    """Add the verb and its options."""
    inspect = verbs.add_parser(
        "inspect", help="report streams, rates, gaps, lag, noise and rejected frames of an episode"
    )
    inspect.add_argument("episode", metavar="EPISODE", help="folder of a recording")
    inspect.add_argument("--out", type=output_path, metavar="DIR", help="also write inspection.json and inspection.png")
    inspect.add_argument(
        "--camera-from-arm",
        metavar="CAM",
        help="find this camera's pose from the arms in its view, and print how far the recorded one is off",
    )
    inspect.add_argument("--json", action="store_true", help="print inspection.json instead of tables")
    inspect.set_defaults(run=_inspect)


def _inspect(options: argparse.Namespace) -> int:
    from rich.console import Console
    from rich.markup import escape

    from .. import inspection, recordings

    if options.out is not None:
        check_outside_episodes(options.out, options.episode)
        check_output_folder(options.out)
    with Console(stderr=True).status(escape(f"inspecting {options.episode}")):
        recording = recordings.read(options.episode)
        report = inspection.inspect(recording)
        problems, warnings = check_for_fit(recording)
        pose = _find_pose(recording, options.camera_from_arm)
    report = replace(report, notes=[*report.notes, *warnings, *pose])
    text = json.dumps(report.as_dict(), indent=1, allow_nan=False) + "\n"
    written = ""
    if options.out is not None:  # before printing, which fails if the reader closes the pipe
        note = replacement_note(options.out / INSPECTION_FILE_NAME)
        picture = inspection.draw(report, options.out)
        written = f"result:  {write_text(options.out / INSPECTION_FILE_NAME, text)}{note}\npicture: {picture}\n"
    if options.json:
        print(text, end="")
    else:
        inspection.show(report)
        print(f"{written}verdict: {describe_verdict(problems, report.notes)}")
    return 0


def _find_pose(recording: Recording, camera: str | None) -> list[str]:
    """Return a note on the pose of a camera from the arms in its view."""
    from ..inspection import find_camera_pose_from_arms
    from ..inspection.camera_from_arm import describe_camera_pose

    if camera is None:
        return []
    recorded = recording.cameras[camera].T_world_camera if camera in recording.cameras else None
    return [f"{camera}: {describe_camera_pose(find_camera_pose_from_arms(recording, camera, recorded), recorded)}"]


def check_for_fit(recording: Recording) -> tuple[list[str], list[str]]:
    """Make the checks that ``identify`` makes before its first simulation.

    Returns:
        Why ``identify`` would refuse the recording, and what it would warn of, in sentences.
    """
    from ..episodes.observed import build_episode, check_is_held
    from ..episodes.recorded_cloth import build_cloth
    from ..inspection.corrections import check_recording
    from ..recordings.size_checks import check_size

    warnings: list[str] = []

    def build() -> None:
        episode = build_episode(build_cloth(recording), check_recording(recording).recording)
        warnings.extend(episode.data_warnings())

    problems = []
    for check in (lambda: check_size(recording), lambda: check_is_held(recording), build):
        try:
            check()
        except TorchclothError as error:
            problems.append(str(error))
    return list(dict.fromkeys(problems)), warnings


def describe_verdict(problems: Sequence[str], notes: Sequence[str]) -> str:
    """Return in one line whether ``identify`` can use a recording, and what must be mended first if it cannot.

    Args:
        problems: why it would refuse the recording.
        notes: what else was printed to mistrust.
    """
    if len(problems) == 1:
        return f"1 problem must be mended first: {problems[0]}."
    if problems:
        listed = "; ".join(f"({number}) {problem}" for number, problem in enumerate(problems, 1))
        return f"{len(problems)} problems must be mended first: {listed}."
    if not notes:
        return "Ready for identify."
    which = "The note above says" if len(notes) == 1 else f"The {len(notes)} notes above say"
    return f"Ready for identify. {which} what to mistrust."
