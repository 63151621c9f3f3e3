"""Air that a sheet sets in motion and that lets go of it: added mass with a memory."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchcloth._utils.constants import STANDARD_AIR_DENSITY_KG_PER_M3
from torchcloth._utils.linalg import dot
from torchcloth.effects import AbstractEffect, Amplitude
from torchcloth.effects.base import require_memory
from torchcloth.errors import InvalidInput
from torchcloth.meshes import Mesh
from torchcloth.parameters import PhysicalParameter
from torchcloth.types import EffectInputs


class EntrainedAir(AbstractEffect):
    """A layer of air before and behind the sheet follows its normal speed u with a delay: T dw/dt = u - w.

    The sheet feels what accelerates the layer: t = -rho length (u - w) / T along its normal n. Slow motion (rates far
    below 1/T) feels the added mass rho length, as from ``AddedMass``; fast motion feels a damping of rho length / T
    and no added mass. A sheet that stops is pushed on by its own wake. Drag that depends on the speed alone, and added
    mass, have no such memory.

    Args:
        length: depth of the air layer [m], >= 0.
        time: T [s], > 0, in which the layer follows.
        density: density of the air [kg/m^3], a constant.

    Raises:
        InvalidInput: negative length, or a time or density that is not positive.
    """

    amplitudes = {"length": Amplitude(unit="m", typical=0.15, confounded_with=("air.added_mass", "air.linear"))}
    per_triangle = ()
    acts_on = "triangles"
    faces: Tensor
    vertex_area: Tensor

    def __init__(
        self,
        length: float | Tensor = 0.15,
        time: float | Tensor = 0.25,
        density: float = STANDARD_AIR_DENSITY_KG_PER_M3,
    ) -> None:
        super().__init__()
        if not 0 < density < math.inf:
            raise InvalidInput("air density", got=f"{density} kg/m^3", expected="a value > 0")
        self.length = PhysicalParameter(length, "m", "nonnegative", name="depth of the air that follows")
        self.time = PhysicalParameter(time, "s", "positive", name="time in which the air follows")
        self.density = float(density)

    def bind(self, mesh: Mesh) -> EntrainedAir:
        """Take the triangles, and return self."""
        self.register_buffer("faces", torch.as_tensor(mesh.faces).long().clone(), persistent=False)
        self.register_buffer(
            "vertex_area", torch.as_tensor(mesh.vertex_area, dtype=torch.float64)[:, None].clone(), persistent=False
        )
        return self

    def coefficients(self) -> tuple[Tensor, Tensor]:
        """Return mass of the layer per area [kg/m^2] and time [s], both [..., 1, 1]."""
        return self.density * self.length.field, self.time.field

    def initial_memory(self, x: Tensor) -> Tensor:
        """Return the layer's normal speed [m/s] and acceleration [m/s^2] over each triangle, [..., E, 2]: at rest."""
        return x.new_zeros(*x.shape[:-2], len(self.faces), 2)

    def update_memory(self, c: tuple[Tensor, Tensor], inputs: EffectInputs) -> Tensor:
        """Let the layer follow; exact for a sheet of constant speed."""
        w = require_memory(inputs)[..., :1]
        speed = dot(inputs.v[..., self.faces, :].mean(-2), inputs.surface.n)
        rate = -torch.expm1(-inputs.dt / c[1]) / inputs.dt if inputs.dt else 1 / c[1]
        acceleration = rate * (speed - w)
        return torch.cat([w + inputs.dt * acceleration, acceleration], dim=-1)

    def force(self, c: tuple[Tensor, Tensor], inputs: EffectInputs) -> Tensor:
        """Return the force of the layer on each triangle: it takes from the sheet what momentum the layer gains."""
        return -c[0] * inputs.surface.area * require_memory(inputs)[..., 1:] * inputs.surface.n

    def stability_bounds(self, c: tuple[Tensor, Tensor], mass: Tensor) -> tuple[Tensor, Tensor]:
        """Bound the damping rate by that of a layer at rest."""
        return mass.new_zeros(()), (c[0] / c[1] * self.vertex_area / mass).amax()
