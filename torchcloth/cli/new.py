"""``torchcloth new``: write an episode from joint angles in CSV files and depth images in PNG files."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import InvalidInput, to_message_part
from .first_shape_option import add_network_option, read_network
from .inspect import check_for_fit, describe_verdict
from .output_paths import check_output_folder, output_path

if TYPE_CHECKING:
    from ..authoring import ArmFiles


def add(verbs: Any) -> None:
    """Add the verb and its options."""
    new = verbs.add_parser(
        "new",
        help="write an episode from joint angles in CSV and depth images in PNG",
        epilog="For several arms, repeat --tool and --held, and --urdf, --joints, --base and --name where they differ: "
        "a file that is named once counts for all arms.",
    )
    new.add_argument("episode", type=output_path, metavar="DIR", help="episode folder to write")
    required = new.add_argument_group("files and facts that are needed")
    required.add_argument("--urdf", action="append", required=True, metavar="FILE", help="arm: URDF, or rizon4 etc.")
    required.add_argument(
        "--tool", action="append", required=True, metavar="LINK", help="link of the URDF that holds the cloth"
    )
    required.add_argument(
        "--joints",
        action="append",
        required=True,
        type=Path,
        metavar="CSV",
        help="a time and the joint angles in each row",
    )
    required.add_argument("--depth", required=True, type=Path, metavar="FOLDER", help="depth images, 16-bit PNG")
    required.add_argument(
        "--intrinsics", required=True, type=Path, metavar="JSON", help="fx, fy, cx, cy, a 3 x 3 matrix, or a CameraInfo"
    )
    required.add_argument(
        "--sheet",
        nargs=2,
        type=float,
        required=True,
        metavar=("W", "H"),
        help="width (u) and height (v) of the cloth, m",
    )
    required.add_argument(
        "--held",
        dest="grips",
        action="append",
        nargs=2,
        type=float,
        required=True,
        metavar=("U", "V"),
        help="pattern place that the gripper holds, m from the lower left corner of the sheet",
    )
    new.add_argument("--bar", action="store_true", help="a bar holds the whole edge through each place of --held")
    _add_further_options(new)
    add_network_option(new)
    new.add_argument("--overwrite", action="store_true", help="replace DIR if it is an episode")
    new.set_defaults(run=_new, stopped="; nothing was written")


def _add_further_options(new: argparse.ArgumentParser) -> None:
    new.add_argument(
        "--camera-pose",
        type=Path,
        metavar="TXT",
        help="camera to world: 4 x 4 numbers, or x y z qx qy qz qw (default: found from the arm in view)",
    )
    new.add_argument(
        "--base",
        action="append",
        type=Path,
        metavar="TXT",
        help="pose of the arm's root link in the world (default: world)",
    )
    new.add_argument("--name", action="append", metavar="NAME", help="of the gripper (default: gripper, gripper1, ...)")
    new.add_argument("--mass", type=float, metavar="KG", help="of the sheet (default: a guess of 0.2 kg/m^2)")
    new.add_argument("--grip-radius", type=float, metavar="M", help="held around each place (default: 0.012)")
    new.add_argument("--depth-scale", type=float, metavar="M", help="m per unit of the depth images (default: 0.001)")
    new.add_argument("--depth-times", type=Path, metavar="FILE", help="table of the images' times (default: detected)")
    new.add_argument("--fps", type=float, metavar="HZ", help="images per second, if nothing gives their times")
    new.add_argument("--angles", choices=("rad", "deg"), help="unit of the joint angles (default: detected)")
    new.add_argument("--time-unit", choices=("s", "ms", "us", "ns"), help="of all times (default: detected)")
    new.add_argument(
        "--span", nargs=2, type=float, metavar=("FROM", "TO"), help="use these seconds after the first image only"
    )
    new.add_argument("--motion", metavar="NAME", help="name of the motion, shared by episodes that repeat it")


def _new(options: argparse.Namespace) -> int:
    from .. import authoring, inspection, recordings
    from ..recordings.reading import EPISODE_FILE

    target = options.episode
    if os.path.lexists(target) and not options.overwrite:
        raise InvalidInput("DIR exists", got=target, expected="a new name", remedy="choose one, or give --overwrite")
    if os.path.lexists(target) and not (target / EPISODE_FILE).is_file():
        raise InvalidInput("DIR is no episode", got=target, expected="an episode", remedy="choose a new name")
    check_output_folder(target.parent, "DIR")
    for option in ("mass", "grip_radius", "depth_scale", "fps"):
        if (value := getattr(options, option)) is not None and not 0 < value < float("inf"):
            raise InvalidInput(f"--{option.replace('_', '-')}", got=value, expected="a number > 0")
    camera = authoring.CameraFiles(
        depth=options.depth,
        intrinsics=options.intrinsics,
        pose=options.camera_pose,
        times=options.depth_times,
        fps=options.fps,
        depth_scale=options.depth_scale,
        span=options.span,
    )
    with _Progress() as progress:
        episode = authoring.new_episode(
            _list_arms(options),
            camera,
            tuple(options.sheet),
            mass=options.mass,
            grip_radius=options.grip_radius,
            angle_unit=options.angles,
            time_unit=options.time_unit,
            network=read_network(options),
            motion=options.motion,
            on_images=progress.begin,
        )
    episode.write(target, overwrite=options.overwrite)
    print("guessed or estimated:")
    for note in episode.notes:
        print(f"  {to_message_part(note)}")
    print(f"written: {target}\npicture: {target / authoring.PICTURE_FILE}")
    recording = recordings.read(target)
    report = inspection.inspect(recording)
    problems, warnings = check_for_fit(recording)
    notes = [*report.notes, *warnings]
    for note in notes:
        print(f"note: {to_message_part(note)}")
    print(f"verdict: {describe_verdict(problems, notes)}")
    command = f"inspect {target} --out {target}_inspection" if problems else f"identify {target} --out {target}_fit"
    print(f"next: torchcloth {command}")
    return 0


def _list_arms(options: argparse.Namespace) -> list[ArmFiles]:
    """List the arms; a file that is named once counts for all of them."""
    from ..authoring import ArmFiles

    count = len(options.grips)

    def of_each(option: str, values: Sequence[Any] | None, *, shared: bool = True) -> list[Any]:
        values = [None] if values is None else values
        if len(values) != count and not (len(values) == 1 and (shared or values[0] is None)):
            got, expected = f"{len(values)}", f"{count}, one for each --held" + " or one for all" * shared
            raise InvalidInput(f"number of {option}", got=got, expected=expected)
        return list(values) * (count if len(values) == 1 else 1)

    columns = zip(
        of_each("--urdf", options.urdf),
        of_each("--tool", options.tool),
        of_each("--joints", options.joints),
        options.grips,
        of_each("--base", options.base),
        of_each("--name", options.name, shared=False),
        strict=True,
    )
    return [
        ArmFiles(urdf=urdf, tool=tool, joints=joints, grip=tuple(grip), is_bar=options.bar, base=base, name=name)
        for urdf, tool, joints, grip, base, name in columns
    ]


class _Progress:
    """A bar over the images, on a terminal only."""

    def __enter__(self) -> _Progress:
        from rich.console import Console
        from rich.progress import Progress

        self._bar = Progress(console=Console(stderr=True), transient=True, disable=not sys.stderr.isatty())
        self._bar.start()
        return self

    def begin(self, count: int) -> Callable[[], None]:
        """Show a bar, and return what advances it by an image."""
        task = self._bar.add_task("cutting the cloth out of the images", total=count)
        return lambda: self._bar.advance(task)

    def __exit__(self, *error: object) -> None:
        self._bar.stop()
