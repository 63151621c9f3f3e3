"""Air drag: quadratic resistance against motion through the air."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from .._utils.constants import STANDARD_AIR_DENSITY_KG_PER_M3
from .._utils.linalg import dot, safe_norm
from .._utils.vectors import parse_finite_numbers
from ..errors import InvalidInput
from ..meshes import Mesh
from ..parameters import PhysicalParameter
from ..types import EffectInputs
from .base import AbstractEffect, Amplitude


class Coefficients(NamedTuple):
    """What the drag force needs.

    Attributes:
        half_density_cn: [..., 1 or E, 1] kg/m^3, half the air's density times C_n.
        half_density_ct: [..., 1 or E, 1] kg/m^3, half the air's density times C_t.
        wind: [..., 1, 3] m/s, velocity of the air.
    """

    half_density_cn: Tensor
    half_density_ct: Tensor
    wind: Tensor


class AirDrag(AbstractEffect):
    """Quadratic drag against motion through the air: f = -1/2 rho a (C_n |u_n| u_n n + C_t |u_t| u_t).

    ``a`` is the triangle's current area, u = v - wind the velocity of its centroid relative to the air, u_n its normal
    component and u_t its tangential vector. C_t counts both sides of the sheet. The wind is uniform and steady; gusts
    and the sheet's own wake are not modelled. Without drag coefficients a wind does nothing and has no gradient. The
    stable step accounts for the wind but not for the sheet's own speed: in air that suffices, in water it does not.

    Args:
        normal: drag coefficient C_n >= 0; a flat plate has about 1.2.
        density: density of the air [kg/m^3], a constant.
        tangential: friction coefficient C_t >= 0 of both sides together; laminar flow at Re 3e4 has about 0.016.
        wind: [3] m/s, velocity of the air in world axes. Learnable, after ``wind.requires_grad_()``.

    Raises:
        InvalidInput: negative coefficient, non-positive density, or a wind that is not three finite numbers.
    """

    amplitudes = {
        "normal": Amplitude(
            unit="-",
            typical=1.2,
            confounded_with=("air.linear",),
            cause="air.drag_n",
            title="Air drag, normal (C_n)",
            description="Air pushes against cloth that moves broadside, by the square of its speed "
            "(1.2: a flat plate).",
        ),
        "tangential": Amplitude(
            unit="-",
            typical=0.016,
            confounded_with=("air.linear",),
            cause="air.drag_t",
            title="Air drag, tangential (C_t)",
            description="Air rubs along cloth that moves edgewise; as a rule too little to be seen.",
        ),
        "wind": Amplitude(
            unit="m/s",
            typical=0.3,
            confounded_with=("env.gravity_tilt",),
            signed=True,
            cause="air.wind",
            title="Wind",
            description="The air itself moves, along x or y of the world.",
        ),
    }
    per_triangle = ("normal", "tangential")
    world_facts = ("wind",)
    acts_on = "triangles"

    def __init__(
        self,
        normal: float | Tensor = 1.2,
        *,
        density: float = STANDARD_AIR_DENSITY_KG_PER_M3,
        tangential: float | Tensor = 0.0,
        wind: Sequence[float] = (0.0, 0.0, 0.0),
    ) -> None:
        super().__init__()
        if not 0 < density < math.inf:
            raise InvalidInput("air density", got=f"{density} kg/m^3", expected="a value > 0")
        self.normal = PhysicalParameter(normal, "-", "nonnegative", name="air drag coefficient")
        self.tangential = PhysicalParameter(tangential, "-", "nonnegative", name="tangential air drag coefficient")
        velocity = parse_finite_numbers("wind", wind, 3, "three finite numbers in m/s").clone()
        self.wind = nn.Parameter(velocity, requires_grad=False)
        self.density = float(density)
        self.register_buffer("vertex_area", torch.zeros(0, 1), persistent=False)
        self.register_buffer("half_perimeter", torch.zeros(0, 1), persistent=False)
        self.vertex_area: Tensor  # [V, 1] m^2, a third of each vertex's triangles
        self.half_perimeter: Tensor  # [V, 1] m, half the perimeters of each vertex's triangles

    def bind(self, mesh: Mesh) -> AirDrag:
        """Resolve the sizes of the triangles, for the bounds on the wind's effect, and return self."""
        perimeter = np.linalg.norm(np.roll(mesh.rest, -1, axis=1) - mesh.rest, axis=-1).sum(1)
        sizes = (mesh.vertex_area, np.bincount(mesh.faces.ravel(), np.repeat(perimeter / 2, 3)))
        like = {"dtype": torch.get_default_dtype(), "device": self.wind.device}
        self.vertex_area, self.half_perimeter = (torch.as_tensor(size, **like).unsqueeze(-1) for size in sizes)
        return self

    def coefficients(self) -> Coefficients:
        """Return half the air's density times each drag coefficient, and the wind."""
        half = 0.5 * self.density
        return Coefficients(half * self.normal.field, half * self.tangential.field, self.wind.unsqueeze(-2))

    def force(self, c: Coefficients, inputs: EffectInputs) -> Tensor:
        """Return the drag on each triangle."""
        surface = inputs.surface
        relative = surface.v - c.wind
        speed = dot(relative, surface.n)  # u_n
        along = relative - speed * surface.n  # u_t
        area = surface.area * surface.J
        across = c.half_density_cn * area * speed.abs() * speed
        return -across * surface.n - (c.half_density_ct * area * safe_norm(along)) * along

    def stability_bounds(self, c: Coefficients, mass: Tensor) -> tuple[Tensor, Tensor]:
        """Bound the spectrum of a sheet at rest in the wind, by row sums.

        Drag is linear about that state, and its pressure turns with the sheet. With f(u, N) for the area vector N:
        |df/du| <= 2 max(P, Q) |u| a, |df/dN| <= 3 (P + Q) |u|^2, and a corner moves N by half of the opposite edge.
        Both are 0 in still air.
        """
        wind, normal, along = safe_norm(c.wind).amax(), c.half_density_cn.amax(), c.half_density_ct.amax()
        turning = (normal + along) * wind * wind * (self.half_perimeter / mass).amax()
        return turning, 2 * torch.maximum(normal, along) * wind * (self.vertex_area / mass).amax()

    def extra_repr(self) -> str:
        """Return the line of the data sheet: density and wind."""
        wind = [round(value, 6) for value in self.wind.flatten().tolist()]
        return f"density={self.density:g} kg/m^3" + (f", wind={wind} m/s" if any(wind) else "")
