"""Quadratic steps within linear bounds."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from .motion_parameters import LinearBounds

RIDGE_RATIO = 1e-10  # of the largest curvature; without it, rounding hides small curvatures where cloth is chaotic
SOLVER_INFINITY = 1e30  # the solver's value for a bound that is absent
BOUND_TOLERANCE = 1e-5  # rad, rad/s, rad/s^2 (or m, m/s, m/s^2): how far rounding may take a step beyond a bound


def solve_constrained_step(at: Tensor, gradient: Tensor, curvature: Tensor, bounds: LinearBounds) -> Tensor:
    """Return the step that minimises a quadratic model while ``at + step`` stays within the bounds.

    The step minimises ``gradient @ s + 0.5 * s @ curvature @ s``. The quadratic programme is solved exactly by the dual
    active-set method DAQP (Arnstrom, Bemporad and Axehill 2022).

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
    whitened = -torch.linalg.solve_triangular(root, gradient[:, None], upper=False)[:, 0]
    value = bounds.rows @ at
    low, high = (bounds.low - value).clamp(max=0.0), (bounds.high - value).clamp(min=0.0)
    step = _unwhiten(root, whitened)
    change = bounds.rows @ step
    if bool((change >= low).all() & (change <= high).all()):
        return step

    import daqp

    # In whitened coordinates y = root^T s the model is 0.5 |y - whitened|^2; constraints have unit normals.
    normals = torch.linalg.solve_triangular(root, bounds.rows.mT, upper=False).mT  # [R, N]
    size = normals.norm(dim=1).clamp(min=1e-15)
    normals = np.ascontiguousarray((normals / size[:, None]).double().numpy())
    identity, linear = np.eye(len(at)), -whitened.double().numpy()
    for tolerance in (0.0, BOUND_TOLERANCE):  # rounding can make bounds that leave no room contradict each other
        upper = ((high + tolerance) / size).double().clamp(max=SOLVER_INFINITY).numpy()
        lower = ((low - tolerance) / size).double().clamp(min=-SOLVER_INFINITY).numpy()
        solution, _, exit_flag, _ = daqp.solve(
            identity, linear, normals, upper, lower, np.zeros(len(upper), dtype=np.int32)
        )
        if exit_flag <= 0:
            continue
        step = _unwhiten(root, torch.as_tensor(np.array(solution)).to(at))
        change = bounds.rows @ step
        room = torch.where(change > 0, high, -low) + BOUND_TOLERANCE
        return step * float((room / change.abs().clamp(min=1e-300)).amin().clamp(max=1.0))
    return torch.zeros_like(at)


def _unwhiten(root: Tensor, whitened: Tensor) -> Tensor:
    return torch.linalg.solve_triangular(root.mT, whitened[:, None], upper=True)[:, 0]
