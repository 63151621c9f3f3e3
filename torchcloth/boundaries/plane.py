"""A flat obstacle, such as a table."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Unpack

from torch import Tensor

from .._utils.linalg import dot
from .._utils.vectors import parse_unit_vector, parse_vector
from ..errors import InvalidInput
from .collider import AbstractCollider, ColliderOptions
from .friction import Coulomb, Elliptic


class Plane(AbstractCollider):
    """A half-space that cloth cannot enter, with friction.

    Args:
        point: [3] m, any point of the surface.
        normal: [3], pointing to the free side; normalised here.
        friction: Coulomb coefficient >= 0, or a law; ``Elliptic`` for one that depends on the direction.
        options: as for every collider (``AbstractCollider``).

    Raises:
        InvalidInput: zero normal, negative friction, a friction axis that leaves the plane.
    """

    def __init__(
        self,
        point: Sequence[float] = (0.0, 0.0, 0.0),
        normal: Sequence[float] = (0.0, 0.0, 1.0),
        friction: float | Coulomb = 0.4,
        **options: Unpack[ColliderOptions],
    ) -> None:
        super().__init__(friction, **options)
        self.register_buffer("point", parse_vector("plane point", point), persistent=False)
        self.register_buffer("normal", parse_unit_vector("plane normal", normal), persistent=False)
        self.point: Tensor
        self.normal: Tensor
        if isinstance(friction, Elliptic) and float((friction.axis * self.normal).sum().abs()) > 1e-5:
            raise InvalidInput("friction axis", got=friction.axis.tolist(), expected="a direction in the plane")

    def distance(self, p: Tensor) -> tuple[Tensor, Tensor]:
        """Return the height over the plane, and its normal."""
        return dot(p - self.point, self.normal), self.normal.expand_as(p)

    def extra_repr(self) -> str:
        """Return the line of the data sheet: point and normal."""
        return f"point={self.point.tolist()} m, normal={self.normal.tolist()}, {super().extra_repr()}"
