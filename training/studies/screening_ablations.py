"""Fits as they would be screened without one part of the method: functions of a fit, which is left as it is.

Noise is estimated anew where that part changes what is left for it.
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
from torchcloth.diagnosis.inference.noise import Noise, CovarianceParts

NONE = 1e-9  # nearly, of a standard deviation
SMALL = 1e-2  # of a typical amplitude: a tangent at zero


class Independent(Noise):
    """Slow errors are as large as they are, and agree with no neighbour."""

    def covariance(self, cells: BinnedResiduals, nuisance: Tensor, std: Tensor, parts: CovarianceParts | None = None) -> Tensor:
        """Their variances alone, and what differs from episode to episode."""
        moved = nuisance * std
        return torch.diag(super().covariance(cells, nuisance[:, :0], std[:0], parts).diagonal()) + moved @ moved.mT


def independent(found: ModelFit) -> ModelFit:
    """Every cell for itself."""
    return assemble_fit(found.model, found.linearisation, Independent(*found.noise))


def exact(found: ModelFit) -> ModelFit:
    """Clock, camera, grasp, rim and tare are as stated in every episode."""
    evidence = replace(found.linearisation, stds=[NONE * s for s in found.linearisation.nuisance_stds])
    return assemble_fit(found.model, evidence, fit_noise(evidence))


def against_zero(found: ModelFit) -> ModelFit:
    """Any amplitude matters."""
    anything = [replace(h, smallest_fraction=0.0) for h in found.linearisation.hypotheses]
    return replace(found, evidence=replace(found.linearisation, hypotheses=anything))


def one_mesh(found: ModelFit) -> ModelFit:
    """Residuals on the given mesh, and nobody knows of another; slopes are those of before."""
    cells = [c._replace(value=c.value + n) for c, n in zip(found.linearisation.bins, found.linearisation.mesh_differences, strict=True)]
    evidence = replace(found.linearisation, cells=cells, numerics=[torch.zeros_like(n) for n in found.linearisation.mesh_differences])
    return assemble_fit(found.model, evidence, fit_noise(evidence))


def rigid(found: ModelFit) -> ModelFit:
    """What is fitted stays where it is, however much it could do."""
    parameters = tuple(replace(p, prior_std=NONE) for p in found.model.parameters)
    return assemble_fit(replace(found.model, parameters=parameters), found.linearisation, found.noise)


def tangents(found: ModelFit, setting: DiagnosisData) -> ModelFit:
    """Slopes at a hundredth of a typical amplitude, simulated anew."""
    whole = {h.name: h for h in found.linearisation.hypotheses}
    small = [replace(h, typical=SMALL * h.typical) for h in whole.values()]
    near = fit(found.model, setting, small, 0, noise=found.noise, before=found.linearisation)
    own = [whole[h.name] for h in near.linearisation.hypotheses]
    return replace(near, evidence=replace(near.linearisation, hypotheses=own))


WAYS: Mapping[str, Callable[[ModelFit], ModelFit]] = {
    "slow errors independent": independent,
    "episodes exact": exact,
    "tested against zero": against_zero,
    "on one mesh": one_mesh,
}
