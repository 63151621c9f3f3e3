"""The smooth curve through joint positions at knots: C2 cubic splines that start and end at rest."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class Spline(NamedTuple):
    """A cubic spline; accelerations are straight lines between knots, so they are greatest at a knot."""

    t: Tensor  # [K] s
    q: Tensor  # [K, J]
    acceleration: Tensor  # [K, J] 1/s^2

    @classmethod
    def through(cls, t: Tensor, q: Tensor) -> Spline:
        """The spline through ``q [K, J]`` at ``t [K]`` s with no velocity at either end."""
        h = t.diff()
        slope = q.diff(dim=0) / h[:, None]
        ends = torch.cat([slope.new_zeros(1, q.shape[1]), slope, slope.new_zeros(1, q.shape[1])])
        matrix = torch.diag(torch.cat([2 * h[:1], 2 * (h[1:] + h[:-1]), 2 * h[-1:]]))
        matrix = matrix + torch.diag(h, 1) + torch.diag(h, -1)
        return cls(t, q, torch.linalg.solve(matrix, 6 * ends.diff(dim=0)))

    def at(self, times: Tensor) -> tuple[Tensor, Tensor]:
        """Positions and velocities, each [N, J], at ``times`` [N] s."""
        k = (torch.searchsorted(self.t, times, right=True) - 1).clamp(0, len(self.t) - 2)
        h = (self.t[k + 1] - self.t[k])[:, None]
        s = (times - self.t[k])[:, None]
        rise = (self.acceleration[k + 1] - self.acceleration[k]) / h
        start = (self.q[k + 1] - self.q[k]) / h - h * (2 * self.acceleration[k] + self.acceleration[k + 1]) / 6
        q = self.q[k] + s * (start + s * (self.acceleration[k] / 2 + s * rise / 6))
        return q, start + s * (self.acceleration[k] + s * rise / 2)

    def sampled(self, period: float) -> tuple[Tensor, Tensor]:
        """Positions [N, J] at the times [N] s of ``finer``, and these."""
        times = self.finer(period)
        return self.at(times)[0], times

    def slower(self, factor: float) -> Spline:
        """The same curve in ``factor`` times the time."""
        return Spline(factor * self.t, self.q, self.acceleration / factor**2)

    def finer(self, period: float) -> Tensor:
        """Times [N] s no more than ``period`` apart, every knot among them."""
        counts = (self.t.diff() / period - 1e-6).ceil().clamp(min=1).long()
        parts = [
            a + (b - a) * torch.arange(n, dtype=a.dtype) / n
            for a, b, n in zip(self.t[:-1], self.t[1:], counts.tolist(), strict=True)
        ]
        return torch.cat([*parts, self.t[-1:]])
