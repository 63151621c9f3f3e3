"""Steps within linear bounds."""

import torch

from torchcloth.identification.estimators.box_qp import bounded
from torchcloth.planning.constrained_step import step_within
from torchcloth.planning.motion_parameters import Bounds


def all_of_one(rows, low, high):
    """Rows that are about all unknowns together."""
    one = [torch.zeros(n, dtype=torch.long) for n in rows.shape]
    return Bounds(rows, low, high, [""] * len(rows), *one)


def problem(n=6, rows=40, seed=0):
    rng = torch.Generator().manual_seed(seed)
    root = torch.randn(n, n, generator=rng)
    curvature, gradient = root @ root.mT + 0.1 * torch.eye(n), 3 * torch.randn(n, generator=rng)
    a = torch.randn(rows, n, generator=rng)
    return gradient, curvature, all_of_one(a, -torch.ones(rows), torch.ones(rows))


def cost(step, gradient, curvature):
    return float(gradient @ step + 0.5 * step @ curvature @ step)


def test_where_nothing_is_in_the_way_it_is_newtons():
    gradient, curvature, bounds = problem()
    free = bounds._replace(low=bounds.low * 1e6, high=bounds.high * 1e6)
    step = step_within(torch.zeros(6), gradient, curvature, free)
    assert torch.allclose(curvature @ step, -gradient)


def test_nothing_within_the_bounds_is_better():
    for seed in range(5):
        gradient, curvature, bounds = problem(seed=seed)
        at = 0.01 * torch.randn(6)
        step = step_within(at, gradient, curvature, bounds)
        reached = bounds.rows @ (at + step)
        assert bool((reached <= 1 + 1e-4).all() and (reached >= -1 - 1e-4).all())
        least = cost(step, gradient, curvature)
        tried = step + 0.02 * torch.randn(20000, 6)
        inside = ((tried + at) @ bounds.rows.mT).abs().amax(1) <= 1
        assert int(inside.sum()) > 50
        assert min(cost(other, gradient, curvature) for other in tried[inside]) > least - 1e-3 * abs(least)


def test_bounds_of_each_unknown_alone_are_those_of_the_active_set():
    gradient, curvature, _ = problem()
    low, high = torch.full((6,), -0.1), torch.full((6,), 0.2)
    step = step_within(torch.zeros(6), gradient, curvature, all_of_one(torch.eye(6), low, high))
    assert torch.allclose(step, bounded(curvature, -gradient, low, high), atol=1e-4)


def test_a_bound_that_is_met_stops_what_goes_beyond_it_and_nothing_else():
    bounds = all_of_one(torch.eye(2), torch.tensor([-1.0, -1.0]), torch.tensor([0.0, 1.0]))
    step = step_within(torch.zeros(2), torch.tensor([-1.0, -0.5]), torch.eye(2), bounds)
    assert torch.allclose(step, torch.tensor([0.0, 0.5]), atol=1e-4)


def test_curvatures_of_which_most_are_lost_in_rounding_give_a_step():
    stiff = 1e12 * torch.outer(torch.ones(6), torch.ones(6)) + 1e-6 * torch.eye(6)
    bounds = all_of_one(torch.eye(6), -torch.ones(6), torch.ones(6))
    step = step_within(torch.zeros(6), torch.randn(6), stiff, bounds)
    assert bool(step.isfinite().all())
    assert float(step.abs().max()) <= 1.0001
