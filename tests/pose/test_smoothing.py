"""The covariance of many unknowns, whatever the slopes."""

import torch

from torchcloth.pose.smoothing import root_of


def test_the_root_is_that_of_the_inverse():
    draw = torch.Generator().manual_seed(0)
    jacobian = torch.randn(30, 12, generator=draw, dtype=torch.float64)
    prior_std = torch.logspace(-3, 1, 12, dtype=torch.float64)
    information = jacobian.mT @ jacobian
    root = root_of(information, prior_std)
    expected = torch.linalg.inv(information + torch.diag(prior_std**-2))
    torch.testing.assert_close(root @ root.mT, expected, rtol=1e-8, atol=1e-12)


def test_slopes_of_an_unstable_motion_leave_a_covariance():
    """Information whose rounding is larger than the prior's: directions that it does not tell keep the prior's size."""
    draw = torch.Generator().manual_seed(1)
    jacobian = 1e12 * torch.randn(5, 12, generator=draw, dtype=torch.float64)
    prior_std = torch.ones(12, dtype=torch.float64)
    information = jacobian.mT @ jacobian
    assert int(torch.linalg.cholesky_ex(information + torch.eye(12, dtype=torch.float64))[1])
    root = root_of(information, prior_std)
    covariance = root @ root.mT
    told = torch.linalg.qr(jacobian.mT)[0]
    assert float((told.mT @ covariance @ told).diagonal().max()) < 1e-3
    assert float(covariance.trace()) < 7 + 1e-3
    assert float(covariance.diagonal().min()) > 0
