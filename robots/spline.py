"""Smooth curves through joint positions: cubic splines (C2) that start and end at rest."""

from __future__ import annotations

import torch
from torch import Tensor


class ClampedSpline:
    """A cubic spline through knots with zero velocity at both ends; no gradient flows through it.

    Its accelerations are linear between knots, so they are largest at a knot.

    Args:
        t: [K] s, times of the knots.
        q: [K, J], positions at the knots.
    """

    def __init__(self, t: Tensor, q: Tensor) -> None:
        from scipy.interpolate import CubicSpline

        self.t, self.q = t, q.detach()
        self._curve = CubicSpline(t.detach().cpu().numpy(), self.q.cpu().numpy(), bc_type="clamped")

    def positions(self, times: Tensor) -> Tensor:
        """Return the positions [N, J] at ``times`` [N] s."""
        return self._derivative(times, 0)

    def velocities(self, times: Tensor) -> Tensor:
        """Return the velocities [N, J] at ``times`` [N] s."""
        return self._derivative(times, 1)

    def knot_accelerations(self) -> Tensor:
        """Return the accelerations [K, J] at the knots."""
        return self._derivative(self.t, 2)

    def slow_down(self, factor: float) -> ClampedSpline:
        """Return the same curve in ``factor`` times the time."""
        return ClampedSpline(factor * self.t, self.q)

    def sample(self, period: float) -> tuple[Tensor, Tensor]:
        """Return positions [N, J] and their times [N] s, at most ``period`` [s] apart, with every knot among them."""
        times = subdivide_times(self.t, period)
        return self.positions(times), times

    def _derivative(self, times: Tensor, order: int) -> Tensor:
        return torch.as_tensor(self._curve(times.detach().cpu().numpy(), order)).to(self.q)


def subdivide_times(knots: Tensor, period: float) -> Tensor:
    """Return times [N] s at most ``period`` [s] apart, with every one of the knots [K] s among them."""
    counts = (knots.diff() / period - 1e-6).ceil().clamp(min=1).long()
    parts = [
        a + (b - a) * torch.arange(n, dtype=a.dtype) / n
        for a, b, n in zip(knots[:-1], knots[1:], counts.tolist(), strict=True)
    ]
    return torch.cat([*parts, knots[-1:]])
