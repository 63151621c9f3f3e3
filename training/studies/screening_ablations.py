"""Ablations of the screening: functions that return a fit without one part of the method.

The noise is estimated again if the part changes the residuals.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import torch
from torch import Tensor

from torchcloth.diagnosis import ModelFit, fit, fit_noise
from torchcloth.diagnosis.data.binning import BinnedResiduals
from torchcloth.diagnosis.data.dataset import DiagnosisData
from torchcloth.diagnosis.inference.fitting import assemble_fit
from torchcloth.diagnosis.inference.noise import CovarianceParts, Noise

NEGLIGIBLE_STD_FACTOR = 1e-9  # removes a standard deviation
TANGENT_FACTOR = 1e-2  # of a typical amplitude, for slopes at zero


class Independent(Noise):
    """Noise whose slowly varying errors are not correlated."""

    def covariance(
        self, cells: BinnedResiduals, nuisance: Tensor, std: Tensor, parts: CovarianceParts | None = None
    ) -> Tensor:
        """Return the variances of the slow errors as a diagonal, and the nuisances of episodes."""
        moved = nuisance * std
        return torch.diag(super().covariance(cells, nuisance[:, :0], std[:0], parts).diagonal()) + moved @ moved.mT


def without_error_correlation(fitted: ModelFit) -> ModelFit:
    """Return the fit with uncorrelated errors of the bins."""
    return assemble_fit(fitted.model, fitted.linearisation, Independent(*fitted.noise))


def without_nuisances(fitted: ModelFit) -> ModelFit:
    """Return the fit with exact clock, camera, grasp, boundary and tare in all episodes."""
    linearisation = replace(
        fitted.linearisation, nuisance_stds=[NEGLIGIBLE_STD_FACTOR * s for s in fitted.linearisation.nuisance_stds]
    )
    return assemble_fit(fitted.model, linearisation, fit_noise(linearisation))


def with_zero_threshold(fitted: ModelFit) -> ModelFit:
    """Return the fit with tests against zero instead of the smallest effect of interest."""
    hypotheses = [replace(h, smallest_fraction=0.0) for h in fitted.linearisation.hypotheses]
    return replace(fitted, linearisation=replace(fitted.linearisation, hypotheses=hypotheses))


def without_mesh_error(fitted: ModelFit) -> ModelFit:
    """Return the fit on the given mesh, without mesh error; the slopes do not change."""
    bins = [
        b._replace(value=b.value + n)
        for b, n in zip(fitted.linearisation.bins, fitted.linearisation.mesh_differences, strict=True)
    ]
    zeros = [torch.zeros_like(n) for n in fitted.linearisation.mesh_differences]
    linearisation = replace(fitted.linearisation, bins=bins, mesh_differences=zeros)
    return assemble_fit(fitted.model, linearisation, fit_noise(linearisation))


def with_fixed_parameters(fitted: ModelFit) -> ModelFit:
    """Return the fit with fixed parameters."""
    parameters = tuple(replace(p, prior_std=NEGLIGIBLE_STD_FACTOR) for p in fitted.model.parameters)
    return assemble_fit(replace(fitted.model, parameters=parameters), fitted.linearisation, fitted.noise)


def with_tangent_slopes(fitted: ModelFit, setting: DiagnosisData) -> ModelFit:
    """Return the fit with slopes at a hundredth of the typical amplitudes, simulated again."""
    by_name = {h.name: h for h in fitted.linearisation.hypotheses}
    small = [replace(h, typical=TANGENT_FACTOR * h.typical) for h in by_name.values()]
    near = fit(fitted.model, setting, small, 0, noise=fitted.noise, before=fitted.linearisation)
    full_hypotheses = [by_name[h.name] for h in near.linearisation.hypotheses]
    return replace(near, linearisation=replace(near.linearisation, hypotheses=full_hypotheses))


ABLATIONS: Mapping[str, Callable[[ModelFit], ModelFit]] = {
    "slow errors independent": without_error_correlation,
    "episodes exact": without_nuisances,
    "tested against zero": with_zero_threshold,
    "on one mesh": without_mesh_error,
}
