"""Adhesion: a plane that pulls cloth near it, such as a table."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from .._utils.vectors import parse_unit_vector, parse_vector
from ..errors import InvalidInput
from ..meshes import Mesh
from ..parameters import PhysicalParameter
from ..types import EffectInputs
from .base import AbstractEffect, Amplitude

MAX_PULL_SLOPE = 8 / 3 / 3**0.5  # dimensionless, of (1 - u^2)^2, at u = 3^-1/2


class Adhesion(AbstractEffect):
    """Pull of a plane on cloth near it, by charge, moisture or fibres that catch.

        t = -stress (1 - (d / gap)^2)^2 n,  0 < d < gap; the full stress at d <= 0

    per area at rest, with d the height over the plane. Adhesion resists lifting, and adds to the pressure on the plane,
    so that friction grows (Derjaguin, Muller and Toporov 1975: mu (N + stress A)). Charges of 5e-6 C/m^2 make 1.4 Pa,
    the weight of a light cloth; wet cloth has 100 to 1000 Pa. Lifting costs the energy 8/15 stress gap per area. A
    collider's ``offset`` counts as height: half a gap above the plane cloth feels 56 % of the stress, at a whole gap
    none.

    Args:
        stress: adhesive stress [Pa], >= 0; a scalar, or [B, 1] for a batch.
        gap: range of the pull [m].
        point: [3] m, any point of the plane, such as a ``Plane``'s.
        normal: [3], towards the free side; normalised here.

    Raises:
        InvalidInput: negative stress, a gap that is not positive, a zero normal.
    """

    amplitudes = {
        "stress": Amplitude(
            unit="Pa",
            typical=1.5,
            confounded_with=("contact.mu",),
            cause="contact.adhesion",
            title="Adhesion to the table",
            description="Cloth that touches the table is pulled to it: a charge, moisture, or fibres that catch.",
        ),
    }
    per_triangle = ()

    def __init__(
        self,
        stress: float | Tensor = 1.5,
        gap: float = 1e-3,
        *,
        point: Sequence[float] = (0.0, 0.0, 0.0),
        normal: Sequence[float] = (0.0, 0.0, 1.0),
    ) -> None:
        super().__init__()
        if not 0 < gap < math.inf:
            raise InvalidInput("adhesion gap", got=f"{gap:g} m", expected="a length > 0")
        self.stress = PhysicalParameter(stress, "Pa", "nonnegative", name="adhesion stress")
        self.gap = float(gap)
        self.register_buffer("point", parse_vector("adhesion point", point), persistent=False)
        self.register_buffer("normal", parse_unit_vector("adhesion normal", normal), persistent=False)
        self.register_buffer("area", torch.zeros(0, 1), persistent=False)
        self.point: Tensor
        self.normal: Tensor
        self.area: Tensor  # [V, 1] m^2, at rest

    def bind(self, mesh: Mesh) -> Adhesion:
        """Resolve the area of each vertex, a third of its triangles, and return self."""
        area = np.asarray(mesh.vertex_area)
        self.area = torch.as_tensor(area, dtype=self.normal.dtype, device=self.normal.device).unsqueeze(-1)
        return self

    def coefficients(self) -> Tensor:
        """Return the stress, [..., 1, 1] Pa."""
        return self.stress.field

    def force(self, c: Tensor, inputs: EffectInputs) -> Tensor:
        """Return the pull on each vertex."""
        height = (inputs.x - self.point) @ self.normal.unsqueeze(-1)
        u = (height / self.gap).clamp(0.0, 1.0)
        return -(c * self.area * (1 - u * u) ** 2) * self.normal

    def stability_bounds(self, c: Tensor, mass: Tensor) -> tuple[Tensor, Tensor]:
        """Bound omega^2 by the steepest slope of the pull."""
        return MAX_PULL_SLOPE / self.gap * (c * self.area / mass).amax(), mass.new_zeros(())

    def extra_repr(self) -> str:
        """Return the line of the data sheet: gap and plane."""
        return f"gap={self.gap:g} m, point={self.point.tolist()} m, normal={self.normal.tolist()}"
