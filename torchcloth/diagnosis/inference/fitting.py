"""Gauss-Newton fit of whitened bins: parameters within their priors, amplitudes of accepted hypotheses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ...episodes.world import Hypothesis, WorldModel
from ...episodes.world_cache import IMPOSSIBLE_WORLD_ERRORS
from ...identification.estimators.box_qp import solve_box_qp
from ..data.dataset import DiagnosisData, Progress, prefix_progress
from ..decide.criteria import CRITERIA
from .linearise import (
    Linearisation,
    linearise,
    linearise_hypotheses,
    restrict_to_common_bins,
    use_noise_inputs,
    use_nuisance_slopes,
)
from .noise import Noise, WhitenedBins, fit_noise, inflated_noise, whiten
from .robust_weights import remove_weights, reweight, t_log_density


@dataclass(frozen=True, eq=False)
class ModelFit:
    """A model at the optimum of a fit.

    Attributes:
        model: at the solution.
        linearisation: at the solution, with slopes along the hypotheses that were asked about.
        noise: as estimated there.
        whitened: the linearisation, whitened and reweighted.
        covariance: [P + A, P + A] of the model's coordinates.
        expected_gain: log density that a further step is expected to gain.
    """

    model: WorldModel
    linearisation: Linearisation
    noise: Noise
    whitened: WhitenedBins
    covariance: Tensor
    expected_gain: float


def prior_precision(model: WorldModel) -> Tensor:
    """Return [P + A] the prior precision of the coordinates."""
    amplitude_factor = CRITERIA.fit.amplitude_prior_factor
    stds = [*(p.prior_std for p in model.parameters), *(amplitude_factor * abs(h.typical) for h in model.accepted)]
    return torch.tensor(stds, dtype=torch.float64) ** -2


def fit(
    model: WorldModel,
    data: DiagnosisData,
    hypotheses: Sequence[Hypothesis] = (),
    iterations: int = CRITERIA.fit.max_iterations,
    progress: Progress = lambda _: None,
    noise: Noise | None = None,
    before: Linearisation | None = None,
    here: Linearisation | None = None,
) -> ModelFit:
    """Fit the model's parameters and amplitudes, then linearise along the hypotheses.

    A step to a point that cannot be simulated is not taken. If a step clearly loses, half of it is tried. Slopes
    promise too little where cloth ripples, so the search ends only if the last step gained little as well.

    Args:
        model: start of the fit.
        data: the episodes.
        hypotheses: along which slopes are computed at the solution.
        iterations: largest number of steps.
        progress: called with one line for each episode that is simulated.
        noise: levels of the covariance, for fits that are compared; None: estimated.
        before: source of the slopes along nuisances.
        here: linearisation at the start, if known; it is not simulated again.
    """
    min_gain = CRITERIA.fit.min_step_gain
    about = f"{len(hypotheses)} causes" if hypotheses else "as fitted"

    def linearise_at(point: WorldModel, steps_taken: int) -> Linearisation:
        stage = f"fit {steps_taken + 1}" if steps_taken < iterations else "as fitted"
        return linearise(point, data, (), prefix_progress(progress, stage), before)

    has_hypotheses, fraction = here is None and not iterations, 1.0
    last: tuple[Noise, WorldModel, Linearisation] | None = None  # where the last step began
    if has_hypotheses:
        here = linearise(model, data, hypotheses, prefix_progress(progress, about), before)
    here = here or linearise_at(model, 0)
    known: tuple[Linearisation, Noise, Tensor, float] | None = None  # (point, noise, step, expected gain)
    for steps_taken in range(1, iterations + 1):
        if known is None or known[0] is not here:
            before, level = before or here, noise or fit_noise(here)
            known = (here, level, *robust_step(whiten(here, level), model))
        _, level, step, expected_gain = known
        if expected_gain < min_gain and not (last and _density_gain(*last, model, here) >= min_gain):
            break
        next_model = model.at_point(model.point + fraction * step)
        try:
            there = linearise_at(next_model, steps_taken)
        except IMPOSSIBLE_WORLD_ERRORS:
            break
        if _density_gain(level, model, here, next_model, there) < -min_gain:
            if expected_gain < min_gain:
                break
            fraction /= 2
            continue
        last, fraction = (level, model, here), 1.0
        model, here = next_model, there
    if hypotheses and not has_hypotheses:
        here = here if before is None else use_nuisance_slopes(here, before)
        here = linearise_hypotheses(here, model, data, hypotheses, prefix_progress(progress, about))
    return assemble_fit(model, here, known[1] if known and known[0] is here else noise or fit_noise(here))


def assemble_fit(model: WorldModel, result: Linearisation, noise: Noise) -> ModelFit:
    """Build the fit of a model at a solution from its linearisation there and a noise."""
    whitened = reweight(whiten(result, noise))
    _, expected_gain = robust_step(whitened, model)
    covariance = torch.linalg.inv(posterior_precision(whitened, model))
    return ModelFit(model, result, noise, whitened, covariance, expected_gain)


def add_cause(fitted: ModelFit, hypothesis: Hypothesis) -> WorldModel:
    """Return the model with one more cause, after one robust step of all coordinates.

    A parameter that equals the cause hands over what it does already.
    """
    index = [h.name for h in fitted.linearisation.hypotheses].index(hypothesis.name)
    model = fitted.model.with_hypothesis(hypothesis)
    names = [p.name for p in model.parameters]
    if hypothesis.equivalent_parameter in names:
        k, point = names.index(hypothesis.equivalent_parameter), model.point
        point[-1], point[k] = model.parameters[k].relative_change(float(point[k])), 0.0
        model = model.at_point(point)
    n_coordinates = fitted.linearisation.n_coordinates
    step, _ = robust_step_with(whiten(fitted.linearisation, inflated_noise()), model, n_coordinates + index)
    return model.at_point(model.point + step)


def remove_cause(fitted: ModelFit, name: str) -> WorldModel:
    """Return the model without one cause, after one robust step of the other coordinates."""
    index = fitted.model.index_of(name)
    whitened, column = whiten(fitted.linearisation, inflated_noise()), len(fitted.model.parameters) + index
    without = whitened.value - fitted.model.amplitudes[index] * whitened.jacobian[:, column]
    whitened = whitened._replace(value=without)
    whitened = _select_columns(whitened, [k for k in range(fitted.linearisation.n_coordinates) if k != column])
    model = fitted.model.without_hypothesis(name)
    return model.at_point(model.point + robust_step(whitened, model)[0])


def robust_step_with(whitened: WhitenedBins, model: WorldModel, column: int) -> tuple[Tensor, float]:
    """Compute ``robust_step`` of a model whose last cause has its slopes in another column.

    The step starts from several amplitudes, because a time block that only this cause describes hardly counts before.

    Args:
        whitened: slopes along the other coordinates first.
        model: with the cause as its last coordinate.
        column: index of the cause's slopes.

    Returns:
        As ``robust_step``.
    """
    n_others, h = len(model.point) - 1, model.accepted[-1]
    slopes = _select_columns(whitened, [*range(n_others), column])
    starts = [0.0, h.typical, *([-h.typical] if h.signed else [])]
    zero = torch.zeros_like(model.point)
    steps = [robust_step(slopes, model, torch.cat([zero[:-1], zero.new_tensor([a])])) for a in starts]
    return max(steps, key=lambda pair: pair[1])


def robust_step(whitened: WhitenedBins, model: WorldModel, start: Tensor | None = None) -> tuple[Tensor, float]:
    """Compute the most likely step under robust weights, by iteratively reweighted least squares.

    Args:
        whitened: slopes along the model's coordinates first.
        model: as in ``gauss_newton_step``; the length of the step is limited.
        start: step at which the first weights are taken; None: no step.

    Returns:
        The step of the model's coordinates, and the log density that it is expected to gain.
    """
    step = torch.zeros_like(model.point) if start is None else start
    plain = remove_weights(whitened)
    for _ in range(CRITERIA.robust.reweighting_sweeps):
        step, _ = gauss_newton_step(reweight(plain, step), model, CRITERIA.fit.max_step_prior_stds)
    return step, _log_posterior(plain, model, step) - _log_posterior(plain, model)


def _density_gain(
    noise: Noise, first: WorldModel, at_first: Linearisation, second: WorldModel, at_second: Linearisation
) -> float:
    """Return the gain in log density from the first to the second, on common bins with the second's noise inputs."""
    common = restrict_to_common_bins(at_second, [at_first])

    def log_posterior(result: Linearisation, model: WorldModel) -> float:
        return _log_posterior(whiten(use_noise_inputs(result, common), noise), model)

    return log_posterior(at_second, second) - log_posterior(at_first, first)


