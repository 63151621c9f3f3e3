"""A flat obstacle."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from .._math import safe_norm
from ..errors import InvalidInput
from ..meshes import Mesh
from ..parameters import PhysicalParameter
from .base import AbstractBoundary, Drive


class Plane(AbstractBoundary):
    """A fixed half-space that vertices cannot enter, with Coulomb friction (stick and slip).

    Args:
        point: [3] m, any point of the surface.
        normal: [3], pointing to the free side; normalised here.
        friction: Coulomb coefficient, >= 0.

    Raises:
        InvalidInput: zero normal or negative friction.
    """

    def __init__(
        self,
        point: Sequence[float] = (0.0, 0.0, 0.0),
        normal: Sequence[float] = (0.0, 0.0, 1.0),
        friction: float = 0.4,
    ) -> None:
        super().__init__()
        direction = torch.as_tensor(normal, dtype=torch.get_default_dtype())
        origin = torch.as_tensor(point, dtype=direction.dtype)
        if direction.shape != (3,) or not 0 < float(direction.norm()) < float("inf"):
            raise InvalidInput("plane normal", got=normal, expected="three finite numbers, not all zero")
        if origin.shape != (3,) or not bool(torch.isfinite(origin).all()):
            raise InvalidInput("plane point", got=point, expected="three finite numbers in metres")
        self.friction = PhysicalParameter(friction, "-", "nonnegative", name="friction")
        self.register_buffer("point", origin)
        self.register_buffer("normal", direction / direction.norm())
        self.point: Tensor
        self.normal: Tensor

    def bind(self, mesh: Mesh) -> Plane:
        """Nothing depends on the mesh."""
        return self

    def apply(self, x: Tensor, v: Tensor, dt: float, drive: Drive | None, substep: int) -> Tensor:
        """Stop the approach at the surface; friction takes at most mu times the normal impulse from the slip."""
        height = ((x - self.point) * self.normal).sum(-1, keepdim=True)
        approach = (v * self.normal).sum(-1, keepdim=True)
        push = (-height / dt - approach).clamp(min=0)
        slip = v - approach * self.normal
        speed = safe_norm(slip)
        friction = self.friction.value
        limit = (friction.unsqueeze(-1) if friction.ndim else friction) * push
        moving = speed > limit
        keep = torch.where(moving, 1 - limit / torch.where(moving, speed, 1.0), 0.0)
        slides = torch.where(push > 0, keep, 1.0)
        return slides * slip + (approach + push) * self.normal

    def extra_repr(self) -> str:
        """One line of the data sheet."""
        return f"point={self.point.tolist()} m, normal={self.normal.tolist()}"
