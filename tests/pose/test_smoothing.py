"""The covariance of many unknowns, whatever the slopes."""

import torch

from torchcloth.pose import smoothing
from torchcloth.pose.smoothing import DataInformation, compute_posterior


def problem(size, rows=30, count=12):
    draw = torch.Generator().manual_seed(0)
    jacobian = size * torch.randn(rows, count, generator=draw, dtype=torch.float64)
    value, offset = torch.randn(rows, generator=draw).double(), torch.randn(count, generator=draw).double()
    q, r = torch.linalg.qr(jacobian)
    return jacobian, value, offset, DataInformation(r, -(q.mT @ value))


def test_the_posterior_is_that_of_least_squares(monkeypatch):
    """In both ways."""
    jacobian, value, offset, informed = problem(1.0)
    prior_std = torch.logspace(-3, 1, 12, dtype=torch.float64)
    information = jacobian.mT @ jacobian + torch.diag(prior_std**-2)
    mean = torch.linalg.solve(information, -jacobian.mT @ value + offset / prior_std**2)
    for steep in (1e99, 0.0):
        monkeypatch.setattr(smoothing, "SMOOTHING_SETTINGS", smoothing.SmoothingSettings(max_squared_information=steep))
        root, step = compute_posterior(informed, prior_std, offset)
        torch.testing.assert_close(root @ root.mT, torch.linalg.inv(information), rtol=1e-8, atol=1e-12)
        torch.testing.assert_close(step, mean, rtol=1e-8, atol=1e-12)


def test_slopes_of_an_unstable_motion_leave_a_covariance_and_a_step():
    """Information whose rounding is larger than the prior's: directions that it does not tell keep the prior's size."""
    jacobian, _, offset, informed = problem(1e12, rows=5)
    information = jacobian.mT @ jacobian
    assert int(torch.linalg.cholesky_ex(information + torch.eye(12, dtype=torch.float64))[1])
    root, step = compute_posterior(informed, torch.ones(12, dtype=torch.float64), offset)
    covariance = root @ root.mT
    seen = torch.linalg.qr(jacobian.mT)[0]
    assert float((seen.mT @ covariance @ seen).diagonal().max()) < 1e-3
    torch.testing.assert_close(covariance.trace(), torch.tensor(7.0, dtype=torch.float64))
    unseen = torch.eye(12, dtype=torch.float64) - seen @ seen.mT
    torch.testing.assert_close(unseen @ step, unseen @ offset)
    assert float((seen.mT @ step).abs().max()) < 1e-6
