"""Where on the fabric, in which motion and when a cause shows: what it moves beyond what fitted numbers could do."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ...episodes.observed import Episode
from ...identification.residuals.blocks import BLOCKS
from ..data.binning import FORCE_BLOCK, BIN_SECONDS
from ..inference.fitting import ModelFit, posterior_precision

SEEN_ENOUGH = 0.1  # of what all cells tell: from there on the place is one on the fabric


def localise_cause(found: ModelFit, name: str, names: Sequence[str], episodes: Sequence[Episode]) -> dict[str, Any]:
    """The place and the stretch of time in which an accepted cause stands out of the noise most, and by how much.

    Of positions, unless forces tell nearly all, and of the kind of them that tells most.

    Args:
        found: a model with the cause.
        name: of the cause.
        names: of the episodes' motions.
        episodes: that it was fitted to.

    Returns:
        "where": {"at": [u, v] m on the pattern} or {"gripper": name}; "when": {"episode", "motion", "from", "to"} s
        from the first frame; "moves": {"value", "unit"} there, at the fitted amplitude.
    """
    cells = found.linearisation.bins
    moved = torch.cat(_alone(found, name))
    told = (moved / torch.cat([_scatter(found, k) for k in range(len(cells))])).square()
    join = lambda field: torch.cat([getattr(c, field) for c in cells])  # noqa: E731
    block, window, part, place = join("block"), join("window"), join("patch") // 3, join("place")
    episode = torch.cat([torch.full_like(c.block, k) for k, c in enumerate(cells)])
    chosen = block < FORCE_BLOCK
    chosen = chosen if told[chosen].sum() > SEEN_ENOUGH * told.sum() else ~chosen
    for column in (block, episode * 1000 + window, part):
        chosen = chosen & (column == _most(column, told, chosen))
    first = int(chosen.nonzero()[0])
    k, w, kind = int(episode[first]), int(window[first]), int(block[first])
    felt = list(episodes[k].wrenches)
    return {
        "where": {"gripper": felt[int(part[first])]} if kind >= FORCE_BLOCK else {"at": place[first, :2].tolist()},
        "when": {"episode": k, "motion": names[k], "from": round(w * BIN_SECONDS, 9), "to": round((w + 1) * BIN_SECONDS, 9)},
        "moves": {"value": float(moved[chosen].norm()), "unit": BLOCKS[kind].unit},
    }


def _alone(found: ModelFit, name: str) -> list[Tensor]:
    """Per episode [C], in the cells' units: the cause at its amplitude, less what else is fitted could do instead."""
    model, square = found.model, posterior_precision(found.whitened, found.model)
    place = len(model.parameters) + model.place(name)
    others = [k for k in range(found.linearisation.n_coordinates) if k != place]
    instead = torch.linalg.solve(square[others][:, others], square[others, place])
    amplitude = model.amplitudes[model.place(name)]
    return [amplitude * (c.jacobian[:, place] - c.jacobian[:, others] @ instead) for c in found.linearisation.bins]


def _scatter(found: ModelFit, k: int) -> Tensor:
    """[C] standard deviation of an episode's cells, ripples among it."""
    cells = found.linearisation.bins[k]
    return (found.noise.smooth_variance(cells) / found.noise.smooth_fraction(cells)).sqrt()


def _most(column: Tensor, told: Tensor, among: Tensor) -> int:
    """The entry of a column [C] whose cells tell most together."""
    entries, index = column[among].unique(return_inverse=True)
    return int(entries[torch.zeros(len(entries)).to(told).index_add(0, index, told[among]).argmax()])
