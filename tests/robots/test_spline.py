"""The clamped spline against scipy's."""

import numpy as np
import torch
from scipy.interpolate import CubicSpline

from torchcloth.robots.spline import Spline


def test_agrees_with_scipy():
    generator = torch.Generator().manual_seed(0)
    t = torch.rand(30, generator=generator, dtype=torch.float64).add(0.05).cumsum(0)
    q = torch.randn(30, 7, generator=generator, dtype=torch.float64)
    ours, truth = Spline.through(t, q), CubicSpline(t.numpy(), q.numpy(), bc_type="clamped")
    times = torch.linspace(float(t[0]), float(t[-1]), 1000, dtype=torch.float64)
    position, velocity = ours.at(times)
    np.testing.assert_allclose(position, truth(times.numpy()), atol=1e-11)
    np.testing.assert_allclose(velocity, truth(times.numpy(), 1), atol=1e-9)
    np.testing.assert_allclose(ours.acceleration, truth(t.numpy(), 2), atol=1e-8)


def test_slower_is_the_same_curve():
    t = torch.tensor([0.0, 0.5, 0.7, 2.0], dtype=torch.float64)
    spline = Spline.through(t, torch.tensor([[0.0], [1.0], [0.5], [2.0]], dtype=torch.float64))
    slow, times = spline.slower(3.0), torch.linspace(0, 2, 50, dtype=torch.float64)
    torch.testing.assert_close(slow.at(3 * times)[0], spline.at(times)[0])
    torch.testing.assert_close(slow.at(3 * times)[1], spline.at(times)[1] / 3)


def test_finer_keeps_every_knot():
    t = torch.tensor([0.0, 0.5, 0.52, 2.0], dtype=torch.float64)
    times = Spline.through(t, t[:, None]).finer(0.1)
    assert float(times.diff().max()) <= 0.1 + 1e-12
    assert float(times.diff().min()) > 0
    assert all(bool((times == knot).any()) for knot in t)
