"""Searches by reverse mode through the whole simulation: gradient descent and Adam as the paper has them, L-BFGS."""

from __future__ import annotations

import warnings
from collections.abc import Callable

import torch
from torch import Tensor

from ...episodes.observed import Episode
from ...errors import SimulationDiverged, UnstableStep
from ...losses import chamfer_to_vertices
from . import levenberg_marquardt
from .objective import Objective

OnIterate = Callable[[Tensor, Objective], bool]
ROUNDS = 3  # of L-BFGS, each with the noise scales of the point where it begins
HOPELESS = 1e30  # cost of what cannot be simulated
SETTLED = 1e-3  # decrease of the robust cost below which a round ends: a few hundredths of a standard error


def descend(
    objective: Objective, start: Tensor, iterations: int, rate: float, on_iterate: OnIterate, adam: bool = True
) -> Tensor:
    """Adam, or plain descent, on the unknowns [K] over their sizes; ``on_iterate(raw, objective)``: True to stop.

    The loss is the DiffCP paper's one-sided Chamfer distance, cloud to nearest vertex, without any prior. Plain
    descent divides by the first gradient's length, so that its first step is ``rate`` long. A step to where nothing can
    be simulated ends it, with a warning.
    """
    sizes = objective.sizes  # drag moves by tenths, bending by millionths: one rate for both would stall or leap
    scaled, seen = (start / sizes).requires_grad_(), start
    optimiser = torch.optim.Adam([scaled], lr=rate) if adam else torch.optim.SGD([scaled], lr=rate)
    length = 0.0
    for k in range(iterations):
        there = objective.clip(scaled.detach() * sizes)
        try:
            _, slope = objective.value_and_slope("chamfer", there, chamfer)
        except (SimulationDiverged, UnstableStep) as error:
            if k == 0:
                raise
            warnings.warn(f"descent: after {k} steps, {error}; the result is that of the step before", stacklevel=2)
            break
        seen = there
        if on_iterate(seen, objective):
            break
        scaled.grad = slope * sizes
        if not adam:
            length = length or max(float(scaled.grad.norm()), 1e-30)
            scaled.grad = scaled.grad / length
        optimiser.step()
        with torch.no_grad():
            scaled.copy_(objective.clip(scaled * sizes) / sizes)
    return seen


def chamfer(objective: Objective, raw: Tensor, i: int) -> Tensor:
    """The paper's loss [m] of episode ``i``, as a part of the mean over all."""
    return to_vertices(objective.simulate(raw, i).x, objective.episodes[i]) / len(objective.episodes)


def to_vertices(frames: Tensor, episode: Episode) -> Tensor:
    """One-sided Chamfer distance [m], cloud to nearest vertex, mean over the frames [T, V, 3] m that have points."""
    pairs = ((episode.positions(t), x) for t, x in enumerate(frames))
    return torch.stack([chamfer_to_vertices(cloud, x) for cloud, x in pairs if len(cloud)]).mean()


def quasi_newton(objective: Objective, start: Tensor, iterations: int, on_iterate: OnIterate) -> tuple[Tensor, bool]:
    """L-BFGS on the robust cost of all data and priors, in units of the priors' standard deviations.

    Returns:
        (end, whether it converged)
    """
    best, left = start.clone(), iterations
    for number in range(ROUNDS):
        at = levenberg_marquardt.judged(objective.problem(), best, objective.evaluate_all(best))
        best, used, stopped = _round(objective, at, best, left, on_iterate, number)
        left -= used
        if stopped or left <= 0:
            return best, False
    return best, True


def _round(
    objective: Objective,
    at: levenberg_marquardt.Iterate,
    start: Tensor,
    iterations: int,
    on_iterate: OnIterate,
    number: int,
) -> tuple[Tensor, int, bool]:
    """(end, iterations used, whether it was stopped) with fixed noise scales."""
    scaled = objective.scaled(start).requires_grad_()
    optimiser = torch.optim.LBFGS(
        [scaled], lr=0.3, max_iter=1, max_eval=20, tolerance_change=1e-12, line_search_fn="strong_wolfe"
    )
    loss = lambda o, raw, i: o.cost(raw, i, at)  # noqa: E731

    def closure() -> Tensor:
        raw = objective.clip(objective.unscaled(scaled.detach()))
        prior = objective.scaled(raw)
        try:
            value, slope = objective.value_and_slope(f"cost{number}", raw, loss)
        except (SimulationDiverged, UnstableStep):
            value, slope = scaled.new_tensor(HOPELESS), torch.zeros_like(raw)
        scaled.grad = objective.pulled(slope) + prior
        return value + 0.5 * prior.square().sum()

    values: list[float] = []
    for used in range(iterations):
        before = objective.clip(objective.unscaled(scaled.detach()))
        values.append(float(optimiser.step(closure)))
        if on_iterate(before, objective):
            return before, used + 1, True
        if len(values) > objective.patience and values[-1 - objective.patience] - values[-1] < SETTLED:
            return before, used + 1, False
    return objective.clip(objective.unscaled(scaled.detach())), iterations, False
