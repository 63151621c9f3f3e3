"""Quadratic steps within linear bounds."""

import torch

from torchcloth.identification.estimators.box_qp import solve_box_qp
from torchcloth.planning.constrained_step import solve_constrained_step
from torchcloth.planning.motion_parameters import LinearBounds


def bounds_of(rows, low, high):
    """Return linear bounds on all coordinates, without names."""
    return LinearBounds(rows, low, high, [""] * len(rows))


def problem(n=6, rows=40, seed=0):
    rng = torch.Generator().manual_seed(seed)
    root = torch.randn(n, n, generator=rng)
    curvature, gradient = root @ root.mT + 0.1 * torch.eye(n), 3 * torch.randn(n, generator=rng)
    a = torch.randn(rows, n, generator=rng)
    return gradient, curvature, bounds_of(a, -torch.ones(rows), torch.ones(rows))


def cost(step, gradient, curvature):
    return float(gradient @ step + 0.5 * step @ curvature @ step)


def test_without_active_bounds_it_is_the_newton_step():
    gradient, curvature, bounds = problem()
    free = bounds._replace(low=bounds.low * 1e6, high=bounds.high * 1e6)
    step = solve_constrained_step(torch.zeros(6), gradient, curvature, free)
    assert torch.allclose(curvature @ step, -gradient)


def test_no_other_step_within_the_bounds_is_better():
    for seed in range(5):
        gradient, curvature, bounds = problem(seed=seed)
        at = 0.01 * torch.randn(6)
        step = solve_constrained_step(at, gradient, curvature, bounds)
        reached = bounds.rows @ (at + step)
        assert bool((reached <= 1 + 1e-5).all() and (reached >= -1 - 1e-5).all())
        smallest = cost(step, gradient, curvature)
        tried = step + 0.02 * torch.randn(20000, 6)
        inside = ((tried + at) @ bounds.rows.mT).abs().amax(1) <= 1
        assert int(inside.sum()) > 50
        assert min(cost(other, gradient, curvature) for other in tried[inside]) > smallest - 1e-6 * abs(smallest)


def test_box_bounds_agree_with_the_active_set_solver():
    gradient, curvature, _ = problem()
    low, high = torch.full((6,), -0.1), torch.full((6,), 0.2)
    step = solve_constrained_step(torch.zeros(6), gradient, curvature, bounds_of(torch.eye(6), low, high))
    assert torch.allclose(step, solve_box_qp(curvature, -gradient, low, high), atol=1e-5)


def test_an_active_bound_stops_only_the_coordinate_that_would_exceed_it():
    bounds = bounds_of(torch.eye(2), torch.tensor([-1.0, -1.0]), torch.tensor([0.0, 1.0]))
    step = solve_constrained_step(torch.zeros(2), torch.tensor([-1.0, -0.5]), torch.eye(2), bounds)
    assert torch.allclose(step, torch.tensor([0.0, 0.5]), atol=1e-5)


def test_an_ill_conditioned_curvature_gives_a_finite_step():
    stiff = 1e12 * torch.outer(torch.ones(6), torch.ones(6)) + 1e-6 * torch.eye(6)
    bounds = bounds_of(torch.eye(6), -torch.ones(6), torch.ones(6))
    step = solve_constrained_step(torch.zeros(6), torch.randn(6), stiff, bounds)
    assert bool(step.isfinite().all())
    assert float(step.abs().max()) <= 1.0001


def test_bounds_that_leave_no_room_give_no_step():
    gradient, curvature, _ = problem()
    rows = torch.cat([torch.eye(6), torch.ones(1, 6)])
    step = solve_constrained_step(torch.zeros(6), gradient, curvature, bounds_of(rows, torch.zeros(7), torch.zeros(7)))
    assert float(step.abs().max()) < 1e-5
