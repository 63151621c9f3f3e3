"""A step of several unknowns that depend on each other, each within bounds of its own."""

from __future__ import annotations

import torch
from torch import Tensor


def bounded(matrix: Tensor, right: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """The minimum [K] of ``0.5 s @ matrix @ s - right @ s`` between ``low`` <= 0 and ``high`` >= 0, by active sets.

    What stays free makes up for what is held at its bound. A solution that is merely cut, one by one, may lead uphill.
    """
    held, step = torch.zeros_like(right, dtype=torch.bool), torch.zeros_like(right)
    for _ in range(10 * len(right)):
        free, wanted = ~held, step.clone()
        wanted[free] = torch.linalg.solve(matrix[free][:, free], right[free] - matrix[free][:, held] @ step[held])
        beyond = (wanted < low) | (wanted > high)
        if bool(beyond.any()):  # as far as the first bound
            share = torch.where(beyond, (wanted.clamp(low, high) - step) / (wanted - step), torch.inf)
            first = int(share.argmin())
            step = step + share[first] * (wanted - step)
            step[first], held[first] = wanted.clamp(low, high)[first], True
            continue
        step, slope = wanted, matrix @ wanted - right
        pressing = held & (torch.where(step <= low, -slope, slope) > 0) & (low < high)  # inwards, from its bound
        if not bool(pressing.any()):
            break
        gain = slope.square() / matrix.diagonal()
        held[int(torch.where(pressing, gain, -torch.inf).argmax())] = False
    return step.clamp(low, high)
