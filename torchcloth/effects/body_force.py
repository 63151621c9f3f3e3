"""Body force: a given acceleration of every vertex."""

from __future__ import annotations

from torch import Tensor

from ..errors import InvalidInput
from ..meshes import Mesh
from ..parameters import PhysicalParameter
from ..types import EffectInputs
from .base import AbstractEffect, Amplitude


class BodyForce(AbstractEffect):
    """A given acceleration in world axes, f = m a, for forces of unknown origin.

    ``tc.estimate_pose`` estimates the one that a recording needs in addition to the model. Where it is large, the model
    is wrong.

    Args:
        acceleration: [..., V, 3] m/s^2 for each vertex, or [..., 1, 3] for all. Learnable.

    Raises:
        InvalidInput: another shape, or a number that is not finite.
    """

    amplitudes = {
        "acceleration": Amplitude(
            unit="m/s^2", typical=1.0, smallest=0.05, confounded_with=("Gravity.acceleration", "air.wind")
        )
    }

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
        """Check that there is one acceleration for each vertex or one for all, and return self.

        Raises:
            InvalidInput: another number of rows.
        """
        rows, vertices = self.acceleration.raw.shape[-2], len(mesh.vertices)
        if rows not in (1, vertices):
            raise InvalidInput("acceleration", got=f"{rows} rows", expected=f"{vertices}, one per vertex, or 1")
        return self

    def coefficients(self) -> Tensor:
        """Return the acceleration, [..., V or 1, 3] m/s^2."""
        return self.acceleration.value

    def force(self, c: Tensor, inputs: EffectInputs) -> Tensor:
        """Return m a on each vertex."""
        return inputs.mass * c
