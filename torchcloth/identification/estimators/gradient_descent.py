"""Searches by reverse mode through the whole simulation: gradient descent and Adam as in the DiffCP paper, L-BFGS."""

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
MAX_LBFGS_ROUNDS = 3  # each round has the noise scales of the point where it begins
INFEASIBLE_COST = 1e30  # cost of a point that cannot be simulated
MIN_COST_DECREASE = 1e-3  # of the robust cost, below which a round ends: a few hundredths of a standard error


def minimise_by_gradient_descent(
    objective: Objective, start: Tensor, iterations: int, rate: float, on_iterate: OnIterate, adam: bool = True
) -> Tensor:
    """Minimise the Chamfer distance by Adam or plain gradient descent, and return the end point [K].

    The loss is the DiffCP paper's one-sided Chamfer distance, cloud to nearest vertex, without any prior. Unknowns are
    divided by their typical changes: drag moves by tenths, bending by millionths, and one rate for both would stall or
    leap. Plain descent divides by the first gradient's length, so that its first step is ``rate`` long. A step to a
    point that cannot be simulated ends the search with a warning.

    Args:
        objective: the episodes.
        start: [K].
        iterations: largest number of steps.
        rate: length of a step, in typical changes.
        on_iterate: called with (unknowns, objective) at every point; returns True to stop.
        adam: Adam, or plain gradient descent.
    """
    scales = objective.typical_changes
    scaled, last = (start / scales).requires_grad_(), start
    optimiser = torch.optim.Adam([scaled], lr=rate) if adam else torch.optim.SGD([scaled], lr=rate)
    first_norm = 0.0
    for k in range(iterations):
        raw = objective.clip(scaled.detach() * scales)
        try:
            _, gradient = objective.value_and_gradient("chamfer", raw, episode_chamfer)
        except (SimulationDiverged, UnstableStep) as error:
            if k == 0:
                raise
            warnings.warn(f"descent: after {k} steps, {error}; the result is that of the step before", stacklevel=2)
            break
        last = raw
        if on_iterate(last, objective):
            break
        scaled.grad = gradient * scales
        if not adam:
            first_norm = first_norm or max(float(scaled.grad.norm()), 1e-30)
            scaled.grad = scaled.grad / first_norm
        optimiser.step()
        with torch.no_grad():
            scaled.copy_(objective.clip(scaled * scales) / scales)
    return last


def episode_chamfer(objective: Objective, raw: Tensor, i: int) -> Tensor:
    """Compute the paper's loss [m] of episode ``i``, divided by the number of episodes."""
    return chamfer_to_nearest_vertex(objective.simulate(raw, i).x, objective.episodes[i]) / len(objective.episodes)


def chamfer_to_nearest_vertex(frames: Tensor, episode: Episode) -> Tensor:
    """Compute the one-sided Chamfer distance [m], cloud to nearest vertex.

    It is the mean over the frames [T, V, 3] m that have points.
    """
    pairs = ((episode.observed_points(t), x) for t, x in enumerate(frames))
    return torch.stack([chamfer_to_vertices(cloud, x) for cloud, x in pairs if len(cloud)]).mean()


def minimise_by_lbfgs(
    objective: Objective, start: Tensor, iterations: int, on_iterate: OnIterate
) -> tuple[Tensor, bool]:
    """Minimise the robust cost of all data and priors by L-BFGS, in standard deviations of the priors.

    Returns:
        The end point [K], and whether the search converged.
    """
    best, iterations_left = start.clone(), iterations
    for number in range(MAX_LBFGS_ROUNDS):
        at = levenberg_marquardt.evaluate_point(objective.problem(), best, objective.evaluate_all(best))
        best, used, stopped = _lbfgs_round(objective, at, best, iterations_left, on_iterate, number)
        iterations_left -= used
        if stopped or iterations_left <= 0:
            return best, False
    return best, True


def _lbfgs_round(
    objective: Objective,
    at: levenberg_marquardt.Iterate,
    start: Tensor,
    iterations: int,
    on_iterate: OnIterate,
    number: int,
) -> tuple[Tensor, int, bool]:
    """(end point, iterations used, whether it was stopped) with the noise scales of ``at``."""
    scaled = objective.to_scaled(start).requires_grad_()
    optimiser = torch.optim.LBFGS(
        [scaled], lr=0.3, max_iter=1, max_eval=20, tolerance_change=1e-12, line_search_fn="strong_wolfe"
    )

    def episode_cost(objective: Objective, raw: Tensor, i: int) -> Tensor:
        return objective.robust_cost(raw, i, at)

    def current_point() -> Tensor:
        return objective.clip(objective.from_scaled(scaled.detach()))

    def closure() -> Tensor:
        raw = current_point()
        prior = objective.to_scaled(raw)
        try:
            value, gradient = objective.value_and_gradient(f"cost{number}", raw, episode_cost)
        except (SimulationDiverged, UnstableStep):
            value, gradient = scaled.new_tensor(INFEASIBLE_COST), torch.zeros_like(raw)
        scaled.grad = objective.scale_gradient(gradient) + prior
        return value + 0.5 * prior.square().sum()

    costs: list[float] = []
    for used in range(iterations):
        before = current_point()
        costs.append(float(optimiser.step(closure)))
        if on_iterate(before, objective):
            return before, used + 1, True
        if len(costs) > objective.patience and costs[-1 - objective.patience] - costs[-1] < MIN_COST_DECREASE:
            return before, used + 1, False
    return current_point(), iterations, False
