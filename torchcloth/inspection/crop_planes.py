"""Find planes at which clouds were cropped, as opposed to places where the cloth ends."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..recordings import ClothInfo

MAX_PLANE_SCATTER_M = 1e-3  # a cropped bound stays within this distance of its median ...
MIN_CLOUD_MOTION_M = 0.02  # ... while the cloud moves by more than this
MAX_GRIP_DISTANCE_M = 0.03  # a gripped edge ends this near to the gripper
SIDE_TOLERANCE = 0.06  # relative, for a cloud that shows a whole side of the cloth
COMPLETE_COVERAGE = 0.95  # above, nothing of the cloth is missing


def find_crop_planes(
    frames: Sequence[np.ndarray],
    inliers: Sequence[np.ndarray],
    cloth: ClothInfo,
    coverage: np.ndarray,
    gripper_positions: np.ndarray,
) -> dict[str, float]:
    """Find bounds that most frames share to 1 mm while the clouds' medians move along that axis by more than 2 cm.

    A bound is no crop plane if a gripper holds the cloth there, if the cloud shows a whole side of the cloth along
    that axis, or if nothing of the cloth's area is missing.

    Args:
        frames: T clouds [N, 3] m.
        inliers: the clouds without outliers.
        cloth: gives the cloth's size.
        coverage: [T] area seen divided by the cloth's area; NaN where unknown.
        gripper_positions: [T, G, 3] m; G may be 0.

    Returns:
        Position [m] by direction, e.g. {"z >": 0.075}.
    """
    seen = coverage[np.isfinite(coverage)]
    if len(frames) < 4 or (len(seen) and np.median(seen) >= COMPLETE_COVERAGE):
        return {}
    planes = {}
    for axis, name in enumerate("xyz"):
        middle = [np.median(f[:, axis]) for f in frames]
        if np.diff(np.quantile(middle, [0.1, 0.9]))[0] < MIN_CLOUD_MOTION_M:
            continue
        for sign, pick in ((">", np.min), ("<", np.max)):
            bound = np.array([pick(f[:, axis]) for f in frames])
            plane = float(np.median(bound))
            at_plane = np.abs(bound - plane) < MAX_PLANE_SCATTER_M
            if at_plane.mean() <= 0.5:
                continue
            extents = [
                np.ptp(f[:, axis]) for f, is_at_plane in zip(inliers, at_plane, strict=True) if is_at_plane and len(f)
            ]
            near_gripper = (np.abs(gripper_positions[at_plane, :, axis] - plane) < MAX_GRIP_DISTANCE_M).any(-1)
            if near_gripper.mean() <= 0.5 and not (extents and _spans_a_side(float(np.median(extents)), cloth)):
                planes[f"{name} {sign}"] = plane
    return planes


def _spans_a_side(extent: float, cloth: ClothInfo) -> bool:
    """Whether a cloud with this extent [m] shows a whole side of the cloth."""
    box = cloth.pattern_box()
    if box is None:
        return False
    ratio = extent / (box[1] - box[0])
    return bool((np.abs(ratio - 1) < SIDE_TOLERANCE).any() or (ratio > 1).all())
