"""Clamped splines of joint positions, and times between knots."""

import numpy as np
import torch
from scipy.interpolate import CubicSpline

from torchcloth.robots.spline import ClampedSpline, subdivide_times


def test_values_and_derivatives_are_those_of_scipy():
    generator = torch.Generator().manual_seed(0)
    t = torch.rand(30, generator=generator, dtype=torch.float64).add(0.05).cumsum(0)
    q = torch.randn(30, 7, generator=generator, dtype=torch.float64)
    spline, truth = ClampedSpline(t, q), CubicSpline(t.numpy(), q.numpy(), bc_type="clamped")
    times = torch.linspace(float(t[0]), float(t[-1]), 1000, dtype=torch.float64)
    np.testing.assert_allclose(spline.positions(times), truth(times.numpy()), atol=1e-11)
    np.testing.assert_allclose(spline.velocities(times), truth(times.numpy(), 1), atol=1e-9)
    np.testing.assert_allclose(spline.knot_accelerations(), truth(t.numpy(), 2), atol=1e-8)


def test_it_starts_and_ends_at_rest():
    t = torch.tensor([0.0, 0.5, 0.7, 2.0], dtype=torch.float64)
    spline = ClampedSpline(t, torch.tensor([[0.0], [1.0], [0.5], [2.0]], dtype=torch.float64))
    torch.testing.assert_close(spline.velocities(t[[0, -1]]), torch.zeros(2, 1, dtype=torch.float64))


def test_slowed_down_is_the_same_curve():
    t = torch.tensor([0.0, 0.5, 0.7, 2.0], dtype=torch.float64)
    spline = ClampedSpline(t, torch.tensor([[0.0], [1.0], [0.5], [2.0]], dtype=torch.float64))
    slow, times = spline.slow_down(3.0), torch.linspace(0, 2, 50, dtype=torch.float64)
    torch.testing.assert_close(slow.positions(3 * times), spline.positions(times))
    torch.testing.assert_close(slow.velocities(3 * times), spline.velocities(times) / 3)


def test_subdivided_times_contain_every_knot():
    t = torch.tensor([0.0, 0.5, 0.52, 2.0], dtype=torch.float64)
    times = subdivide_times(t, 0.1)
    assert float(times.diff().max()) <= 0.1 + 1e-12
    assert float(times.diff().min()) > 0
    assert all(bool((times == knot).any()) for knot in t)
