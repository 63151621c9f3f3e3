"""A force of unknown origin."""

from __future__ import annotations

from torch import Tensor

from ..errors import InvalidInput
from ..meshes import Mesh
from ..parameters import PhysicalParameter
from ..types import EffectInputs
from .base import AbstractEffect, Amplitude


class BodyForce(AbstractEffect):
    """A given acceleration in world axes, f = m a: what pushes the cloth and has no name.

    ``tc.estimate_pose`` finds the one that a recording needs beside the model; where it is large, the model is wrong.

    Args:
        acceleration: [..., V, 3] m/s^2, one for each vertex, or [..., 1, 3], the same everywhere. Learnable.

    Raises:
        InvalidInput: another shape, or a number that is not finite.
    """

    amplitudes = {"acceleration": Amplitude("m/s^2", 1.0, 0.05, ("gravity.acceleration", "air.wind"))}

    def __init__(self, acceleration: Tensor) -> None:
        super().__init__()
        if not isinstance(acceleration, Tensor):
            raise InvalidInput("acceleration", got=type(acceleration).__name__, expected="a tensor [V or 1, 3] m/s^2")
        if acceleration.ndim < 2 or acceleration.shape[-1] != 3:
            raise InvalidInput("acceleration", got=f"shape {tuple(acceleration.shape)}", expected="[V or 1, 3] m/s^2")
        self.acceleration = PhysicalParameter(
            acceleration, "m/s^2", "real", name="acceleration of a body force", axes=2
        )

    def bind(self, mesh: Mesh) -> BodyForce:
        """Check that there is one for each vertex, or one for all."""
        rows, vertices = self.acceleration.raw.shape[-2], len(mesh.vertices)
        if rows not in (1, vertices):
            raise InvalidInput("acceleration", got=f"{rows} rows", expected=f"{vertices}, one per vertex, or 1")
        return self

    def coefficients(self) -> Tensor:
        """[..., V or 1, 3] m/s^2."""
        return self.acceleration.value

    def force(self, c: Tensor, now: EffectInputs) -> Tensor:
        """m a on each vertex."""
        return now.mass * c
