"""How far two parallel layers compress each other's directors, in closed form.

The layers have equal mass per area and approach each other. Each carries its velocity to the nodes by quadratic
B-splines, and the directors follow the gradient of the nodes' common velocity. The grid lies elsewhere in every
substep (``grid.grid_shifts``), so what counts is the mean over all places of the grid.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import torch
from torch import Tensor

RANGE_SPACINGS = 3.0  # distance from which on splines of two layers share no node
TABLE_STEP_SPACINGS = 0.01
GRID_PLACES = 200  # over which the mean is taken
COMPRESSION_PER_SPACING = 0.29  # compression for each spacing of approach, at a gap of 1.4 spacings


def compression_at(gap: Tensor) -> Tensor:
    """Return the compression 1 - R33 [...] of directors whose layers have come to a gap [...] in grid spacings."""
    table = torch.as_tensor(_compressions()).to(gap)
    position = (gap / TABLE_STEP_SPACINGS).clamp(0, len(table) - 1)
    below = position.detach().floor().long().clamp(max=len(table) - 2)
    return torch.lerp(table[below], table[below + 1], position - below)


def layer_pressure(gaps: np.ndarray, free_compression: float) -> np.ndarray:
    """Return the pressure between two layers at gaps [N] in spacings, over k h / spacing (A-EP, without shear)."""
    compression = compression_at(torch.as_tensor(gaps, dtype=torch.float64)).numpy()
    pressing = np.clip(compression - free_compression, 0, None)
    return 2 * pressing**2 * (1 - compression) * closing_rates(gaps)


@cache
def _compressions() -> np.ndarray:
    """Return the compression at all gaps from 0 to RANGE_SPACINGS: a director shrinks by its rate times its length."""
    gaps = np.linspace(0, RANGE_SPACINGS, round(RANGE_SPACINGS / TABLE_STEP_SPACINGS) + 1)
    rates = closing_rates(gaps)
    steps = 0.5 * (rates[:-1] + rates[1:]) * TABLE_STEP_SPACINGS
    return np.append(1 - np.exp(-np.cumsum(steps[::-1])[::-1]), 0.0)


def closing_rates(gaps: np.ndarray, places: int = GRID_PLACES) -> np.ndarray:
    """Return by which part of its length a director shrinks at gaps [N] in spacings, for each spacing of approach."""
    node = np.arange(-2, 6)
    place = (np.arange(places) + 0.5)[:, None] / places
    still, slope = _spline(place - node)
    approaching = np.stack([_spline(place + gap - node)[0] for gap in gaps])
    total = still + approaching
    share = np.divide(approaching, total, out=np.zeros_like(total), where=total > 0)  # of the approaching velocity
    return (share * slope).sum(-1).mean(-1)


def _spline(offset: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the quadratic B-spline and its slope."""
    distance = np.abs(offset)
    near, outer = distance < 0.5, np.clip(1.5 - distance, 0, None)
    return np.where(near, 0.75 - offset**2, 0.5 * outer**2), np.where(near, -2 * offset, -outer * np.sign(offset))
