"""Search for waypoints that bring the cloth to the goal within the limits of the arms."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from ..episodes.world_cache import IMPOSSIBLE_WORLD_ERRORS
from .constrained_step import solve_constrained_step
from .motion_parameters import LinearBounds
from .objective import QuadraticModel

MAX_STEP_HALVINGS = 6  # of a step that leads into a collision
BLOCKED_REASON = "every step along the gradient is blocked by a limit or by an obstacle of the arms"
CHAOTIC_REASON = "the cloth is so chaotic there that its derivatives are not finite"


@dataclass(frozen=True)
class GaussNewtonSettings:
    """Settings of ``gauss_newton``. The damping is relative: mean square path change against mean square distance.

    Attributes:
        initial_damping: damping of the first step.
        min_damping: smallest damping.
        damping_decrease: factor after a step that gained about what the model predicted.
        damping_increase: factor after a step that gained far less than the model predicted.
        good_gain_ratio: gain over predicted gain, above which the damping decreases.
        poor_gain_ratio: gain over predicted gain, below which the damping increases.
        min_relative_gain: share of the mean square distance that a further step must promise.
    """

    initial_damping: float = 0.1
    min_damping: float = 1e-4
    damping_decrease: float = 0.2
    damping_increase: float = 4.0
    good_gain_ratio: float = 0.7
    poor_gain_ratio: float = 0.2
    min_relative_gain: float = 0.005


@dataclass(frozen=True)
class AdamSettings:
    """Settings of ``adam``.

    Attributes:
        final_rate_fraction: learning rate at the end, as a fraction of the first one.
        patience: steps over which the best distance must improve.
        min_relative_gain: share of the distance by which it must improve in so many steps.
    """

    final_rate_fraction: float = 0.05
    patience: int = 20
    min_relative_gain: float = 0.005


class SearchProblem(Protocol):
    """What a search minimises, and its constraints.

    Attributes:
        bounds: limits that are linear in the unknowns.
        metric: [N, N], mean square change of the grippers' paths per squared unknown.
    """

    bounds: LinearBounds
    metric: Tensor

    def evaluate(self, at: Tensor) -> tuple[float, float]:
        """Return the distance [m] and the mean square distance [m^2] at the unknowns [N]."""
        ...

    def quadratic_model(self, at: Tensor) -> QuadraticModel:
        """Return the local model of the mean square distance at the unknowns [N]."""
        ...

    def distance_gradient(self, at: Tensor) -> tuple[float, Tensor]:
        """Return the distance [m] and its gradient [N]."""
        ...

    def is_clear(self, at: Tensor) -> bool:
        """Return whether the arms collide with nothing."""
        ...


ProgressCallback = Callable[[int, float, float], None]  # (number of motions evaluated, distance [m], best distance [m])


class SearchResult(NamedTuple):
    """The result of a search.

    Attributes:
        best: [N], the best unknowns.
        history: m, the distance of every motion that was evaluated, in order.
        stop_reason: why the search stopped, in words.
    """

    best: Tensor
    history: list[float]
    stop_reason: str


def gauss_newton(
    problem: SearchProblem,
    start: Tensor,
    iterations: int,
    on_progress: ProgressCallback,
    settings: GaussNewtonSettings = GaussNewtonSettings(),
) -> SearchResult:
    """Minimise the mean square distance by the Levenberg-Marquardt method.

    The damping penalises how far the grippers' paths change.

    Args:
        problem: what is minimised, and its constraints.
        start: [N], within the bounds and clear.
        iterations: largest number of steps, accepted or not.
        on_progress: called after every motion that was evaluated.
        settings: damping and stopping rule.
    """
    history: list[float] = []
    squares: list[float] = []

    def evaluate(at: Tensor) -> float:
        try:
            distance, square = problem.evaluate(at)
        except IMPOSSIBLE_WORLD_ERRORS:
            if not history:
                raise
            distance = square = math.inf
        history.append(distance)
        squares.append(square)
        on_progress(len(history), distance, history[squares.index(min(squares))])  # of the motion that would be kept
        return square

    min_gain, min_damping = settings.min_relative_gain, settings.min_damping
    at, damping = start, settings.initial_damping
    value, model = evaluate(at), None
    for _ in range(iterations):
        new_point = model is None
        if model is None:
            model = problem.quadratic_model(at)
            if not all(bool(part.isfinite().all()) for part in model):
                return SearchResult(at, history, CHAOTIC_REASON)
        step, predicted = _clear_step(problem, at, model, damping)
        while new_point and predicted <= min_gain * value and damping > min_damping and bool(step.any()):
            damping = max(settings.damping_decrease * damping, min_damping)
            step, predicted = _clear_step(problem, at, model, damping)
        if predicted <= min_gain * value:
            if bool(model.gradient.any()) and not bool(step.any()):
                return SearchResult(at, history, BLOCKED_REASON)
            what, gain = "no further" if new_point else "no smaller", f"{100 * min_gain:g} %"
            return SearchResult(at, history, f"{what} step would gain more than {gain} of the mean square distance")
        new_value = evaluate(at + step)
        ratio = (value - new_value) / predicted
        factor = 1.0
        if ratio > settings.good_gain_ratio:
            factor = settings.damping_decrease
        elif ratio < settings.poor_gain_ratio:
            factor = settings.damping_increase
        damping = max(damping * factor, min_damping)
        if new_value < value:
            at, value, model = at + step, new_value, None
    return SearchResult(at, history, f"after {iterations} iterations")


def _clear_step(problem: SearchProblem, at: Tensor, model: QuadraticModel, damping: float) -> tuple[Tensor, float]:
    """A collision-free step [N] within the bounds, and the predicted decrease of the mean square distance [m^2]."""
    curvature = model.curvature + damping * problem.metric
    full = solve_constrained_step(at, model.gradient, curvature, problem.bounds)
    step = _shorten_until_clear(problem, at, lambda fraction: fraction * full)
    return step, -float(model.gradient @ step + 0.5 * step @ model.curvature @ step)


def adam(
    problem: SearchProblem,
    start: Tensor,
    iterations: int,
    rate: float,
    on_progress: ProgressCallback,
    settings: AdamSettings = AdamSettings(),
) -> SearchResult:
    """Minimise the distance by Adam (Kingma and Ba 2015), with gradients by reverse mode.

    The learning rate falls as a cosine. Every step is projected to the nearest point within the bounds.

    Args:
        problem: what is minimised, and its constraints.
        start: [N], within the bounds and clear.
        iterations: largest number of steps.
        rate: learning rate of the first steps, for each unknown.
        on_progress: called after every motion that was evaluated.
        settings: schedule and stopping rule.
    """
    patience, last = settings.patience, settings.final_rate_fraction
    at = start.clone().requires_grad_()
    optimiser = torch.optim.Adam([at], lr=rate)
    schedule = torch.optim.lr_scheduler.LambdaLR(
        optimiser, lambda k: last + (1 - last) * 0.5 * (1 + math.cos(math.pi * k / max(iterations, 1)))
    )
    identity = torch.eye(len(start)).to(start)
    best, best_history, history = start, [], []
    for k in range(iterations + 1):
        here = at.detach().clone()
        try:
            value, gradient = problem.distance_gradient(here)
        except IMPOSSIBLE_WORLD_ERRORS:
            if not history:
                raise
            value, gradient = math.inf, None
        if value < min(history, default=math.inf):
            best = here
        history.append(value)
        best_history.append(min(history))
        on_progress(len(history), value, best_history[-1])
        if gradient is not None and not bool(gradient.isfinite().all()):
            return SearchResult(best, history, CHAOTIC_REASON)
        if k == iterations:
            break
        if len(best_history) > patience:
            gain = best_history[-1 - patience] - best_history[-1]
            if gain < settings.min_relative_gain * best_history[-1]:
                reason = f"the last {patience} steps gained less than {100 * settings.min_relative_gain:g} %"
                return SearchResult(best, history, reason)
        if gradient is None:
            step = _shorten_until_clear(problem, here, lambda f, a=here, b=best: (1 - 0.5 * f) * (b - a))
        else:
            at.grad = gradient
            optimiser.step()
            wanted = at.detach() - here
            project = partial(solve_constrained_step, here, curvature=identity, bounds=problem.bounds)
            step = _shorten_until_clear(problem, here, lambda f, w=wanted, p=project: p(gradient=-f * w))
        schedule.step()
        with torch.no_grad():
            at.copy_(here + step)
    return SearchResult(best, history, f"after {iterations} iterations")


def _shorten_until_clear(problem: SearchProblem, at: Tensor, step: Callable[[float], Tensor]) -> Tensor:
    """The largest of the halved steps that leads into no collision; zero if all do."""
    for k in range(MAX_STEP_HALVINGS):
        shortened = step(0.5**k)
        if problem.is_clear(at + shortened):
            return shortened
    return torch.zeros_like(at)
