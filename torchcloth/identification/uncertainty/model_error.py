"""What two simulators of one cloth differ by: an error of the estimates that no residual shows.

Triangles, grid and step of another simulator bend and stretch the same fabric a little otherwise, and so does the
fabric. A fit absorbs that in its parameters. Its residuals look like noise, so the standard error must count it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ...episodes.unknowns import Unknown


@dataclass(frozen=True)
class ModelErrors:
    """Relative standard deviations of a parameter between simulators of the same laws.

    They are from fits to recordings of the independent engine without a fault.

    Attributes:
        bending: of parameters of bending; hinges of coarse triangles differ most.
        other: of all other parameters.
    """

    bending: float = 0.15
    other: float = 0.05


MODEL_ERRORS = ModelErrors()
SAME_SIMULATOR = ModelErrors(bending=0.0, other=0.0)  # of recordings that this library simulated, with the same laws


def add_model_error(
    unknowns: Sequence[Unknown], raw: Tensor, covariance: Tensor, errors: ModelErrors = MODEL_ERRORS
) -> Tensor:
    """Return a covariance [K, K] that includes the errors between simulators, which are taken as independent.

    Args:
        unknowns: the fitted parameters. One that was measured beforehand is not subject to the simulator.
        raw: [K] unconstrained solution.
        covariance: [K, K] of it.
        errors: how large the errors are.
    """
    variances = torch.zeros(len(raw), dtype=covariance.dtype)
    for k, (unknown, value) in enumerate(zip(unknowns, raw.tolist(), strict=False)):
        if not unknown.measured:
            relative = errors.bending if unknown.name.startswith("bending") else errors.other
            variances[k] = (relative * unknown.value(value) / unknown.slope(value)) ** 2
    return covariance + torch.diag(variances)
