"""Laws of dry friction: by how much an impulse along the normal reduces the slip."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from .._utils.linalg import dot, safe_norm
from .._utils.vectors import parse_unit_vector
from ..errors import InvalidInput
from ..parameters import PhysicalParameter


class Coulomb(PhysicalParameter):
    """Coulomb's law with stick and slip: the tangential impulse is at most mu times the normal one.

    Args:
        friction: mu [-], >= 0; a batch is [B, 1].

    Raises:
        InvalidInput: a negative coefficient, or another shape.
    """

    def __init__(self, friction: float | Tensor) -> None:
        super().__init__(friction, "-", "nonnegative", name="friction")
        check_scalar("friction", self)

    def slip_reduction(self, slip: Tensor, push: Tensor) -> Tensor:
        """Return the fraction of the slip that friction removes, [..., N, 1]; 1 where the surfaces stick.

        Args:
            slip: [..., N, 3] m/s, tangential velocity relative to the body before friction, in the body's axes.
            push: [..., N, 1] m/s, change of the normal velocity by the contact, >= 0.
        """
        size = self._size(slip)
        limit = self._coefficient(size) * push
        sticks = (size <= limit) & (limit > 0)
        return torch.where(sticks, 1.0, limit / torch.where(size > 0, size, 1.0))

    def _size(self, slip: Tensor) -> Tensor:
        return safe_norm(slip)

    def _coefficient(self, size: Tensor) -> Tensor:
        return per_point(self.value)


class Stribeck(Coulomb):
    """Friction that falls with the speed: mu = kinetic + (static - kinetic) exp(-(|slip| / speed)^2).

    ``static == kinetic`` is Coulomb's law, bitwise. Stribeck 1902, in the form of Bo and Pavelescu 1982.

    Args:
        kinetic: mu of fast slip [-], >= 0.
        static: mu at rest [-], >= kinetic.
        speed: at which the excess has fallen to 1 / e [m/s].

    Raises:
        InvalidInput: a coefficient or speed outside its range.
    """

    def __init__(self, kinetic: float, static: float, speed: float = 0.01) -> None:
        super().__init__(kinetic)
        self.excess = PhysicalParameter(static - kinetic, "-", "nonnegative", name="static minus kinetic friction")
        self.speed = PhysicalParameter(speed, "m/s", name="speed of the Stribeck law")

    def _coefficient(self, size: Tensor) -> Tensor:
        decay = torch.exp(-((size / per_point(self.speed.value)) ** 2))
        return per_point(self.value) + per_point(self.excess.value) * decay


class Elliptic(Coulomb):
    """Friction that depends on the direction of slip: an elliptical cone, for planes.

    The law is not associated: the force opposes the slip, with the size of the cone in that direction, and slip is
    never deflected. ``across == along`` is Coulomb's law, bitwise. On other solids the part of the slip along the axis
    counts as along. Where the axis is the surface's normal, all slip is across.

    Args:
        along: mu of slip along ``axis`` [-], > 0; a batch is [B, 1].
        across: mu of slip perpendicular to it [-], > 0; a batch is [B, 1].
        axis: [3], in the surface, in the shape's own coordinates; normalised here.

    Raises:
        InvalidInput: a coefficient that is not positive, or no direction.
    """

    def __init__(self, along: float | Tensor, across: float | Tensor, axis: Sequence[float] = (1.0, 0.0, 0.0)) -> None:
        super().__init__(along)
        if not bool((self.raw > 0).all()):
            raise InvalidInput("along", got=f"{float(self.raw.min()):g}", expected="a coefficient > 0")
        self.ratio = PhysicalParameter(across / along, "-", name="friction across over along")
        self.register_buffer("axis", parse_unit_vector("friction axis", axis), persistent=False)
        self.axis: Tensor

    def _size(self, slip: Tensor) -> Tensor:
        across = slip - dot(slip, self.axis) * self.axis
        return safe_norm(slip + (1 / per_point(self.ratio.value) - 1) * across)


def check_scalar(name: str, parameter: PhysicalParameter) -> None:
    """Check that a parameter is a scalar or a batch of scalars [B, 1].

    Raises:
        InvalidInput: another shape.
    """
    if parameter.raw.ndim and parameter.raw.shape[-1] != 1:
        raise InvalidInput(name, got=f"shape {tuple(parameter.raw.shape)}", expected="a scalar or [B, 1]")


def per_point(value: Tensor) -> Tensor:
    """Return a scalar [] or batch [..., 1] of a body, to broadcast with points [..., N, 1]."""
    return value.unsqueeze(-1) if value.ndim else value
