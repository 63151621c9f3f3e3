"""Cells that jump: slack cloth has several shapes, and a change that should move it a little turns a fold over.

Where the simulation does not do what its slopes say, residuals tell of the branch and not of a cause (Clyde et al.
2017 find several stable equilibria of real fabrics). Such cells are left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from ..errors import SimulationDiverged, UnstableStep
from .cells import NAMES, Cells, aligned, cells_of
from .evidence import Evidence
from .fitting import Fitted, weighed
from .noise import FLOOR, fit_noise
from .pieces import side_by_side
from .setting import Progress, Setting
from .steps import step_sizes
from .world import World

DIRECTIONS = 2  # random ones, each there and back
TIMES = 5.0  # the linear prediction, beyond which a cell has jumped
LEAST = 3.0  # of the noise's floor: predictions below count as this


def unstable(found: Fitted, setting: Setting, progress: Progress = lambda _: None, seed: int = 0) -> tuple[Tensor, ...]:
    """Per episode, the keys of cells that jump within the parameters' uncertainty.

    By one standard error in random directions, or by one finite step of the slopes where that is more.
    """
    rng = torch.Generator().manual_seed(seed)
    point = found.model.point
    sizes = torch.maximum(
        found.covariance.diagonal().sqrt(), torch.tensor([abs(step) for _, step in step_sizes(found.model)]).to(point)
    )
    drawn = torch.randn(DIRECTIONS, len(point), generator=rng, dtype=point.dtype)
    steps = drawn / drawn.norm(dim=1, keepdim=True) * sizes
    steps = torch.cat([steps, -steps])
    worlds = [found.model.at(point + step).world() for step in steps]
    moved = [found.model.at(point + step).point - point for step in steps]
    keys = []
    for k, e in enumerate(setting.episodes):
        progress(f"{e.name}, {k + 1} of {len(setting.episodes)}")
        seen = side_by_side(partial(_cells, setting=setting, k=k), worlds)
        keys.append(_jumped(found.evidence, k, seen, moved))
    return tuple(keys)


def without(found: Fitted, keys: Sequence[Tensor]) -> Fitted:
    """The same fit, weighed anew by the cells that do not jump; slopes take care of what moves the solution."""
    stable = [~torch.isin(c.key, k) for c, k in zip(found.evidence.cells, keys, strict=True)]
    cells = [Cells(*(column[s] for column in c)) for c, s in zip(found.evidence.cells, stable, strict=True)]
    numerics = [n[s] for n, s in zip(found.evidence.numerics, stable, strict=True)]
    evidence = replace(found.evidence, cells=cells, numerics=numerics)
    return weighed(found.model, evidence, fit_noise(evidence))


def _cells(world: World, setting: Setting, k: int) -> Cells | None:
    e = setting.episodes[k]
    try:
        return cells_of(world.frames(e, setting.dt), None, e, setting.sheet, setting.rest)
    except (SimulationDiverged, UnstableStep):
        return None


def _jumped(evidence: Evidence, k: int, seen: Sequence[Cells | None], moved: Sequence[Tensor]) -> Tensor:
    cells = evidence.cells[k]
    before = cells.value + evidence.numerics[k]  # on the mesh that the others are simulated on
    least = LEAST * torch.tensor([FLOOR[name] for name in NAMES], dtype=before.dtype)[cells.block]
    jumped = torch.zeros(len(before), dtype=torch.bool)
    for found, step in zip(seen, moved, strict=True):
        if found is None:
            continue
        both = torch.isin(cells.key, found.key)
        deviation = (aligned(cells.key, found.key, found.value) - before).abs()
        expected = torch.maximum((cells.jacobian[:, : evidence.own] @ step).abs(), least)
        jumped |= both & (deviation > TIMES * expected)
    return cells.key[jumped]
