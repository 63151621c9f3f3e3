"""Viscous forces in stages: stabilised explicit damping, where substeps would have to be short for damping alone.

An explicit substep multiplies velocities by 1 - dt D, D the matrix of viscous forces over mass. That is stable for
dt c <= 2, c the largest damping rate. Here P(dt D) stands in its place:

    P(z) = (1 + T_n(w_0 - w_1 z)) / (1 + T_n(w_0)),  T_n Chebyshev's polynomial

n applications of D reach dt c of 0.8 n^2, where n shorter steps would reach 2 n. To first order P is exp(-z), as 1 - z
is. P is never negative, so elastic forces are left 2 of the 4 in 4 - 2 (1 - P) - omega^2 dt^2 > 0. With T_n(w_0) = 3 no
more than half is left of what is damped fast (van der Houwen and Sommeijer 1980 leave 95 %).

P acts on the velocities v at the start of the substep, which the boundaries left. The other forces f are computed from
the same state, and both changes are added (``substep.step``): v_new = P(dt D) v + dt M^-1 f, with M the mass of cloth
and air. The stages do not act on dt M^-1 f: these forces push the gripped vertices as well, and stages would carry that
on to their neighbours. In every stage a gripped vertex keeps its prescribed velocity as seen by its neighbours. The
force on it is accumulated separately, because it contributes to the gripper wrench.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from .._utils.linalg import solve_added_mass
from ..boundaries import PrescribedMotion
from ..types import ClothState, EffectInputs, Memory, Surface
from .model import Model

CHEBYSHEV_PEAK = 3.0  # T_n(w_0); see above
MAX_STAGES = 16


class StagePolynomial(NamedTuple):
    """P(z) = (1 + T_n(offset - slope z)) / (1 + CHEBYSHEV_PEAK).

    Attributes:
        offset: w_0.
        slope: w_1.
    """

    offset: float
    slope: float

    @classmethod
    def for_stages(cls, stages: int) -> StagePolynomial:
        """Return the polynomial that applies D ``stages`` times."""
        angle = math.acosh(CHEBYSHEV_PEAK) / stages
        derivative = stages * math.sinh(stages * angle) / math.sinh(angle)  # of T_n at w_0
        return cls(math.cosh(angle), (1 + CHEBYSHEV_PEAK) / derivative)

    @property
    def largest_rate(self) -> float:
        """Largest z = dt c for which -1 <= T_n, dimensionless."""
        return (self.offset + 1) / self.slope


def apply_viscous_stages(
    model: Model,
    state: ClothState,
    s: Surface,
    memory: Memory,
    dt: float,
    prescribed: Mapping[str, PrescribedMotion],
    substep: int,
    added_mass_ratio: Tensor | None,
) -> Tensor:
    """Return P(dt D) v, [..., V, 3] m/s, with the viscous forces of all effects; v itself if the model has no stages.

    The three-term recurrence of Chebyshev's polynomials runs twice: for the velocities that neighbours see, in which
    gripped vertices do not change, and for those that sum the forces on gripped vertices too.
    """
    if not model.stages:
        return state.v
    offset, slope = StagePolynomial.for_stages(model.stages)
    is_free = model.mass.new_ones(model.mass.shape[-2:])  # [V, 1], 0 for vertices whose velocity a boundary prescribes
    for name, boundary in model.boundaries.items():
        index = boundary.prescribed_vertices(prescribed.get(name), substep)
        is_free = is_free if index is None else is_free.index_fill(-2, index, 0.0)

    seen_before, seen, factor = torch.zeros_like(state.v), state.v, 1.0
    summed_before, summed = seen_before, seen
    for _ in range(model.stages):
        force = torch.zeros_like(seen)
        for name, (effect, c) in model.effects.items():
            inputs = EffectInputs(state.x, seen, s, model.mass, memory.get(f"effects.{name}"))
            viscous = effect.viscous(c, inputs)
            force = force if viscous is None else force + viscous
        change = dt * slope * solve_added_mass(added_mass_ratio, force / model.mass)
        seen_before, seen = seen, factor * (offset * seen + is_free * change) - seen_before
        summed_before, summed = summed, factor * (offset * summed + change) - summed_before
        factor = 2.0
    return (state.v + summed) / (1 + CHEBYSHEV_PEAK)
