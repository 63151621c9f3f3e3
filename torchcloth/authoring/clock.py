"""The clock of the images against that of the joints, from what moves with the gripper."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import KDTree

from ..errors import InvalidInput
from ..inspection.lag import LAG_SEARCH_RANGE_S, LagEstimate, estimate_lag
from ..observe import DepthCamera, thin_to_spacing, to_points
from ..recordings import Camera, PointClouds, Recording
from ..robots.paths import GripperPath  # pyright: ignore[reportMissingImports] - mapped from robots/ at installation
from .bench_files import depth_stream, load_depth

MAX_VIEWED_IMAGES = 60  # evenly chosen, for the clock
VIEW_SPACING_M = 0.01  # of the thinned points
NEAR_GRIPPER_M = 0.1  # something is seen within this distance of the gripper, if the camera's pose is right
MIN_SEEN_IMAGES = 10  # with points, from which a lag can be estimated
SEARCH_OVERLAP = 0.9  # of the range of one search for a lag, between two searches
MAX_CLOCK_SEARCHES = 60
MIN_COVERED_FRACTION = 0.5  # of the images, during which the motion was recorded


def view_images(camera: Camera, low: np.ndarray, high: np.ndarray) -> PointClouds:
    """Return the thinned points between two corners [3] m in some images."""
    depth, view = depth_stream(camera), DepthCamera.from_recording(camera)
    times, clouds = [], []
    for i in np.unique(np.linspace(0, len(depth) - 1, MAX_VIEWED_IMAGES).astype(int)):
        points = to_points(view, load_depth(camera, int(i)))
        points = thin_to_spacing(points[np.all((points > low) & (points < high), axis=1)], VIEW_SPACING_M)
        if len(points):
            times.append(depth.t[i])
            clouds.append(points)
    xyz = np.concatenate(clouds) if clouds else np.zeros((0, 3))
    return PointClouds(np.array(times), xyz, np.array([len(cloud) for cloud in clouds], dtype=np.int64))


def check_camera_pose(camera: Camera, paths: dict[str, GripperPath], low: np.ndarray, high: np.ndarray):
    """Return the camera, its view, and a note if its pose had to be inverted.

    Args:
        camera: with its pose as given.
        paths: of the grippers.
        low, high: [3] m, corners of the space that the cloth can reach.

    Raises:
        InvalidInput: nothing is seen near the grippers.
    """
    views = []
    for pose in (camera.T_world_camera, np.linalg.inv(camera.T_world_camera)):
        placed = replace(camera, T_world_camera=pose)
        clouds = view_images(placed, low, high)
        views.append((_distance_to_paths(clouds, paths), placed, clouds))
        if views[-1][0] < NEAR_GRIPPER_M:
            break
    distance, placed, clouds = views[-1]
    if distance < NEAR_GRIPPER_M:
        note = "camera pose: read as world to camera, since its inverse shows something at the gripper"
        return placed, clouds, [note] if len(views) > 1 else []
    seen = views[0][0]
    raise InvalidInput(
        "camera pose",
        got="nothing in reach of the cloth" if np.isinf(seen) else f"nothing within {seen:.2f} m of a gripper",
        expected="depth images that show the gripper and the cloth",
        remedy="check the camera's pose (camera to world, OpenCV's axes), --tool, --base, --depth-scale and the joints",
    )


def _distance_to_paths(clouds: PointClouds, paths: dict[str, GripperPath]) -> float:
    """Median over the images of the smallest distance [m] of their points from a gripper's path; inf without any."""
    if not len(clouds):
        return np.inf
    positions = np.concatenate([path.position[:: max(1, len(path.t) // 200)] for path in paths.values()])
    return float(np.median([KDTree(clouds.frame(i)).query(positions)[0].min() for i in range(len(clouds))]))


def set_clock(recording: Recording, paths: dict[str, GripperPath], view: PointClouds, is_one_clock: bool):
    """Return the recording with the clock of its images set, and notes.

    Args:
        recording: whose clock offset is that of the stamps if they are on one clock, else that of a common beginning.
        paths: of the grippers.
        view: points that the camera sees, of cloth and arms.
        is_one_clock: whether the stamps of images and joints are on one clock.
    """
    seen = replace(recording, points=view, markers=None)
    offsets = [recording.clock_offset] if is_one_clock else _possible_offsets(recording, paths)
    lags = [
        lag
        for offset in (offsets if len(view) >= MIN_SEEN_IMAGES else [])
        if (lag := estimate_lag(replace(seen, clock_offset=offset), paths, is_one_clock=is_one_clock)) is not None
    ]
    best = min((lag for lag in lags if lag.is_determined), key=lambda lag: lag.misfit, default=None)
    if not is_one_clock:
        name = "clocks: the stamps of images and joints have no time in common; "
        if best is None:
            text = "both begin at once, which no motion of the gripper confirms: check it"
            return recording, [name + text]
        offset = -best.value
        text = f"{name}the motion of the gripper in the images gives the clock to {1e3 * best.std:.0f} ms"
        if best.rivals:
            others = ", ".join(f"{rival - best.value:+.2f}" for rival in best.rivals)
            text += f", if it does not repeat itself: a clock that is {others} s off explains it as well"
        return replace(recording, clock_offset=offset), [text]
    if best is None or not best.differs_from_recorded:
        return recording, ["clock: images and joints are on one clock" + _describe_agreement(best)]
    return replace(recording, clock_offset=-best.value), [
        f"clock: the images come {1e3 * best.value:.0f} ± {1e3 * best.std:.0f} ms after the joints, from the motion of "
        "the gripper in them; the stamps were set right by that"
    ]


def _describe_agreement(lag: LagEstimate | None) -> str:
    return ", from their stamps alone" if lag is None else f", and the motion agrees to {1e3 * lag.std:.0f} ms"


def _possible_offsets(recording: Recording, paths: dict[str, GripperPath]) -> list[float]:
    """Offsets [s] at which the motion covers most images, in steps that the search for the lag bridges."""
    (depth,) = (depth_stream(camera) for camera in recording.cameras.values())
    start, end = max(path.t[0] for path in paths.values()), min(path.t[-1] for path in paths.values())
    span = MIN_COVERED_FRACTION * float(depth.t[-1] - depth.t[0])
    low, high = start - depth.t[0] - span, end - depth.t[-1] + span
    count = 1 + int(max(high - low, 0.0) / (SEARCH_OVERLAP * 2 * LAG_SEARCH_RANGE_S))
    return np.linspace(low, max(low, high), min(count, MAX_CLOCK_SEARCHES) + 1).tolist()
