"""What to mistrust in a pose estimate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from ..episodes.observed import Episode
from .fine_scale_uncertainty import FEWEST

LARGE = 0.1  # of the weight, from which a corrective force says that the model is wrong
MISSED = 1.3  # rms over the stated noise
BLIND = 0.3  # s without anything seen or felt


def warnings_of(
    fit: Mapping[str, Any],
    shares: Tensor,
    seen: Tensor,
    data: Episode,
    windows: Sequence[Tensor],
    noise: float | None,
    holds: int,
) -> list[str]:
    """Sentences; ``noise``: of a point, as it was given [m]; ``holds``: frames in which tangents describe a motion."""
    out = []
    if fit["force_share"] > LARGE:
        first, last = windows[int(shares.argmax())].tolist()
        out.append(
            f"the model is wrong: it takes a corrective force of {100 * fit['force_share']:.0f} % of the weight (rms; "
            f"{100 * fit['force_share_max']:.0f} % in {first:.2f}-{last:.2f} s) to follow what was seen: identify the "
            "fabric, or state how uncertain its values are; the standard errors are at their least"
        )
    if noise and fit["point_noise"] > MISSED * noise:
        out.append(
            f"seen points are {1e3 * fit['point_noise']:.1f} mm off the estimate, {1e3 * noise:.1f} mm would be "
            "noise: shapes finer than the correction's modes are missed"
        )
    if fit["chamfer_after"] >= fit["chamfer_null"]:
        out.append("no better than a cloth that is carried rigidly: do not use this estimate")
    if holds < len(data.times):
        out.append(
            f"the motion is unstable: from {float(data.times[max(holds - 1, 0)]):.2f} s on pushes of the size that is "
            "expected grow beyond the cloth: the estimate is one of many motions, which no standard error covers"
        )
    elif not fit["converged"]:
        out.append("the search did not converge: another estimate may fit as well")
    if (count := sum(len(cloud) for cloud in data.clouds)) < FEWEST:
        seen_points = f"only {count} points" if count else "no points"
        out.append(f"{seen_points} were seen: shapes finer than the correction's modes are in no standard error")
    felt = torch.zeros(len(data.times), dtype=torch.bool)
    for wrench in data.wrenches.values():
        felt |= wrench.isfinite().any(-1)
    blind = _longest_gap(data.times, seen.any(1) | felt)
    if blind > BLIND:
        out.append(f"nothing was seen or felt for {blind:.2f} s: there the estimate is simulation alone")
    return out + data.doubts()


def _longest_gap(times: Tensor, any_seen: Tensor) -> float:
    """[s] between frames in which something was seen, or felt."""
    at = times[any_seen | (torch.arange(len(times)) == 0)]
    ends = torch.cat([at, times[-1:]])
    return float((ends[1:] - ends[:-1]).max())
