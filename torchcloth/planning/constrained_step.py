"""Steps that keep the limits, by their dual."""

from __future__ import annotations

import torch
from torch import Tensor

from .motion_parameters import Bounds

ROUNDS = 2000  # of the dual's accelerated ascent
ROUNDING = 1e-10  # of the largest curvature: where cloth is chaotic, others are lost beside it
SLACK = 1e-5  # rad, rad/s, rad/s^2 (or with m), that may lie beyond a bound: where no room is left nothing is exact


def step_within(at: Tensor, gradient: Tensor, curvature: Tensor, bounds: Bounds) -> Tensor:
    """The step [N] that minimises gradient s + 1/2 s curvature s while the bounds are kept at ``at + s``.

    Accelerated ascent of the dual (Beck and Teboulle 2009) with restarts, s = -curvature^-1 (gradient + rows^T push).
    What that leaves beyond a bound is drawn towards ``at``, which is within, coordinate by coordinate: bounds are kept
    to ``SLACK``.

    Args:
        at: [N], within the bounds.
        gradient: [N].
        curvature: [N, N], positive definite up to rounding.
        bounds: low <= rows z <= high.
    """
    ridge = ROUNDING * float(curvature.diagonal().max()) * torch.eye(len(at)).to(curvature)
    root = torch.linalg.cholesky(curvature + ridge)
    free = -torch.cholesky_solve(gradient[:, None], root)[:, 0]
    before = bounds.rows @ at
    low, high = (bounds.low - before).clamp(max=0.0), (bounds.high - before).clamp(min=0.0)
    reached = bounds.rows @ free
    if bool((reached >= low).all() & (reached <= high).all()):
        return free
    give = torch.cholesky_solve(bounds.rows.mT, root)  # [N, R]
    size = (bounds.rows * give.mT).sum(1).clamp(min=1e-30).sqrt()
    rows, give, low, high, slack = bounds.rows / size[:, None], give / size, low / size, high / size, SLACK / size
    pace = float(torch.linalg.matrix_norm(torch.linalg.solve_triangular(root, rows.mT, upper=False), 2)) ** 2
    push = ahead = torch.zeros_like(low)
    speed = 1.0
    for k in range(ROUNDS):
        there = rows @ (free - give @ ahead)
        new = ahead + (there - (there + pace * ahead).clamp(low, high)) / pace
        if float((ahead - new) @ (new - push)) > 0:  # it has gone too far (O'Donoghue and Candes 2015)
            speed = 1.0
        faster = 0.5 * (1 + (1 + 4 * speed**2) ** 0.5)
        ahead = new + (speed - 1) / faster * (new - push)
        push, speed = new, faster
        if k % 50 == 49:
            there = rows @ (free - give @ push)
            if bool((there >= low - slack).all() & (there <= high + slack).all()):
                break
    step = free - give @ push
    reached = bounds.rows @ step
    room = (torch.where(reached > 0, bounds.high - before, before - bounds.low) + SLACK).clamp(min=0.0)
    share = torch.ones(int(bounds.groups.max()) + 1).to(step)
    share = share.scatter_reduce(0, bounds.group, room / reached.abs().clamp(min=1e-300), "amin")
    return step * share[bounds.groups]
