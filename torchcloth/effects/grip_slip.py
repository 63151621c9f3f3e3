"""Grip slip: a gripper out of which the cloth creeps."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from .._utils.linalg import apply_added_mass, dot, matvec, safe_norm
from ..parameters import PhysicalParameter
from .base import AbstractEffect, Amplitude


class Coefficients(NamedTuple):
    """Parameters as fields.

    Attributes:
        mobility: [..., 1, 1] m/(N s).
        hold: [..., 1, 1] N.
    """

    mobility: Tensor
    hold: Tensor


class GripSlip(AbstractEffect):
    """The gripped patch creeps out of a gripper when the pull F exceeds a threshold: u = mobility (|F| - hold).

    This is a Bingham law for the patch as one body, implicit in u, so that any mobility is stable. With the impulse J
    that fixing the patch of mass M needs in one step, u = b (|J| / dt - hold) / (1 + b M / dt) against J. Mobility 0 is
    a perfect grip; for a mobility without bound the grip becomes dry friction of force ``hold``. The patch keeps its
    vertices and slides without turning. It does not slip while ``Cloth.settle`` runs. Added mass (``AddedMass``) counts
    in the patch's mass, as far as the pull moves the air.

    Args:
        grasp: name of the cloth's ``Grasp`` boundary.
        mobility: b [m/(N s)], >= 0; a scalar, or [B, 1] for a batch, as ``hold``.
        hold: pull that the gripper bears without slipping [N], >= 0.

    Raises:
        InvalidInput: negative values; a cloth without that grasp (when the cloth is made).
    """

    amplitudes = {
        "mobility": Amplitude(
            unit="m/(N s)",
            typical=0.01,
            confounded_with=("rest.shrink", "obs.extrinsic"),
            cause="grip.slip",
            title="Slip in the grippers",
            description="The cloth creeps out of the grippers under a strong pull.",
            diagnosis_typical=0.05,
        ),
        "hold": Amplitude(unit="N", typical=1.0, smallest=0.1),
    }
    per_triangle = ()

    def __init__(self, grasp: str, mobility: float | Tensor = 0.01, hold: float | Tensor = 1.0) -> None:
        super().__init__()
        self.grasp = grasp
        self.mobility = PhysicalParameter(mobility, "m/(N s)", "nonnegative", name="grip mobility")
        self.hold = PhysicalParameter(hold, "N", "nonnegative", name="grip holding force")

    def coefficients(self) -> Coefficients:
        """Return the parameters as fields."""
        return Coefficients(self.mobility.field, self.hold.field)

    def grip_compliance(self, c: Coefficients) -> float:
        """Return the mobility, [m/(N s)]."""
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
        """Let the whole patch creep with one velocity, so that its pull falls to what the law allows."""
        patch = mass.index_select(-2, index)
        air = None if added_mass_ratio is None else added_mass_ratio.index_select(-3, index)
        change = (gripped - free).index_select(-2, index)
        impulse = (patch * apply_added_mass(air, change)).sum(-2, keepdim=True)
        size = safe_norm(impulse)
        inertia = patch.sum(-2, keepdim=True)
        if air is not None:
            direction = impulse / torch.where(size > 0, size, 1.0)
            air_mass = (patch.unsqueeze(-1) * air).sum(-3, keepdim=True)
            inertia = inertia + dot(direction, matvec(air_mass, direction))
        slips = size > c.hold * dt
        excess = torch.where(slips, 1 - c.hold * dt / torch.where(slips, size, 1.0), 0.0)
        creep = -(c.mobility * excess / (dt + c.mobility * inertia)) * impulse
        creep = creep.expand(*creep.shape[:-2], len(index), 3)
        return gripped.expand(*creep.shape[:-2], -1, -1).index_add(-2, index, creep)

    def extra_repr(self) -> str:
        """Return the line of the data sheet: name of the grasp."""
        return f"grasp={self.grasp!r}"
