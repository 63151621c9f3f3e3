"""Cheap steps between two looks: on the given mesh alone, with slopes that learn from what each step did.

Slopes at a point, and the residuals on the finer mesh, cost some twenty simulations of an episode on the given one; its
residuals there cost one. What the meshes differ by, like the slopes, changes little over a step; so a step is tried on
the given mesh first, slopes are corrected by what it did (Broyden 1965), and the next one goes on from there.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from .cells import Cells, Piece, aligned, cells_of
from .evidence import Evidence
from .leaping import gained, leap, prior_precision
from .noise import Noise, whitened
from .pieces import overlapping
from .setting import Setting
from .world import Model, World
from .worlds import IMPOSSIBLE

MOST = 8  # strides between two looks
LITTLE = 2.0  # log density that the last stride gained, below which there are no more


def further(model: Model, here: Evidence, noise: Noise, step: Tensor, setting: Setting) -> tuple[Model, float | None]:
    """(where strides lead that begin with ``step`` from the model's point, log density that the last one gained).

    At least that step, whatever the given mesh says of it; None where that says nothing, or nothing good. ``here`` is
    the evidence at the model's point.
    """
    at, last = model, None
    finer = any(h.finer for h in model.accepted)  # the given mesh does not see what these do
    for _ in range(0 if finer else MOST):
        there = at.at(at.point + step)
        try:
            seen = glance(there, here, setting)
        except IMPOSSIBLE:
            break
        gain = gained(noise, at, here, there, seen)
        if gain <= 0:
            last = None if last is None else 0.0
            break
        at, here, last = there, corrected(here, seen, step, model), gain
        if gain < LITTLE:
            break
        step, _ = leap(whitened(here, noise), at)
    return (model.at(model.point + step), None) if last is None else (at, last)


def glance(model: Model, like: Evidence, setting: Setting) -> Evidence:
    """``like`` with the residuals of another point on the given mesh, less what the meshes differed by."""
    world = model.world()

    def ask(k: int) -> Piece:
        return setting.kept(
            [k, "glance", [h.name for h in model.accepted]], model.point, partial(_piece, world, setting, k)
        )

    cells, numerics = [], []
    found = overlapping(ask, range(len(setting.episodes)))
    for own, difference, piece in zip(like.cells, like.numerics, found, strict=True):
        both = torch.isin(own.key, piece.cells.key)
        kept, difference = Cells(*(column[both] for column in own)), difference[both]
        cells.append(kept._replace(value=aligned(kept.key, piece.cells.key, piece.cells.value) - difference))
        numerics.append(difference)
    return replace(like, cells=cells, numerics=numerics)


def _piece(world: World, setting: Setting, k: int) -> Piece:
    e, none = setting.episodes[k], torch.zeros(0, dtype=torch.float64)
    frames = world.frames(e, setting.dt)
    return Piece(cells_of(frames, None, e, setting.sheet, setting.rest), none, none, none.bool())


def corrected(before: Evidence, seen: Evidence, step: Tensor, model: Model) -> Evidence:
    """``seen`` with slopes that lead there from ``before``: the least change, in prior standard deviations."""
    wide = prior_precision(model).rsqrt()
    along = step / wide.square()
    cells = []
    for own, there in zip(before.cells, seen.cells, strict=True):
        did = there.value - aligned(there.key, own.key, own.value)
        missed = did - there.jacobian[:, : len(step)] @ step
        jacobian = there.jacobian.clone()
        jacobian[:, : len(step)] += missed[:, None] * along / (step @ along)
        cells.append(there._replace(jacobian=jacobian))
    return replace(seen, cells=cells)
