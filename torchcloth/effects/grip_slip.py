"""A gripper that does not hold perfectly."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from .._utils.linalg import dot, apply_added_mass, safe_norm, matvec
from ..parameters import PhysicalParameter
from .base import AbstractEffect, Amplitude


class Coefficients(NamedTuple):
    """Of the parameters, each [..., 1, 1]."""

    mobility: Tensor
    hold: Tensor


class GripSlip(AbstractEffect):
    """The held patch creeps out of a gripper along the pull F beyond what it can hold: u = mobility (|F| - hold).

    A Bingham law for the patch as one body, implicit in u, so that any mobility is stable: with the impulse J that
    holding the patch of mass M needs in one step, u = b (|J| / dt - hold) / (1 + b M / dt) against J. Mobility 0 is a
    perfect grip; without bound, the grip becomes dry friction of force ``hold``. The patch stays the same vertices and
    slides without turning; while ``Cloth.settle`` runs it holds. Air that moves along (``AddedMass``) counts in
    the patch's mass, as far as the pull moves it.

    Args:
        grasp: name of the cloth's ``Grasp`` boundary.
        mobility: b [m/(N s)], >= 0: a number, or [B, 1] for a batch, like ``hold``.
        hold: [N], >= 0, the pull that the gripper bears without slipping.

    Raises:
        InvalidInput: negative values; a cloth without that grasp (when the cloth is made).
    """

    amplitudes = {
        "mobility": Amplitude(
            "m/(N s)", 0.01, 0.001, ("rest_shape.shrink_warp", "rest_shape.shrink_weft", "robot.base")
        ),
        "hold": Amplitude("N", 1.0, 0.1),
    }
    per_triangle = ()

    def __init__(self, grasp: str, mobility: float | Tensor = 0.01, hold: float | Tensor = 1.0) -> None:
        super().__init__()
        self.grasp = grasp
        self.mobility = PhysicalParameter(mobility, "m/(N s)", "nonnegative", name="grip mobility")
        self.hold = PhysicalParameter(hold, "N", "nonnegative", name="grip holding force")

    def coefficients(self) -> Coefficients:
        """The parameters as fields."""
        return Coefficients(self.mobility.field, self.hold.field)

    def grip_compliance(self, c: Coefficients) -> float:
        """The mobility."""
        return float(c.mobility.detach().max())

    def grip_velocities(
        self,
        c: Coefficients,
        index: Tensor,
        free: Tensor,
        gripped: Tensor,
        mass: Tensor,
        dt: float,
        added_mass_ratio: Tensor | None,
    ) -> Tensor:
        """The patch moves on with the same velocity all over, so that its pull falls to what the law says."""
        patch = mass.index_select(-2, index)
        air = None if added_mass_ratio is None else added_mass_ratio.index_select(-3, index)
        change = (gripped - free).index_select(-2, index)
        impulse = (patch * apply_added_mass(air, change)).sum(-2, keepdim=True)
        size = safe_norm(impulse)
        inertia = patch.sum(-2, keepdim=True)
        if air is not None:
            way = impulse / torch.where(size > 0, size, 1.0)
            inertia = inertia + dot(way, matvec((patch.unsqueeze(-1) * air).sum(-3, keepdim=True), way))
        slips = size > c.hold * dt
        excess = torch.where(slips, 1 - c.hold * dt / torch.where(slips, size, 1.0), 0.0)
        creep = -(c.mobility * excess / (dt + c.mobility * inertia)) * impulse
        creep = creep.expand(*creep.shape[:-2], len(index), 3)
        return gripped.expand(*creep.shape[:-2], -1, -1).index_add(-2, index, creep)

    def extra_repr(self) -> str:
        """One line of the data sheet."""
        return f"grasp={self.grasp!r}"
