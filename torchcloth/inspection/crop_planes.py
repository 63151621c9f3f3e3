"""Planes at which clouds were cropped, told from where the cloth itself ends."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..recordings import ClothInfo

FLAT, MOVES = 1e-3, 0.02  # m: a bound that stays within the one while the cloud moves by the other may be a cut
HELD = 0.03  # m from a gripper, where a held edge ends
WHOLE = 0.06  # of a side of the cloth, within which it is seen from end to end
COMPLETE = 0.95  # coverage beyond which nothing is missing


def cuts(
    frames: Sequence[np.ndarray], kept: Sequence[np.ndarray], cloth: ClothInfo, coverage: np.ndarray, held: np.ndarray
) -> dict[str, float]:
    """Bounds that frames share to 1 mm while the clouds' middles move along that axis by more than 2 cm.

    A bound is no cut where a gripper holds the cloth, where the cloth is seen over a side's length from there, or where
    nothing of its area is missing.

    Args:
        frames: T clouds [N, 3] m.
        kept: the same without outliers.
        cloth: its size.
        coverage: [T] area seen over the cloth's; NaN where unknown.
        held: [T, G, 3] m, where the grippers are; G may be 0.

    Returns:
        m by direction: {"z >": 0.075}.
    """
    seen = coverage[np.isfinite(coverage)]
    if len(frames) < 4 or (len(seen) and np.median(seen) >= COMPLETE):
        return {}
    found = {}
    for axis, name in enumerate("xyz"):
        middle = [np.median(f[:, axis]) for f in frames]
        if np.diff(np.quantile(middle, [0.1, 0.9]))[0] < MOVES:
            continue
        for sign, pick in ((">", np.min), ("<", np.max)):
            bound = np.array([pick(f[:, axis]) for f in frames])
            usual = float(np.median(bound))
            there = np.abs(bound - usual) < FLAT
            if there.mean() <= 0.5:
                continue
            extents = [np.ptp(f[:, axis]) for f, here in zip(kept, there, strict=True) if here and len(f)]
            near = (np.abs(held[there, :, axis] - usual) < HELD).any(-1)
            if near.mean() <= 0.5 and not (extents and _whole(float(np.median(extents)), cloth)):
                found[f"{name} {sign}"] = usual
    return found


def _whole(extent: float, cloth: ClothInfo) -> bool:
    """Whether a cloud that is so wide, m, shows the cloth along a whole side."""
    box = cloth.pattern_box()
    if box is None:
        return False
    share = extent / (box[1] - box[0])
    return bool((np.abs(share - 1) < WHOLE).any() or (share > 1).all())
