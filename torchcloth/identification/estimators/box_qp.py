"""Quadratic programme of several dependent unknowns, each within bounds, by active sets."""

from __future__ import annotations

import torch
from torch import Tensor


def solve_box_qp(matrix: Tensor, right: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Return the minimum [K] of ``0.5 s @ matrix @ s - right @ s`` between ``low`` <= 0 and ``high`` >= 0.

    Free unknowns make up for those at a bound. A solution whose entries are merely clipped may lead uphill.
    """
    at_bound, step = torch.zeros_like(right, dtype=torch.bool), torch.zeros_like(right)
    for _ in range(10 * len(right)):
        free, target = ~at_bound, step.clone()
        coupling = matrix[free][:, at_bound] @ step[at_bound]
        target[free] = torch.linalg.solve(matrix[free][:, free], right[free] - coupling)
        outside = (target < low) | (target > high)
        if bool(outside.any()):  # go as far as the first bound
            fraction = torch.where(outside, (target.clamp(low, high) - step) / (target - step), torch.inf)
            first = int(fraction.argmin())
            step = step + fraction[first] * (target - step)
            step[first], at_bound[first] = target.clamp(low, high)[first], True
            continue
        step, gradient = target, matrix @ target - right
        points_inwards = torch.where(step <= low, -gradient, gradient) > 0
        releasable = at_bound & points_inwards & (low < high)
        if not bool(releasable.any()):
            break
        gain = gradient.square() / matrix.diagonal()
        at_bound[int(torch.where(releasable, gain, -torch.inf).argmax())] = False
    return step.clamp(low, high)
