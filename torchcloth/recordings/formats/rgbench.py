"""Captures of RGBench (Hu et al. 2026): garments that two arms fling, fold and grasp.

    calibration/world_to_camera_transform.json   4 x 4, m
    joints/{left,right}_arm_joint_states_and_end_pose.csv
    segment_pcds/pointcloud_SECONDS_segmented.pcd   cloth only, in the camera's frame

The times of the episode begin with the first sample of an arm, as in the benchmark. The poses are those of the tool in
the frame of the arm's base. The bases stand at y = 0.25 m and -0.25 m. The benchmark's documentation and its program
disagree on which arm is the left one, so the clouds decide: grippers are near the cloth. Grippers are closed from the
first sample (the benchmark's "fixed point" protocol) or from ``source.held_from``.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from ...errors import RecordingError
from .. import checks
from ..checks import Fields
from ..files import is_present
from .cloud_files import read_cloud_times, read_clouds
from .imported import Imported, Importer, read_text, reject_unknown_keys, to_seconds
from .pose_log import PoseLog, read_pose_log
from .scene_file import SceneFile

RGBENCH_NAME = "rgbench"
RGBENCH_TITLE = "capture of RGBench"
RGBENCH_UNCHECKED = "points, times and poses"
RGBENCH_ARMS = ("left", "right")
RGBENCH_CLOUD_FOLDER, RGBENCH_JOINT_FOLDER = "segment_pcds", "joints"
RGBENCH_CALIBRATION_FILE = "calibration/world_to_camera_transform.json"
RGBENCH_BASE_OFFSET_M = 0.25  # along y, of each arm's base from the origin
MAX_CAMERA_DELAY_S = 1.0
MAX_COMPARED_CLOUDS, MAX_COMPARED_POINTS = 30, 1000  # for the choice of the bases


def matches(path: Path) -> bool:
    """Return whether a folder has this layout."""
    return is_present(path / RGBENCH_CLOUD_FOLDER) and is_present(path / RGBENCH_JOINT_FOLDER)


def describe_missing(path: Path) -> str:
    """Return what a folder of segmented clouds lacks."""
    has_clouds = path.is_dir() and is_present(path / RGBENCH_CLOUD_FOLDER)
    return f"a capture of RGBench needs {RGBENCH_JOINT_FOLDER} beside {RGBENCH_CLOUD_FOLDER}" if has_clouds else ""


def read(path: Path, scene: SceneFile, episode: int | None) -> Imported:
    """Read a capture.

    Args:
        path: its folder.
        scene: the scene file; ``source`` may hold ``camera_delay`` [s], which is added to the stamps of the clouds
            (default: one frame interval, as in the benchmark), ``held_from`` [s] from the first sample on, and
            ``T_world_base`` with the pose of each arm's base.
        episode: unused; a capture is one episode.

    Raises:
        RecordingError: the capture is damaged or incomplete.
    """
    source = scene.source
    delay = source.optional(
        source.number, "camera_delay", minimum=0, maximum=MAX_CAMERA_DELAY_S, suspect="milliseconds"
    )
    held_from = source.optional(source.number, "held_from", minimum=0) or 0.0
    given_bases = _read_bases(source)
    reject_unknown_keys(source)
    logs = _read_arms(path / RGBENCH_JOINT_FOLDER)
    start = min(int(log.ns[0]) for log in logs.values())
    times = read_cloud_times(path / RGBENCH_CLOUD_FOLDER, None, "s")
    points, notes = read_clouds(times, start, _read_camera_pose(path / RGBENCH_CALIBRATION_FILE))
    if delay is None:
        delay = float(np.median(np.diff(points["t"]))) if len(points["t"]) > 1 else 0.0
    points["t"] = points["t"] + delay
    repairs = [*(note for log in logs.values() for note in log.notes), *notes]
    repairs.append(f"{1e3 * delay:.1f} ms are added to the stamps of the clouds for the camera's delay")
    closed = {name: to_seconds(log.ns, start) >= held_from for name, log in logs.items()}
    bases = {name: given_bases.get(name, np.eye(4)) for name in logs}
    motion = {name: log.to_motion(start, closed[name], bases[name]) for name, log in logs.items()}
    if not given_bases:
        repairs.append(_place_on_bases(motion, points))
    return Imported(
        motion=motion,
        points=points,
        notes={"format": RGBENCH_NAME, "start_ns": start, "unchecked": RGBENCH_UNCHECKED, "repairs": repairs},
    )


def _read_bases(source: Fields) -> dict[str, np.ndarray]:
    """Return the poses [4, 4] m of the arms' bases that the scene states: those of both arms, or none."""
    group = source.group("T_world_base")
    bases = {
        name: checks.check_transform(group.array(name, 4, 4), group.location(name))
        for name in (RGBENCH_ARMS if group.remaining else ())
    }
    reject_unknown_keys(group)
    return bases


