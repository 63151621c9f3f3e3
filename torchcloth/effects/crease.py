"""Creases: bending that leaves a permanent rest curvature."""

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
    """Bending of a sheet that flows where it is bent beyond a yield curvature, and keeps creases in the material.

    With the elastic curvature e = k - k0 (k along the normal, k0 the rest curvature of curl and creases together) the
    creases grow as k0' = mobility (|e| - k_y)+ e / |e|. This is Bingham's law: only the excess over k_y flows. It is
    integrated exactly over a substep. A sheet that is bent to k for a time t keeps k0 = (k - k_y) (1 - exp(-mobility
    t)); below k_y no crease forms. The yield moment is M_y = B k_y; |e|^2 = e_ww^2 + e_ff^2 + 2 e_wf^2.

    Args:
        stiffness: as for ``Bending``.
        mobility: 1 / tau_p [1/s], >= 0.
        yield_curvature: k_y [1/m], > 0, a constant.
        **options: all others of ``Bending``.

    Raises:
        InvalidInput: values out of range.
    """

    amplitudes = {
        "mobility": Amplitude(
            unit="1/s",
            typical=10.0,
            confounded_with=("rest.curl", "fric.internal_bend"),
            cause="plast.crease",
            title="Creases",
            description="Sharp folds stay: the cloth's rest shape follows strong bending.",
            diagnosis_typical=5.0,
        ),
        **Bending.amplitudes,
    }

    def __init__(
        self,
        stiffness: float | Tensor = 1e-5,
        *,
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
        """Return True: the sheet may have creases."""
        return True

    def coefficients(self) -> Coefficients:
        """Return the coefficients of ``Bending``, and the mobility [..., 1, 1] 1/s."""
        return super().coefficients()._replace(mobility=self.mobility.field)

    def initial_memory(self, x: Tensor) -> Tensor:
        """Return creases of a new cloth, zero: [..., V, 3] 1/m along ww, ff, sqrt 2 wf."""
        return torch.zeros_like(x)

    def update_memory(self, c: Coefficients, inputs: EffectInputs) -> Tensor:
        """Let the excess of the elastic curvature flow into the crease."""
        crease, curl, mobility = require_memory(inputs), cast("Tensor", c.curl), cast("Tensor", c.mobility)
        elastic = self.stencil.fit_surface(inputs.x, inputs.compensation).curvature - curl - crease
        size = safe_norm(elastic)
        yields = size > self.yield_curvature
        excess = torch.where(yields, 1 - self.yield_curvature / torch.where(yields, size, 1.0), 0.0)
        return crease - torch.expm1(-mobility * inputs.dt) * excess * elastic

    def rest_curvature(self, curl: Tensor, inputs: EffectInputs) -> Tensor:
        """Return the rest curvature of curl and creases together, [..., V, 3] 1/m."""
        return curl + require_memory(inputs)

    def energy(self, c: Coefficients, x: Tensor, memory: Tensor | None = None) -> Tensor:
        """Compute the bending energy [...] J of a sheet with creases ``memory`` [..., V, 3] 1/m; None: without."""
        return super().energy(c if memory is None else c._replace(curl=cast("Tensor", c.curl) + memory), x)

    def extra_repr(self) -> str:
        """Return the line of the data sheet: what ``Bending`` says, and the yield curvature."""
        return f"{super().extra_repr()}, yield_curvature={self.yield_curvature:g} 1/m"
