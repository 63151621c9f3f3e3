"""Levenberg-Marquardt on forward-mode sensitivities: few iterations, and the covariance comes with it."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from ..errors import SimulationDiverged, UnstableStep
from .misfit import huber, noise_scale

LONGEST_STEP = 1.5  # in unconstrained units: a factor of 4.5 on a log parameter


class Linearised(NamedTuple):
    """Residuals of all episodes at one point."""

    value: Tensor  # [R] m
    jacobian: Tensor  # [R, K]
    factor: Tensor  # [R]
    cluster: Tensor  # [R] int64, consecutive frames of one episode follow each other


class Problem(NamedTuple):
    """Callbacks of the fit."""

    linearise: Callable[[Tensor], Linearised]
    evaluate: Callable[[Tensor], tuple[Tensor, Tensor]]  # raw -> (value, factor), without derivatives
    clip: Callable[[Tensor], Tensor]
    prior_mean: Tensor  # [K]
    prior_std: Tensor  # [K]
    noise: float | None


class Iterate(NamedTuple):
    """One accepted point."""

    raw: Tensor
    linear: Linearised
    cost: float
    scale: float  # m


def minimise(problem: Problem, start: Tensor, iterations: int, on_iterate: Callable[[Iterate], bool]) -> Iterate:
    """Minimise the robust cost; ``on_iterate`` sees every accepted point and returns True to stop.

    The noise scale is re-estimated at every accepted point, and the damping is adapted to how well the linear model
    predicted the last step.
    """
    current = _linearise(problem, start)
    damping = 1e-3
    for _ in range(iterations):
        if on_iterate(current):
            return current
        gradient, hessian = _normal_equations(problem, current)
        for _attempt in range(8):
            step = torch.linalg.solve(hessian + damping * torch.diag(hessian.diagonal()), -gradient)
            step = step * min(1.0, LONGEST_STEP / float(step.abs().max().clamp(min=1e-12)))
            trial = problem.clip(current.raw + step)
            cost = _cost(problem, trial, current.scale)
            if cost < current.cost:
                break
            damping = max(10 * damping, 1e-2)
        else:
            return current
        settled = _is_small(trial - current.raw, hessian) or current.cost - cost < 1e-4 * current.cost
        damping = max(damping / 5, 1e-6)
        current = _linearise(problem, trial)
        if settled:
            break
    on_iterate(current)
    return current


def covariance(problem: Problem, at: Iterate) -> Tensor:
    """Covariance of the estimate [K, K]: sandwich with residuals correlated within and between nearby frames.

    Never smaller than what independent noise would give. Model error that persists over a whole episode is beyond it.
    """
    gradient, hessian = _normal_equations(problem, at)
    inverse = torch.linalg.inv(hessian)
    _, weight = huber(at.linear.value / at.scale)
    scores = (at.linear.factor * weight * at.linear.value / at.scale**2)[:, None] * at.linear.jacobian
    count = int(at.linear.cluster.max()) + 1
    summed = torch.zeros(count, scores.shape[1], dtype=scores.dtype).index_add(0, at.linear.cluster, scores)
    summed = summed[summed.abs().sum(1) > 0]
    meat = _long_run(summed) * len(summed) / max(1, len(summed) - len(gradient))
    robust = inverse @ (meat + torch.diag(problem.prior_std**-2)) @ inverse
    inflate = torch.sqrt((inverse.diagonal() / robust.diagonal()).clamp(min=1.0))
    return robust * inflate[:, None] * inflate[None, :]


def _long_run(scores: Tensor) -> Tensor:
    """Sum of the scores' outer products over nearby frames, Bartlett weights (Newey and West 1987)."""
    lags = max(1, round(len(scores) ** 0.5))
    total = scores.mT @ scores
    for lag in range(1, min(lags, len(scores) - 1) + 1):
        cross = scores[lag:].mT @ scores[:-lag]
        total = total + (1 - lag / (lags + 1)) * (cross + cross.mT)
    return total


def _linearise(problem: Problem, raw: Tensor) -> Iterate:
    linear = problem.linearise(raw)
    scale = noise_scale(linear.value, problem.noise)
    return Iterate(raw, linear, _total(problem, raw, linear.value, linear.factor, scale), scale)


def _cost(problem: Problem, raw: Tensor, scale: float) -> float:
    try:
        value, factor = problem.evaluate(raw)
    except (SimulationDiverged, UnstableStep):
        return float("inf")
    return _total(problem, raw, value, factor, scale)


def _total(problem: Problem, raw: Tensor, value: Tensor, factor: Tensor, scale: float) -> float:
    prior = ((raw - problem.prior_mean) / problem.prior_std).square().sum()
    return float((factor * huber(value / scale)[0]).sum() + 0.5 * prior)


def _normal_equations(problem: Problem, at: Iterate) -> tuple[Tensor, Tensor]:
    _, weight = huber(at.linear.value / at.scale)
    weighted = (at.linear.factor * weight / at.scale**2)[:, None] * at.linear.jacobian
    gradient = weighted.mT @ at.linear.value + (at.raw - problem.prior_mean) / problem.prior_std**2
    return gradient, weighted.mT @ at.linear.jacobian + torch.diag(problem.prior_std**-2)


def _is_small(step: Tensor, hessian: Tensor) -> bool:
    """Below a tenth of a standard error in every direction."""
    return float(step @ hessian @ step) < 0.01
