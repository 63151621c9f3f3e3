"""``torchcloth convert``: convert recordings of other formats to episodes, and episodes to MCAP."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import InvalidInput, to_message_part
from .output_paths import check_output_folder, output_path

if TYPE_CHECKING:
    from ..recordings import Recording

FORMATS = ("episode", "ros2", "lerobot", "redwood", "tum", "kinect", "rgbench", "pcd")
MCAP_SUFFIX = ".mcap"
# Suffixes that a folder would hardly have.
FILE_SUFFIXES = ".mcap .bag .db3 .mkv .mp4 .json .npz .npy .h5 .hdf5 .parquet .csv .txt .zip .tar .gz .tgz .zst"


def add(verbs: Any) -> None:
    """Add the verb and its options."""
    convert = verbs.add_parser(
        "convert",
        help="convert a recording of another format to an episode, or an episode to MCAP",
        epilog="The file of --scene has the keys of episode.json (cloth, grasps, robots, cameras, provenance). Its key "
        '"source" says what each topic or column means. If --scene is missing and needed, the message says what to '
        "write.",
    )
    convert.add_argument("source", type=Path, metavar="SRC", help="file or folder to read")
    convert.add_argument(
        "target", type=output_path, metavar="DST", help=f"episode folder to write, or a file ending {MCAP_SUFFIX}"
    )
    convert.add_argument("--from", dest="format", choices=FORMATS, help="format of SRC (default: detected)")
    convert.add_argument("--scene", type=Path, metavar="FILE", help="JSON file with facts that the recording lacks")
    convert.add_argument(
        "--episode", type=int, metavar="N", help="number of the episode, if SRC holds several (LeRobot)"
    )
    convert.add_argument(
        "--camera-from-arm",
        metavar="CAM",
        help="find the pose of this camera from the arms in its view; its pose in SRC or in the scene may be a guess",
    )
    convert.add_argument("--overwrite", action="store_true", help="replace DST if it exists")
    convert.set_defaults(run=_convert, stopped="; nothing was written")


def _convert(options: argparse.Namespace) -> int:
    from rich.console import Console
    from rich.markup import escape

    from .. import recordings
    from ..recordings import formats

    _check_target(options)
    with Console(stderr=True).status(escape(f"reading {options.source}")):  # prints nothing if stderr is no terminal
        recording = formats.read(options.source, format=options.format, scene=options.scene, episode=options.episode)
    if options.camera_from_arm is not None:
        recording = _with_pose_from_arm(recording, options.camera_from_arm)
    write = formats.write_mcap if options.target.suffix == MCAP_SUFFIX else recordings.write
    _with_progress(
        recording, lambda on_image: write(recording, options.target, overwrite=options.overwrite, on_image=on_image)
    )
    _report(recording, options.target)
    return 0


def _with_pose_from_arm(recording: Recording, name: str) -> Recording:
    """Return the recording with the camera's pose found from the arms, and print it."""
    from dataclasses import replace

    from ..inspection import find_camera_pose_from_arms
    from ..inspection.camera_from_arm import describe_camera_pose

    if recording.points is not None:
        raise InvalidInput(
            "--camera-from-arm",
            got="a recording with points, which the pose that it has placed in the world",
            expected="depth images without points",
            remedy="leave the points out, and cut the cloth out of the depth images with the new pose",
        )
    guess = recording.cameras[name].T_world_camera if name in recording.cameras else None
    pose = find_camera_pose_from_arms(recording, name, guess)
    print(f"{name}: {describe_camera_pose(pose, guess)}")
    if not pose.is_determined:
        raise InvalidInput(
            "--camera-from-arm",
            got="a pose that the images do not determine",
            expected="standard errors below 30 mm and 1.7 degrees",
            remedy="record more postures of the arm, nearer to the camera",
        )
    camera = replace(recording.cameras[name], T_world_camera=pose.T_world_camera)
    return replace(recording, cameras={**recording.cameras, name: camera})