def _read_arms(folder: Path) -> dict[str, PoseLog]:
    paths = {name: folder / f"{name}_arm_joint_states_and_end_pose.csv" for name in RGBENCH_ARMS}
    logs = {name: read_pose_log(path, "s") for name, path in paths.items() if is_present(path)}
    if not logs:
        expected = " or ".join(path.name for path in paths.values())
        raise RecordingError(f"{folder} holds no arm", expected=expected, remedy="download the capture again")
    return logs


def _read_camera_pose(path: Path) -> np.ndarray:
    """Return the camera's pose [4, 4] m in the world; the file holds its inverse."""
    try:
        value = json.loads(read_text(path))
    except (ValueError, RecursionError) as error:
        raise RecordingError(f"{path} is not valid JSON", got=error, expected="4 rows of 4 numbers") from error
    return np.linalg.inv(checks.check_transform(checks.check_array(value, str(path), (4, 4)), str(path)))


def _place_on_bases(motion: dict[str, dict[str, np.ndarray]], points: dict[str, np.ndarray]) -> str:
    """Move poses, given in the frames of the bases, into the world, on the side on which grippers touch the cloth."""
    offsets = {
        "left": np.array([0.0, RGBENCH_BASE_OFFSET_M, 0.0]),
        "right": np.array([0.0, -RGBENCH_BASE_OFFSET_M, 0.0]),
    }
    distances = [_distance_from_cloth(motion, points, {k: sign * x for k, x in offsets.items()}) for sign in (1, -1)]
    sign = 1 if distances[0] <= distances[1] else -1
    for name, group in motion.items():
        group["position"] = group["position"] + sign * offsets[name]
    low, high = (f"{1e3 * distance:.0f} mm" for distance in sorted(distances))
    place = f"y = {sign * RGBENCH_BASE_OFFSET_M:+g} m"
    return f"left arm at {place}, where the grippers are {low} from the cloth ({high} at the other side)"


def _distance_from_cloth(
    motion: dict[str, dict[str, np.ndarray]], points: dict[str, np.ndarray], offsets: dict[str, np.ndarray]
) -> float:
    """Return the mean over the arms of the lower quartile [m] of the gripper's distance from the nearest point."""
    ends = np.cumsum(points["counts"])
    frames = np.unique(np.linspace(0, len(ends) - 1, MAX_COMPARED_CLOUDS).astype(int))
    quartiles = []
    for name, group in motion.items():
        at = np.clip(np.searchsorted(group["t"], points["t"][frames]), 0, len(group["t"]) - 1)
        position = group["position"][at] + offsets[name]
        nearest = []
        for gripper, frame in zip(position, frames, strict=True):
            cloud = points["xyz"][ends[frame] - points["counts"][frame] : ends[frame]]
            sample = cloud[:: max(1, len(cloud) // MAX_COMPARED_POINTS)]
            nearest.append(np.linalg.norm(sample - gripper, axis=1).min())
        quartiles.append(np.quantile(nearest, 0.25))
    return float(np.mean(quartiles))


RGBENCH_IMPORTER = Importer(RGBENCH_NAME, RGBENCH_TITLE, matches, read, describe_missing)
