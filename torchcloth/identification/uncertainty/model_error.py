"""What two simulators of one cloth differ by: an error of the estimates that no residual shows.

Triangles, grid and step of another simulator bend and stretch the same fabric a little otherwise, and so does the
fabric. A fit absorbs that in its parameters. Its residuals look like noise, so the standard error must count it. A grip
that turns or yields acts alike: the cloth near it stretches otherwise, as a softer or stiffer membrane would.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ...episodes.unknowns import Unknown
from ...materials.director import DirectorMaterial


@dataclass(frozen=True)
class ModelErrors:
    """Relative standard deviations of a parameter between simulators of the same laws.

    They are from fits to recordings of the independent engine without a fault.

    Attributes:
        bending: of parameters of bending; hinges of coarse triangles differ most.
        other: of all other parameters.
        grip_compliance: of parameters of the material, where it is unknown how far grippers hold the cloth. Corners
            that turn as hinges gave E h 0.72 to 0.80 of the truth (``studies strangers``, seeds 10 and 28).
        contact: of k, gamma and c_F. Layers press by 3 % less or more in another attitude in the grid, also of one
            simulator (``studies fabrics``, 20 places and attitudes).
    """

    bending: float = 0.15
    other: float = 0.05
    grip_compliance: float = 0.2
    contact: float = 0.03

    def of(self, unknown: Unknown, has_unknown_grips: bool) -> float:
        """Return the relative standard deviation of a parameter."""
        error = self.bending if unknown.name.startswith("bending") else self.other
        if unknown.name in DirectorMaterial.contact_parameters:
            error = math.hypot(error, self.contact)
        is_material = unknown.key.startswith("material.")
        return math.hypot(error, self.grip_compliance) if has_unknown_grips and is_material else error


MODEL_ERRORS = ModelErrors()
# of recordings that this library simulated, with the same laws
SAME_SIMULATOR = ModelErrors(bending=0.0, other=0.0, grip_compliance=0.0)


def add_model_error(
    unknowns: Sequence[Unknown],
    raw: Tensor,
    covariance: Tensor,
    errors: ModelErrors = MODEL_ERRORS,
    has_unknown_grips: bool = False,
) -> Tensor:
    """Return a covariance [K, K] that includes the errors between simulators, which are taken as independent.

    Args:
        unknowns: the fitted parameters. One that was measured beforehand is not subject to the simulator.
        raw: [K] unconstrained solution.
        covariance: [K, K] of it.
        errors: how large the errors are.
        has_unknown_grips: whether it is unknown how far grippers hold the cloth.
    """
    variances = torch.zeros(len(raw), dtype=covariance.dtype)
    for k, (unknown, value) in enumerate(zip(unknowns, raw.tolist(), strict=False)):
        if not unknown.measured:
            variances[k] = (errors.of(unknown, has_unknown_grips) * unknown.value(value) / unknown.slope(value)) ** 2
    return covariance + torch.diag(variances)
