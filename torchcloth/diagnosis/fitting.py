"""Gauss-Newton on whitened cells: parameters within their priors, amplitudes of accepted hypotheses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ..errors import InvalidInput, SimulationDiverged, UnstableStep
from .evidence import Evidence, Progress, Setting, gather, staged
from .noise import Noise, Whitened, fit_noise, unfitted, whitened
from .world import Hypothesis, Model

IMPOSSIBLE = (InvalidInput, SimulationDiverged, UnstableStep)  # no world has such values, or none that is stable
ENOUGH = 2.0  # log density that a further step is expected to gain, below which the search ends
ITERATIONS = 3  # at most
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
        ahead: log density that a further step is expected to gain.
    """

    model: Model
    evidence: Evidence
    noise: Noise
    white: Whitened
    covariance: Tensor
    ahead: float


def prior_precision(model: Model) -> Tensor:
    """[P + A] of the coordinates; amplitudes are known to a few times their typical size."""
    stds = [*(p.std for p in model.parameters), *(2.0 * abs(h.typical) for h in model.accepted)]
    return torch.tensor(stds, dtype=torch.float64) ** -2


def fit(
    model: Model,
    setting: Setting,
    hypotheses: Sequence[Hypothesis] = (),
    iterations: int = ITERATIONS,
    progress: Progress = lambda _: None,
    noise: Noise | None = None,
    before: Evidence | None = None,
    here: Evidence | None = None,
) -> Fitted:
    """Fit the model's parameters and amplitudes, then ask about the hypotheses there.

    Fits are compared with the same ``noise``; None: estimated. The nuisances' slopes are those of ``before``, if given.
    ``here`` is the evidence at the model's point, where that is known already.
    """
    precision = prior_precision(model)
    for k in range(iterations):
        here = here or gather(model, setting, (), staged(progress, f"fit {k + 1}"), before)
        before = before or here
        step, _, ahead = step_of(whitened(here, noise or fit_noise(here)), model.point, precision)
        if ahead < ENOUGH:
            break
        model, here = model.at(model.point + _within(step, model)), None
    if here is None or hypotheses:
        about = f"{len(hypotheses)} causes" if hypotheses else "as fitted"
        here = gather(model, setting, hypotheses, staged(progress, about), before)
    noise = noise or fit_noise(here)
    white = whitened(here, noise)
    _, covariance, ahead = step_of(white, model.point, precision)
    return Fitted(model, here, noise, white, covariance, ahead)


def with_cause(found: Fitted, hypothesis: Hypothesis) -> Model:
    """With one more cause, where one step leads: the parameters make room for it."""
    own = found.evidence.own
    columns = [*range(own), own + found.evidence.hypotheses.index(hypothesis)]
    return _stepped(found.model.plus(hypothesis), whitened(found.evidence, unfitted()), columns)


def without_cause(found: Fitted, name: str) -> Model:
    """With one cause less, where one step leads: the parameters take over what they can."""
    index = [a.name for a in found.model.accepted].index(name)
    white, place = whitened(found.evidence, unfitted()), len(found.model.parameters) + index
    less = white._replace(value=white.value - found.model.amplitudes[index] * white.jacobian[:, place])
    return _stepped(found.model.without(name), less, [k for k in range(found.evidence.own) if k != place])


def _stepped(model: Model, white: Whitened, columns: Sequence[int]) -> Model:
    slopes = white._replace(jacobian=white.jacobian[:, columns])
    step, _, _ = step_of(slopes, model.point, prior_precision(model))
    return model.at(model.point + _within(step, model))


def renoised(found: Fitted, noise: Noise) -> Fitted:
    """The same with residuals weighed by another noise."""
    return replace(found, noise=noise, white=whitened(found.evidence, noise))


def _within(step: Tensor, model: Model) -> Tensor:
    limit = LONGEST * prior_precision(model).rsqrt()
    return step.clamp(-limit, limit)


def step_of(white: Whitened, point: Tensor, precision: Tensor) -> tuple[Tensor, Tensor, float]:
    """(Gauss-Newton step, covariance, log density that the step is expected to gain) of the model's coordinates."""
    own = white.jacobian[:, : len(point)]
    covariance = torch.linalg.inv(own.mT @ own + torch.diag(precision))
    uphill = own.mT @ white.value + precision * point
    step = -covariance @ uphill
    return step, covariance, -0.5 * float(step @ uphill)
