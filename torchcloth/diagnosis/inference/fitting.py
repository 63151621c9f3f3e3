"""Gauss-Newton on whitened cells: parameters within their priors, amplitudes of accepted hypotheses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ...episodes.world import Hypothesis, Model
from ...episodes.world_cache import IMPOSSIBLE
from ...identification.estimators.box_qp import bounded
from ..data.dataset import Progress, DiagnosisData, prefix_progress
from .linearise import Linearisation, use_nuisance_slopes, use_noise_inputs, linearise_hypotheses, linearise, restrict_to_common_bins
from .noise import Noise, WhitenedBins, fit_noise, inflated_noise, whiten
from .robust_weights import reweight, t_log_density, remove_weights

ENOUGH = 2.0  # log density that a further step should gain, and that the last one did, below which the search ends
ITERATIONS = 5  # at most
LONGEST = 1.0  # prior standard deviations, of a step
SWEEPS = 4  # of weighing stretches anew


@dataclass(frozen=True, eq=False)
class ModelFit:
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
    linearisation: Linearisation
    noise: Noise
    whitened: WhitenedBins
    covariance: Tensor
    expected_gain: float


def prior_precision(model: Model) -> Tensor:
    """[P + A] of the coordinates; amplitudes are known to a few times their typical size."""
    stds = [*(p.std for p in model.parameters), *(2.0 * abs(h.typical) for h in model.accepted)]
    return torch.tensor(stds, dtype=torch.float64) ** -2


def fit(
    model: Model,
    setting: DiagnosisData,
    hypotheses: Sequence[Hypothesis] = (),
    iterations: int = ITERATIONS,
    progress: Progress = lambda _: None,
    noise: Noise | None = None,
    before: Linearisation | None = None,
    here: Linearisation | None = None,
) -> ModelFit:
    """Fit the model's parameters and amplitudes, then ask about the hypotheses there.

    Fits are compared with the same ``noise``; None: estimated. The nuisances' slopes are those of ``before``, if given.
    ``here`` is the evidence at the model's point, where that is known already: nothing of it is simulated again. A step
    into what is ``IMPOSSIBLE`` is not taken; of one that loses clearly, half is tried. Slopes promise too little where
    cloth ripples, so the search ends only where the last step gained little, too.
    """
    about = f"{len(hypotheses)} causes" if hypotheses else "as fitted"

    def look(at: Model, steps: int) -> Linearisation:
        """After so many."""
        stage = f"fit {steps + 1}" if steps < iterations else "as fitted"
        return linearise(at, setting, (), prefix_progress(progress, stage), before)

    asked, share = here is None and not iterations, 1.0
    last: tuple[Noise, Model, Linearisation] | None = None
    if asked:
        here = linearise(model, setting, hypotheses, prefix_progress(progress, about), before)
    here = here or look(model, 0)
    known: tuple[Linearisation, Noise, Tensor, float] | None = None  # where the last step began, and what follows from it
    for taken in range(1, iterations + 1):
        if known is None or known[0] is not here:
            before, level = before or here, noise or fit_noise(here)
            known = (here, level, *robust_step(whiten(here, level), model))
        _, level, step, ahead = known
        if ahead < ENOUGH and not (last and _gained(*last, model, here) >= ENOUGH):
            break
        further = model.at(model.point + share * step)
        try:
            there = look(further, taken)
        except IMPOSSIBLE:
            break
        if _gained(level, model, here, further, there) < -ENOUGH:
            if ahead < ENOUGH:
                break
            share /= 2
            continue
        last, share = (level, model, here), 1.0
        model, here = further, there
    if hypotheses and not asked:
        here = here if before is None else use_nuisance_slopes(here, before)
        here = linearise_hypotheses(here, model, setting, hypotheses, prefix_progress(progress, about))
    return assemble_fit(model, here, known[1] if known and known[0] is here else noise or fit_noise(here))


def assemble_fit(model: Model, evidence: Linearisation, noise: Noise) -> ModelFit:
    """A model at a solution, its evidence there weighed by a noise."""
    white = reweight(whiten(evidence, noise))
    _, ahead = robust_step(white, model)
    return ModelFit(model, evidence, noise, white, torch.linalg.inv(posterior_precision(white, model)), ahead)


def add_cause(found: ModelFit, hypothesis: Hypothesis) -> Model:
    """With one more cause, where one leap leads: the parameters make room for it.

    A parameter that is the cause's twin hands over what it does already.
    """
    index = [h.name for h in found.linearisation.hypotheses].index(hypothesis.name)
    model = found.model.plus(hypothesis)
    names = [p.name for p in model.parameters]
    if hypothesis.equivalent_parameter in names:
        place, point = names.index(hypothesis.equivalent_parameter), model.point
        point[-1], point[place] = model.parameters[place].more(float(point[place])), 0.0
        model = model.at(point)
    step, _ = robust_step_with(whiten(found.linearisation, inflated_noise()), model, found.linearisation.n_coordinates + index)
    return model.at(model.point + step)


def remove_cause(found: ModelFit, name: str) -> Model:
    """With one cause less, where one leap leads: the parameters take over what they can."""
    index = found.model.place(name)
    white, place = whiten(found.linearisation, inflated_noise()), len(found.model.parameters) + index
    less = white._replace(value=white.value - found.model.amplitudes[index] * white.jacobian[:, place])
    less = _columns(less, [k for k in range(found.linearisation.n_coordinates) if k != place])
    model = found.model.without(name)
    return model.at(model.point + robust_step(less, model)[0])


def robust_step_with(white: WhitenedBins, model: Model, place: int) -> tuple[Tensor, float]:
    """As ``leap``, of a model whose last cause has the slopes in column ``place``, begun from several amplitudes.

    A stretch that only this cause describes hardly counts until it does.
    """
    own, h = len(model.point) - 1, model.accepted[-1]
    slopes = _columns(white, [*range(own), place])
    starts = [0.0, h.typical, *([-h.typical] if h.signed else [])]
    none = torch.zeros_like(model.point)
    tried = [robust_step(slopes, model, torch.cat([none[:-1], none.new_tensor([a])])) for a in starts]
    return max(tried, key=lambda pair: pair[1])


def robust_step(white: WhitenedBins, model: Model, start: Tensor | None = None) -> tuple[Tensor, float]:
    """(step of the model's coordinates, log density that it is expected to gain), where slopes hold that far.

    The likeliest step for noise whose level differs from stretch to stretch, by least squares with ever new weights.

    Args:
        white: slopes along the model's coordinates first.
        model: as in ``step_of``; no coordinate goes farther than ``LONGEST`` prior standard deviations.
        start: step from which weights are taken at first; None: none.
    """
    step = torch.zeros_like(model.point) if start is None else start
    plain = remove_weights(white)
    for _ in range(SWEEPS):
        step, _ = gauss_newton_step(reweight(plain, step), model, LONGEST)
    return step, _posterior(plain, model, step) - _posterior(plain, model)


def _gained(noise: Noise, first: Model, there: Linearisation, second: Model, here: Linearisation) -> float:
    """Log density from the first to the second, on the cells of both and by the scatter at the second."""
    like = restrict_to_common_bins(here, [there])
    white = lambda evidence: whiten(use_noise_inputs(evidence, like), noise)  # noqa: E731
    return _posterior(white(here), second) - _posterior(white(there), first)


def _posterior(plain: WhitenedBins, model: Model, step: Tensor | None = None) -> float:
    """Log density of unweighted cells and of the model's coordinates: as they are, or after a ``step`` by slopes."""
    value = plain.value if step is None else plain.value + plain.jacobian[:, : len(step)] @ step
    point = model.point if step is None else model.point + step
    return float(t_log_density(value, plain.time_block).sum() - 0.5 * prior_precision(model) @ point.square())


def _columns(white: WhitenedBins, columns: Sequence[int]) -> WhitenedBins:
    return white._replace(jacobian=white.jacobian[:, columns])


def put_on_common_noise(first: ModelFit, second: ModelFit) -> tuple[ModelFit, ModelFit]:
    """Both by the second's noise, on the cells that both have."""
    like = restrict_to_common_bins(second.linearisation, [first.linearisation])
    return reweight_by_noise(first, second.noise, like), reweight_by_noise(second, second.noise, like)


def reweight_by_noise(found: ModelFit, noise: Noise, like: Linearisation) -> ModelFit:
    """The same weighed by another noise, on the cells of ``like`` and with stretches as rough as those."""
    evidence = use_noise_inputs(found.linearisation, like)
    return replace(found, evidence=evidence, noise=noise, white=reweight(whiten(evidence, noise)))


def gauss_newton_step(white: WhitenedBins, model: Model, longest: float = torch.inf) -> tuple[Tensor, float]:
    """(Gauss-Newton step of the model's coordinates, log density that it is expected to gain).

    Args:
        white: slopes along the model's coordinates first.
        model: coordinates stop at their ends, amplitudes without a sign at zero, and what stays free makes up for it.
        longest: step of one coordinate, in prior standard deviations.
    """
    point, precision = model.point, prior_precision(model)
    uphill = white.jacobian[:, : len(point)].mT @ white.value + precision * point
    low, high = (reached - point for reached in model.ends)
    limit = longest * precision.rsqrt()
    square = posterior_precision(white, model)
    step = bounded(square, -uphill, torch.maximum(low, -limit), torch.minimum(high, limit))
    return step, -float(uphill @ step + 0.5 * step @ square @ step)


def posterior_precision(white: WhitenedBins, model: Model) -> Tensor:
    """[P + A, P + A] inverse covariance of the model's coordinates."""
    own = white.jacobian[:, : len(model.point)]
    return own.mT @ own + torch.diag(prior_precision(model))