def _check_target(options: argparse.Namespace) -> None:
    source, target = options.source, options.target
    if source.resolve().is_relative_to(target.resolve()):
        raise InvalidInput("DST is SRC or contains it", got=target, expected="another name")
    if target.resolve().is_relative_to(source.resolve()):
        raise InvalidInput("DST is within SRC", got=target, expected="a place outside it")
    if options.scene is not None and options.scene.resolve().is_relative_to(target.resolve()):
        raise InvalidInput("--scene is in DST", got=options.scene, expected="a place outside it")
    if target.suffix != MCAP_SUFFIX and target.suffix.lower() in FILE_SUFFIXES.split():
        expected = f"a folder's name, or a file ending {MCAP_SUFFIX}"
        raise InvalidInput(f"DST cannot be a {target.suffix} file", got=target, expected=expected)
    if os.path.lexists(target) and not options.overwrite:
        raise InvalidInput("DST exists", got=target, expected="a new name", remedy="choose one, or give --overwrite")
    check_output_folder(target.parent, "DST")


def _list_streams(recording: Recording) -> list[tuple[str, str, Any]]:
    """Return name, content and times [s] of every stream."""
    rows: list[tuple[str, str, Any]] = []
    for name, gripper in recording.grippers.items():
        rows.append((name, "pose" + ", wrench" * (gripper.force is not None), gripper.t))
    for name, arm in recording.joints.items():
        rows.append((name, f"{arm.q.shape[1]} joints" + ", width" * (arm.width is not None), arm.t))
    if recording.points is not None:
        rows.append(("points", f"{int(recording.points.counts.mean())} a cloud", recording.points.t))
    if recording.markers is not None:
        rows.append(("markers", f"{recording.markers.xyz.shape[1]} points", recording.markers.t))
    for name, camera in recording.cameras.items():
        for stream in filter(None, (camera.depth, camera.color, camera.mask)):
            rows.append((f"{name}/{stream.kind}", f"{stream.size[0]} x {stream.size[1]} px", stream.t))
    return rows


def _with_progress(recording: Recording, write: Any) -> None:
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    images = sum(len(s) for c in recording.cameras.values() for s in (c.depth, c.color, c.mask) if s is not None)
    columns = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("{task.description}"))
    with Progress(*columns, transient=True, disable=not sys.stdout.isatty()) as progress:
        task = progress.add_task("images", total=images or None)
        write(lambda: progress.advance(task))


def _describe_depth(image: Any, scale: float) -> str:
    """Return the unit and the median depth of an image [H, W]."""
    import numpy as np

    valid = image[image > 0]
    median = f"a median depth of {float(np.median(valid)) * scale:.3g} m" if len(valid) else "no valid depth"
    return f"{scale:g} m per unit, {median} in the first image"


def _report(recording: Recording, target: Path) -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    table = Table("stream", "content", "samples", "first, s", "last, s", "rate, Hz")
    for name, content, t in _list_streams(recording):
        rate = (len(t) - 1) / (t[-1] - t[0]) if len(t) > 1 else float("nan")
        rate_text = "" if rate != rate else f"{rate:.1f}"
        table.add_row(escape(name), content, str(len(t)), f"{t[0]:.3f}", f"{t[-1]:.3f}", rate_text)
    Console(soft_wrap=True).print(table)
    for name, camera in recording.cameras.items():
        if camera.depth is not None and camera.depth_scale is not None:
            print(f"{name}/depth: {_describe_depth(camera.depth.load(0), camera.depth_scale)}")
    source = recording.extra.get("source")
    for note in source.get("repairs", ()) if isinstance(source, dict) else ():
        print(f"note: {to_message_part(str(note))}")
    if isinstance(source, dict) and source.get("unchecked"):
        print(f"no checksum covers {to_message_part(str(source['unchecked']))}: damage there is not detected")
    print(f"written: {target}")
