"""Gauss-Newton on whitened cells: parameters within their priors, amplitudes of accepted hypotheses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from .evidence import Evidence, Progress, Setting, gather, staged
from .noise import Noise, Whitened, fit_noise, whitened
from .world import Hypothesis, Model

SMALL = 0.1  # standard errors, of a step that ends the search
LONGEST = 1.0  # prior standard deviations, of a step


@dataclass(frozen=True, eq=False)
class Fitted:
    """A model where the data want it.

    Attributes:
        model: at the solution.
        evidence: at the solution, with the slopes along the hypotheses that were asked about.
        noise: as estimated there.
        white: evidence, whitened.
        covariance: [P + A, P + A] of the model's coordinates.
    """

    model: Model
    evidence: Evidence
    noise: Noise
    white: Whitened
    covariance: Tensor


def prior_precision(model: Model) -> Tensor:
    """[P + A] of the coordinates; amplitudes are known to a few times their typical size."""
    stds = [*(p.std for p in model.parameters), *(2.0 * abs(h.typical) for h in model.accepted)]
    return torch.tensor(stds, dtype=torch.float64) ** -2


def fit(
    model: Model,
    setting: Setting,
    hypotheses: Sequence[Hypothesis] = (),
    iterations: int = 2,
    progress: Progress = lambda _: None,
    noise: Noise | None = None,
    before: Evidence | None = None,
) -> Fitted:
    """Fit the model's parameters and amplitudes, then ask about the hypotheses there.

    Fits are compared with the same ``noise``; None: estimated. The nuisances' slopes are those of ``before``, if given.
    """
    precision = prior_precision(model)
    for k in range(iterations):
        evidence = gather(model, setting, (), staged(progress, f"fit {k + 1}"), before)
        before = before or evidence
        white = whitened(evidence, noise or fit_noise(evidence))
        step, covariance = step_of(white, model.point, precision)
        limit = LONGEST * precision.rsqrt()
        model = model.at(model.point + step.clamp(-limit, limit))
        if float((step / covariance.diagonal().sqrt()).abs().max()) < SMALL:
            break
    about = f"{len(hypotheses)} causes" if hypotheses else "as fitted"
    evidence = gather(model, setting, hypotheses, staged(progress, about), before)
    noise = noise or fit_noise(evidence)
    white = whitened(evidence, noise)
    _, covariance = step_of(white, model.point, precision)
    return Fitted(model, evidence, noise, white, covariance)


def renoised(found: Fitted, noise: Noise) -> Fitted:
    """The same with residuals weighed by another noise."""
    return replace(found, noise=noise, white=whitened(found.evidence, noise))


def step_of(white: Whitened, point: Tensor, precision: Tensor) -> tuple[Tensor, Tensor]:
    """(Gauss-Newton step, covariance) of the model's coordinates."""
    own = white.jacobian[:, : len(point)]
    covariance = torch.linalg.inv(own.mT @ own + torch.diag(precision))
    return -covariance @ (own.mT @ white.value + precision * point), covariance
