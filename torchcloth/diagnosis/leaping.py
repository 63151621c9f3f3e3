"""Where slopes lead: steps of a model's coordinates, and the log density that these promise."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ..identification.bounds import bounded
from .bursts import calmed, densities, unweighted
from .evidence import Evidence, as_rough, shared
from .noise import Noise, Whitened, whitened
from .world import Model

LONGEST = 1.0  # prior standard deviations, of a step
SWEEPS = 4  # of weighing stretches anew


def prior_precision(model: Model) -> Tensor:
    """[P + A] of the coordinates; amplitudes are known to a few times their typical size."""
    stds = [*(p.std for p in model.parameters), *(2.0 * abs(h.typical) for h in model.accepted)]
    return torch.tensor(stds, dtype=torch.float64) ** -2


def leap(white: Whitened, model: Model, start: Tensor | None = None) -> tuple[Tensor, float]:
    """(step of the model's coordinates, log density that it is expected to gain), where slopes hold that far.

    The likeliest step for noise whose level differs from stretch to stretch, by least squares with ever new weights.

    Args:
        white: slopes along the model's coordinates first.
        model: as in ``step_of``; no coordinate goes farther than ``LONGEST`` prior standard deviations.
        start: step from which weights are taken at first; None: none.
    """
    step = torch.zeros_like(model.point) if start is None else start
    plain = unweighted(white)
    for _ in range(SWEEPS):
        step, _ = step_of(calmed(plain, step), model, LONGEST)
    return step, _posterior(plain, model, step) - _posterior(plain, model)


def leap_with(white: Whitened, model: Model, place: int) -> tuple[Tensor, float]:
    """As ``leap``, of a model whose last cause has the slopes in column ``place``, begun from several amplitudes.

    A stretch that only this cause describes hardly counts until it does.
    """
    own, h = len(model.point) - 1, model.accepted[-1]
    slopes = columns(white, [*range(own), place])
    starts = [0.0, h.typical, *([-h.typical] if h.signed else [])]
    none = torch.zeros_like(model.point)
    tried = [leap(slopes, model, torch.cat([none[:-1], none.new_tensor([a])])) for a in starts]
    return max(tried, key=lambda pair: pair[1])


def step_of(white: Whitened, model: Model, longest: float = torch.inf) -> tuple[Tensor, float]:
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
    square = curvature(white, model)
    step = bounded(square, -uphill, torch.maximum(low, -limit), torch.minimum(high, limit))
    return step, -float(uphill @ step + 0.5 * step @ square @ step)


def curvature(white: Whitened, model: Model) -> Tensor:
    """[P + A, P + A] inverse covariance of the model's coordinates."""
    own = white.jacobian[:, : len(model.point)]
    return own.mT @ own + torch.diag(prior_precision(model))


def gained(noise: Noise, first: Model, there: Evidence, second: Model, here: Evidence) -> float:
    """Log density from the first to the second, on the cells of both and by the scatter at the second."""
    like = shared(here, [there])
    white = lambda evidence: whitened(as_rough(evidence, like), noise)  # noqa: E731
    return _posterior(white(here), second) - _posterior(white(there), first)


def columns(white: Whitened, chosen: Sequence[int]) -> Whitened:
    """With the slopes in these columns alone."""
    return white._replace(jacobian=white.jacobian[:, chosen])


def _posterior(plain: Whitened, model: Model, step: Tensor | None = None) -> float:
    """Log density of unweighted cells and of the model's coordinates: as they are, or after a ``step`` by slopes."""
    value = plain.value if step is None else plain.value + plain.jacobian[:, : len(step)] @ step
    point = model.point if step is None else model.point + step
    return float(densities(value, plain.stretch).sum() - 0.5 * prior_precision(model) @ point.square())
