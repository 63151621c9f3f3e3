"""Searches for unknowns that bring the cloth to the goal, within what the arms can do."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from ..episodes.world_cache import IMPOSSIBLE
from .constrained_step import step_within
from .motion_parameters import Bounds
from .objective import Pull

HALVINGS = 6  # of a step that leads into something
FIRST, LEAST = 0.1, 1e-4  # of the damping: a path's mean square beside the cloth's
EASIER, HARDER = 0.2, 4.0  # times the damping, after a step that did what was expected, and after one that did not
GOOD, POOR = 0.7, 0.2  # of what was expected
ENOUGH = 0.005  # of the mean square distance, that a further step should gain
GAIN = f"{100 * ENOUGH:g} % of the mean square distance"
BLOCKED = "every step that slopes ask for is blocked by a limit or by what is in the arms' way"
CHAOTIC = "the cloth is so chaotic there that slopes say nothing"
LAST = 0.05  # of Adam's rate, at the end
PATIENCE = 20  # of Adam's steps


class Problem(Protocol):
    """What is sought, and what is in the way."""

    bounds: Bounds
    metric: Tensor  # [N, N] mean square of the paths' changes, for each unknown squared

    def look(self, at: Tensor) -> tuple[float, float]:
        """(distance [m], mean square distance [m^2]) at unknowns [N]."""
        ...

    def pull(self, at: Tensor) -> Pull:
        """What unknowns do to the mean square distance."""
        ...

    def slope(self, at: Tensor) -> tuple[float, Tensor]:
        """(distance [m], its gradient [N])."""
        ...

    def clear(self, at: Tensor) -> bool:
        """Whether nothing is in the arms' way."""
        ...


OnLook = Callable[[int, float, float], None]  # (motions looked at, distance [m], that of the best so far)


class Found(NamedTuple):
    """What a search has found.

    Attributes:
        best: [N] unknowns.
        history: m, the distance of every motion that was looked at, in order.
        ended: why it ended, in words.
    """

    best: Tensor
    history: list[float]
    ended: str


def gauss_newton(problem: Problem, start: Tensor, iterations: int, on_look: OnLook) -> Found:
    """Levenberg's and Marquardt's method on the mean square distance, damped by how far the grippers' paths change.

    Args:
        problem: what is sought.
        start: [N], within the bounds and clear.
        iterations: at most so many steps, taken or not.
        on_look: called after every motion that was looked at.
    """
    history: list[float] = []
    squares: list[float] = []

    def look(at: Tensor) -> float:
        try:
            distance, square = problem.look(at)
        except IMPOSSIBLE:
            if not history:
                raise
            distance = square = math.inf
        history.append(distance)
        squares.append(square)
        on_look(len(history), distance, history[squares.index(min(squares))])  # the one that is kept
        return square

    at, damping = start, FIRST
    value, pull = look(at), None
    for _ in range(iterations):
        fresh = pull is None
        if pull is None:
            pull = problem.pull(at)
            if not all(bool(part.isfinite().all()) for part in pull):
                return Found(at, history, CHAOTIC)
        step, expected = _promised(problem, at, pull, damping)
        while fresh and expected <= ENOUGH * value and damping > LEAST and bool(step.any()):
            damping = max(EASIER * damping, LEAST)
            step, expected = _promised(problem, at, pull, damping)
        if expected <= ENOUGH * value:
            if bool(pull.gradient.any()) and not bool(step.any()):
                return Found(at, history, BLOCKED)
            return Found(at, history, f"{'no further' if fresh else 'no smaller'} step would gain more than {GAIN}")
        there = look(at + step)
        gained = (value - there) / expected
        damping = max(damping * (EASIER if gained > GOOD else HARDER if gained < POOR else 1.0), LEAST)
        if there < value:
            at, value, pull = at + step, there, None
    return Found(at, history, f"after {iterations} iterations")


def _promised(problem: Problem, at: Tensor, pull: Pull, damping: float) -> tuple[Tensor, float]:
    """(step [N], by how much the mean square distance should fall [m^2])."""
    step = _clear(problem, at, partial(_damped, problem, at, pull, damping))
    return step, -float(pull.gradient @ step + 0.5 * step @ pull.curvature @ step)


def _damped(problem: Problem, at: Tensor, pull: Pull, damping: float, share: float) -> Tensor:
    """A share of the step within the bounds, for so much damping."""
    return share * step_within(at, pull.gradient, pull.curvature + damping * problem.metric, problem.bounds)


def adam(problem: Problem, start: Tensor, iterations: int, rate: float, on_look: OnLook) -> Found:
    """Adam (Kingma and Ba 2015) on the distance, by reverse mode, with a rate that falls as a cosine.

    After every step, the nearest point within the bounds.

    Args:
        problem: what is sought.
        start: [N], within the bounds and clear.
        iterations: at most so many steps.
        rate: of the first ones, of each unknown.
        on_look: called after every motion that was looked at.
    """
    at = start.clone().requires_grad_()
    optimiser = torch.optim.Adam([at], lr=rate)
    falling = torch.optim.lr_scheduler.LambdaLR(optimiser, lambda k: _share(k, iterations))
    eye = torch.eye(len(start)).to(start)
    best, bests, history = start, [], []
    for k in range(iterations + 1):
        before = at.detach().clone()
        try:
            value, gradient = problem.slope(before)
        except IMPOSSIBLE:
            if not history:
                raise
            value, gradient = math.inf, None
        if value < min(history, default=math.inf):
            best = before
        history.append(value)
        bests.append(min(history))
        on_look(len(history), value, bests[-1])
        if gradient is not None and not bool(gradient.isfinite().all()):
            return Found(best, history, CHAOTIC)
        if k == iterations:
            break
        if len(bests) > PATIENCE and bests[-1 - PATIENCE] - bests[-1] < ENOUGH * bests[-1]:
            return Found(best, history, f"the last {PATIENCE} steps gained less than {100 * ENOUGH:g} %")
        if gradient is None:
            step = _clear(problem, before, lambda share, b=before, t=best: (1 - 0.5 * share) * (t - b))
        else:
            at.grad = gradient
            optimiser.step()
            wanted = at.detach() - before
            nearest = lambda share, b=before, w=wanted: step_within(b, -share * w, eye, problem.bounds)  # noqa: E731
            step = _clear(problem, before, nearest)
        falling.step()
        with torch.no_grad():
            at.copy_(before + step)
    return Found(best, history, f"after {iterations} iterations")


def _clear(problem: Problem, at: Tensor, step: Callable[[float], Tensor]) -> Tensor:
    """The step, or as large a share of it as leads into nothing."""
    for k in range(HALVINGS):
        found = step(0.5**k)
        if problem.clear(at + found):
            return found
    return torch.zeros_like(at)


def _share(k: int, iterations: int) -> float:
    return LAST + (1 - LAST) * 0.5 * (1 + math.cos(math.pi * k / max(iterations, 1)))
