"""Viscous forces in stages, where a substep would have to be short for them alone.

The explicit factor 1 - dt D of velocities survives dt c <= 2, c the largest rate of D. In its place stands P(dt D) with
P(z) = (1 + T_n(w_0 - w_1 z)) / (1 + T_n(w_0)), T_n Chebyshev's polynomial: n applications of D reach dt c of 0.8 n^2,
where n shorter steps would reach 2 n. To first order it is exp(-z), like 1 - z; it is never negative, so that elastic
forces are left 2 of the 4 in 4 - 2 (1 - P) - omega^2 dt^2 > 0; and with T_n(w_0) = 3 no more than half is left of what
is damped fast (van der Houwen and Sommeijer 1980 leave 95 %).

P acts on the velocities that the boundaries left, beside the other forces and not after them: these push the held
vertices as well, and stages would carry that on to their neighbours. To these a held vertex keeps its velocity from
stage to stage; what it is given itself is summed beside that, for who holds it feels it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from .._utils.linalg import resisted
from ..boundaries import Drive
from ..types import ClothState, Memory, Moment, Surface
from .model import Model

PEAK = 3.0  # T_n(w_0)
MOST = 16  # stages


class Polynomial(NamedTuple):
    """P(z) = (1 + T_n(first - slope z)) / (1 + PEAK)."""

    first: float
    slope: float

    @classmethod
    def of(cls, stages: int) -> Polynomial:
        """The one that uses D so often."""
        angle = math.acosh(PEAK) / stages
        derivative = stages * math.sinh(stages * angle) / math.sinh(angle)  # of T_n
        return cls(math.cosh(angle), (1 + PEAK) / derivative)

    @property
    def reach(self) -> float:
        """Largest z for which -1 <= T_n."""
        return (self.first + 1) / self.slope


def relaxed(
    model: Model,
    state: ClothState,
    s: Surface,
    memory: Memory,
    dt: float,
    drives: Mapping[str, Drive],
    substep: int,
    resistance: Tensor | None,
) -> Tensor:
    """P(dt D) v [..., V, 3] with the viscous forces of all effects; v itself where there are no stages."""
    if not model.stages:
        return state.v
    first, slope = Polynomial.of(model.stages)
    loose = _loose(model, drives, substep)
    before, now, often = torch.zeros_like(state.v), state.v, 1.0
    given_before, given = before, now
    for _ in range(model.stages):
        force = _viscous_forces(model, s, state.x, now, memory)
        change = dt * slope * resisted(resistance, force / model.mass)
        before, now = now, often * (first * now + loose * change) - before
        given_before, given = given, often * (first * given + change) - given_before
        often = 2.0
    return (state.v + given) / (1 + PEAK)


def _loose(model: Model, drives: Mapping[str, Drive], substep: int) -> Tensor:
    """[V, 1]: 1, or 0 for a vertex that a boundary will hold and that does not yield."""
    out = model.mass.new_ones(model.mass.shape[-2:])
    for name, boundary in model.boundaries.items():
        index = boundary.held(drives.get(name), substep)
        out = out if index is None else out.index_fill(-2, index, 0.0)
    return out


def _viscous_forces(model: Model, s: Surface, x: Tensor, v: Tensor, memory: Memory) -> Tensor:
    """Of all effects, at other velocities v [..., V, 3] than the cloth's."""
    total = torch.zeros_like(v)
    for name, (effect, c) in model.effects.items():
        force = effect.viscous(c, Moment(x, v, s, model.mass, memory.get(f"effects.{name}")))
        total = total if force is None else total + force
    return total
