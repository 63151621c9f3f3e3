"""Quadratic steps within linear bounds, by the dual problem."""

from __future__ import annotations

import torch
from torch import Tensor

from .motion_parameters import LinearBounds

MAX_DUAL_ITERATIONS = 2000
DUAL_CHECK_INTERVAL = 50  # iterations between two checks of convergence
RIDGE_RATIO = 1e-10  # of the largest curvature; without it, rounding hides small curvatures where cloth is chaotic
BOUND_TOLERANCE = 1e-5  # rad, rad/s, rad/s^2 (or m, m/s, m/s^2): how far a step may exceed a bound


def solve_constrained_step(at: Tensor, gradient: Tensor, curvature: Tensor, bounds: LinearBounds) -> Tensor:
    """Return the step that minimises a quadratic model while ``at + step`` stays within the bounds.

    The step minimises ``gradient @ s + 0.5 * s @ curvature @ s``. The dual is maximised by accelerated gradient ascent
    (Beck and Teboulle 2009) with restarts (O'Donoghue and Candes 2015): s = -curvature^-1 (gradient + rows^T dual). If
    the ascent has not converged, the step is shortened, coordinate by coordinate, until it is within the bounds.

    Args:
        at: [N], a point within the bounds.
        gradient: [N], of the model at ``at``.
        curvature: [N, N], positive definite up to rounding.
        bounds: low <= rows @ z <= high.

    Returns:
        [N], the step. The bounds hold to ``BOUND_TOLERANCE``.
    """
    ridge = RIDGE_RATIO * float(curvature.diagonal().max()) * torch.eye(len(at)).to(curvature)
    root = torch.linalg.cholesky(curvature + ridge)
    unconstrained = -torch.cholesky_solve(gradient[:, None], root)[:, 0]
    value = bounds.rows @ at
    low, high = (bounds.low - value).clamp(max=0.0), (bounds.high - value).clamp(min=0.0)
    change = bounds.rows @ unconstrained
    if bool((change >= low).all() & (change <= high).all()):
        return unconstrained

    # Rows are scaled to unit response: a unit of their dual changes their own value by one.
    response = torch.cholesky_solve(bounds.rows.mT, root)  # [N, R]
    size = (bounds.rows * response.mT).sum(1).clamp(min=1e-30).sqrt()
    rows, response = bounds.rows / size[:, None], response / size
    low, high, tolerance = low / size, high / size, BOUND_TOLERANCE / size
    rate = float(torch.linalg.matrix_norm(torch.linalg.solve_triangular(root, rows.mT, upper=False), 2)) ** 2
    dual = extrapolated = torch.zeros_like(low)
    momentum = 1.0
    for k in range(MAX_DUAL_ITERATIONS):
        change = rows @ (unconstrained - response @ extrapolated)
        new = extrapolated + (change - (change + rate * extrapolated).clamp(low, high)) / rate
        if float((extrapolated - new) @ (new - dual)) > 0:  # restart after an overshoot
            momentum = 1.0
        next_momentum = 0.5 * (1 + (1 + 4 * momentum**2) ** 0.5)
        extrapolated = new + (momentum - 1) / next_momentum * (new - dual)
        dual, momentum = new, next_momentum
        if k % DUAL_CHECK_INTERVAL == DUAL_CHECK_INTERVAL - 1:
            change = rows @ (unconstrained - response @ dual)
            if bool((change >= low - tolerance).all() & (change <= high + tolerance).all()):
                break
    step = unconstrained - response @ dual

    change = bounds.rows @ step
    room = (torch.where(change > 0, bounds.high - value, value - bounds.low) + BOUND_TOLERANCE).clamp(min=0.0)
    fraction = torch.ones(int(bounds.unknown_group.max()) + 1).to(step)
    fraction = fraction.scatter_reduce(0, bounds.row_group, room / change.abs().clamp(min=1e-300), "amin")
    return step * fraction[bounds.unknown_group]
