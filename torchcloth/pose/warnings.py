"""Warnings of a pose estimate: what to mistrust."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from ..episodes.observed import Episode
from .fine_scale_uncertainty import FINE_SCALE_SETTINGS

MAX_FORCE_FRACTION = 0.1  # of the weight; a larger corrective force says that the model is wrong
MAX_POINT_NOISE_RATIO = 1.3  # rms residual over the stated noise
MAX_UNOBSERVED_GAP_S = 0.3  # duration without any data


def pose_warnings(
    fit: Mapping[str, Any],
    force_fractions: Tensor,
    seen: Tensor,
    episode: Episode,
    windows: Sequence[Tensor],
    noise: float | None,
    predictable_frames: int,
) -> list[str]:
    """List what to mistrust in an estimate, in sentences.

    Args:
        fit: its distances and fractions.
        force_fractions: [W] corrective force over weight.
        seen: [T, V] bool.
        episode: with the data that were used.
        windows: W pairs of times [s].
        noise: stated standard deviation of a point [m], or None.
        predictable_frames: number of frames in which tangents describe a motion.
    """
    warnings = []
    if fit["force_fraction"] > MAX_FORCE_FRACTION:
        first, last = windows[int(force_fractions.argmax())].tolist()
        warnings.append(
            f"the model is wrong: it takes a corrective force of {100 * fit['force_fraction']:.0f} % of the weight "
            f"(rms; {100 * fit['force_fraction_max']:.0f} % in {first:.2f}-{last:.2f} s) to follow the data: identify "
            "the fabric, or state how uncertain its values are; the standard errors are at their least"
        )
    if noise and fit["point_noise"] > MAX_POINT_NOISE_RATIO * noise:
        warnings.append(
            f"measured points are {1e3 * fit['point_noise']:.1f} mm off the estimate, {1e3 * noise:.1f} mm would be "
            "noise: shapes finer than the correction's modes are missed"
        )
    if fit["chamfer_after"] >= fit["chamfer_null"]:
        warnings.append("no better than a cloth that is carried rigidly: do not use this estimate")
    if predictable_frames < len(episode.times):
        start = float(episode.times[max(predictable_frames - 1, 0)])
        warnings.append(
            f"the motion is unstable: from {start:.2f} s on pushes of the size that is expected grow beyond the "
            "cloth: the estimate is one of many motions, which no standard error covers"
        )
    elif not fit["converged"]:
        warnings.append("the search did not converge: another estimate may fit as well")
    if (count := sum(len(cloud) for cloud in episode.clouds)) < FINE_SCALE_SETTINGS.min_points:
        points = f"only {count} points" if count else "no points"
        warnings.append(f"{points} were seen: shapes finer than the correction's modes are in no standard error")
    has_force = torch.zeros(len(episode.times), dtype=torch.bool)
    for wrench in episode.wrenches.values():
        has_force |= wrench.isfinite().any(-1)
    gap = _longest_gap(episode.times, seen.any(1) | has_force)
    if gap > MAX_UNOBSERVED_GAP_S:
        warnings.append(f"there are no data for {gap:.2f} s: there the estimate is simulation alone")
    return warnings + episode.data_warnings()


def _longest_gap(times: Tensor, has_data: Tensor) -> float:
    """Longest duration between frames with data [s]."""
    at = times[has_data | (torch.arange(len(times)) == 0)]
    ends = torch.cat([at, times[-1:]])
    return float((ends[1:] - ends[:-1]).max())
