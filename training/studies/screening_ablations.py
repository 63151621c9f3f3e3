"""Fits as they would be screened without one part of the method: functions of a fit, which is left as it is.

Noise is estimated anew where that part changes what is left for it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import torch
from torch import Tensor

from torchcloth.diagnosis import Fitted, fit, fit_noise
from torchcloth.diagnosis.data.binning import Cells
from torchcloth.diagnosis.data.dataset import Setting
from torchcloth.diagnosis.inference.fitting import weighed
from torchcloth.diagnosis.inference.noise import Noise, Parts

NONE = 1e-9  # nearly, of a standard deviation
SMALL = 1e-2  # of a typical amplitude: a tangent at zero


class Independent(Noise):
    """Slow errors are as large as they are, and agree with no neighbour."""

    def covariance(self, cells: Cells, nuisance: Tensor, std: Tensor, parts: Parts | None = None) -> Tensor:
        """Their variances alone, and what differs from episode to episode."""
        moved = nuisance * std
        return torch.diag(super().covariance(cells, nuisance[:, :0], std[:0], parts).diagonal()) + moved @ moved.mT


def independent(found: Fitted) -> Fitted:
    """Every cell for itself."""
    return weighed(found.model, found.evidence, Independent(*found.noise))


def exact(found: Fitted) -> Fitted:
    """Clock, camera, grasp, rim and tare are as stated in every episode."""
    evidence = replace(found.evidence, stds=[NONE * s for s in found.evidence.stds])
    return weighed(found.model, evidence, fit_noise(evidence))


def against_zero(found: Fitted) -> Fitted:
    """Any amplitude matters."""
    anything = [replace(h, share=0.0) for h in found.evidence.hypotheses]
    return replace(found, evidence=replace(found.evidence, hypotheses=anything))


def one_mesh(found: Fitted) -> Fitted:
    """Residuals on the given mesh, and nobody knows of another; slopes are those of before."""
    cells = [c._replace(value=c.value + n) for c, n in zip(found.evidence.cells, found.evidence.numerics, strict=True)]
    evidence = replace(found.evidence, cells=cells, numerics=[torch.zeros_like(n) for n in found.evidence.numerics])
    return weighed(found.model, evidence, fit_noise(evidence))


def rigid(found: Fitted) -> Fitted:
    """What is fitted stays where it is, however much it could do."""
    parameters = tuple(replace(p, std=NONE) for p in found.model.parameters)
    return weighed(replace(found.model, parameters=parameters), found.evidence, found.noise)


def tangents(found: Fitted, setting: Setting) -> Fitted:
    """Slopes at a hundredth of a typical amplitude, simulated anew."""
    whole = {h.name: h for h in found.evidence.hypotheses}
    small = [replace(h, typical=SMALL * h.typical) for h in whole.values()]
    near = fit(found.model, setting, small, 0, noise=found.noise, before=found.evidence)
    own = [whole[h.name] for h in near.evidence.hypotheses]
    return replace(near, evidence=replace(near.evidence, hypotheses=own))


WAYS: Mapping[str, Callable[[Fitted], Fitted]] = {
    "slow errors independent": independent,
    "episodes exact": exact,
    "tested against zero": against_zero,
    "on one mesh": one_mesh,
}