def _log_posterior(plain: WhitenedBins, model: WorldModel, step: Tensor | None = None) -> float:
    """Return the log density of bins without weights and of the coordinates, after a linearised ``step`` if given."""
    value = plain.value if step is None else plain.value + plain.jacobian[:, : len(step)] @ step
    point = model.point if step is None else model.point + step
    return float(t_log_density(value, plain.time_block).sum() - 0.5 * prior_precision(model) @ point.square())


def _select_columns(whitened: WhitenedBins, columns: Sequence[int]) -> WhitenedBins:
    return whitened._replace(jacobian=whitened.jacobian[:, columns])


def put_on_common_noise(first: ModelFit, second: ModelFit) -> tuple[ModelFit, ModelFit]:
    """Return both fits with the second's noise, on the bins that both have."""
    common = restrict_to_common_bins(second.linearisation, [first.linearisation])
    return reweight_by_noise(first, second.noise, common), reweight_by_noise(second, second.noise, common)


def reweight_by_noise(fitted: ModelFit, noise: Noise, like: Linearisation) -> ModelFit:
    """Return the fit with another noise, on the bins of ``like`` and with their roughness."""
    result = use_noise_inputs(fitted.linearisation, like)
    return replace(fitted, linearisation=result, noise=noise, whitened=reweight(whiten(result, noise)))


def gauss_newton_step(
    whitened: WhitenedBins, model: WorldModel, max_prior_stds: float = torch.inf
) -> tuple[Tensor, float]:
    """Compute the Gauss-Newton step within the bounds of the coordinates.

    Coordinates stop at their bounds, amplitudes without a sign at zero, and the free ones make up for it.

    Args:
        whitened: slopes along the model's coordinates first.
        model: at its point.
        max_prior_stds: longest step of a coordinate, in prior standard deviations.

    Returns:
        The step of the model's coordinates, and the log density that it is expected to gain.
    """
    point, precision = model.point, prior_precision(model)
    gradient = whitened.jacobian[:, : len(point)].mT @ whitened.value + precision * point
    low, high = (bound - point for bound in model.bounds)
    limit = max_prior_stds * precision.rsqrt()
    hessian = posterior_precision(whitened, model)
    step = solve_box_qp(hessian, -gradient, torch.maximum(low, -limit), torch.minimum(high, limit))
    return step, -float(gradient @ step + 0.5 * step @ hessian @ step)


def posterior_precision(whitened: WhitenedBins, model: WorldModel) -> Tensor:
    """Return [P + A, P + A] the inverse covariance of the model's coordinates."""
    slopes = whitened.jacobian[:, : len(model.point)]
    return slopes.mT @ slopes + torch.diag(prior_precision(model))
