"""Creases that stay."""

from __future__ import annotations

import math
from typing import Any, cast

import torch
from torch import Tensor

from .._utils.linalg import safe_norm
from ..errors import InvalidInput
from ..parameters import PhysicalParameter
from ..types import EffectInputs
from .base import Amplitude, require_memory
from .bending import Bending, Coefficients


class CreasingBending(Bending):
    """Bending of a sheet that flows where it is bent too far: it keeps creases, in the material.

    With the elastic curvature e = k - k0 (k along the normal, k0 the rest curvature, curl and creases together) the
    creases grow as k0' = mobility (|e| - k_y)+ e / |e|: Bingham's law, of which only the excess flows. It is integrated
    exactly over a substep. Bent to k for a time t, a sheet keeps k0 = (k - k_y) (1 - exp(-mobility t)); below k_y
    nothing stays. A moment M_y = B k_y belongs to k_y; |e|^2 = e_ww^2 + e_ff^2 + 2 e_wf^2.

    Args:
        stiffness: as for ``Bending``.
        mobility: 1 / tau_p [1/s], >= 0.
        yield_curvature: k_y [1/m], > 0, a constant.
        **options: all others of ``Bending``.

    Raises:
        InvalidInput: values out of range.
    """

    amplitudes = {
        "mobility": Amplitude("1/s", 10.0, 0.1, ("rest_curvature", "internal_friction")),
        **Bending.amplitudes,
    }

    def __init__(
        self,
        stiffness: float | Tensor = 1e-5,
        mobility: float | Tensor = 1.0,
        yield_curvature: float = 100.0,
        **options: Any,
    ) -> None:
        super().__init__(stiffness, **options)
        if not 0 < yield_curvature < math.inf:
            raise InvalidInput("yield_curvature", got=f"{yield_curvature} 1/m", expected="a value > 0")
        self.mobility = PhysicalParameter(mobility, "1/s", "nonnegative", name="crease mobility")
        self.yield_curvature = float(yield_curvature)

    def has_rest_curvature(self) -> bool:
        """Always, it may have creases."""
        return True

    def coefficients(self) -> Coefficients:
        """Those of the elastic sheet, and the mobility [..., 1, 1] 1/s."""
        return super().coefficients()._replace(mobility=self.mobility.field)

    def initial_memory(self, x: Tensor) -> Tensor:
        """[..., V, 3]: creases [1/m] along ww, ff, sqrt 2 wf; none."""
        return torch.zeros_like(x)

    def update_memory(self, c: Coefficients, now: EffectInputs) -> Tensor:
        """The excess of the elastic curvature flows into the crease."""
        crease, curl, mobility = require_memory(now), cast("Tensor", c.curl), cast("Tensor", c.mobility)
        elastic = self.stencil.fit_surface(now.x, now.compensation).curvature - curl - crease
        size = safe_norm(elastic)
        bent = size > self.yield_curvature
        excess = torch.where(bent, 1 - self.yield_curvature / torch.where(bent, size, 1.0), 0.0)
        return crease - torch.expm1(-mobility * now.dt) * excess * elastic

    def rest_curvature(self, curl: Tensor, now: EffectInputs) -> Tensor:
        """Curl and creases."""
        return curl + require_memory(now)

    def energy(self, c: Coefficients, x: Tensor, memory: Tensor | None = None) -> Tensor:
        """Bending energy [...] J of a sheet with the creases ``memory`` [..., V, 3] 1/m; None: of a virgin one."""
        return super().energy(c if memory is None else c._replace(curl=cast("Tensor", c.curl) + memory), x)

    def extra_repr(self) -> str:
        """One line of the data sheet."""
        return f"{super().extra_repr()}, yield_curvature={self.yield_curvature:g} 1/m"
