"""Tangents against finite steps, where numbers overflow: NaN is a named case and never zero."""

from types import SimpleNamespace

import pytest
import torch
from helpers import least_squares

from torchcloth.identification.estimators import levenberg_marquardt, linearity, statistical_linearisation
from torchcloth.identification.residuals.blocks import RESIDUAL_BLOCKS
from torchcloth.identification.uncertainty.identifiability import ParameterInfluence

ONE = torch.ones(3, dtype=torch.float64)


@pytest.fixture
def problem():
    """(a linear problem without simulation, its solution); ``secants`` are what the test makes them."""
    draw = torch.Generator().manual_seed(0)
    slopes, (frame, patch) = least_squares.draw_jacobian(draw), least_squares.row_layout()
    value = least_squares.SIGMA_M * torch.randn(len(frame), generator=draw, dtype=torch.float64)
    linear = levenberg_marquardt.Linearised(value, slopes, torch.ones_like(value), frame, patch)
    solver = levenberg_marquardt.Problem(None, None, None, 0 * ONE, 5 * ONE, ONE, torch.tensor([least_squares.SIGMA_M]))
    objective = SimpleNamespace(
        problem=lambda: solver,
        unknowns=[SimpleNamespace(name=name, measured=False) for name in "abc"],
        blocks=RESIDUAL_BLOCKS[:1],
        cloth=SimpleNamespace(mesh=SimpleNamespace(extent=1e9)),
        linearise_by_differences=lambda raw, steps: (linear, ParameterInfluence(ONE, ONE)),
    )
    return objective, levenberg_marquardt.evaluate_point(solver, 0 * ONE, linear)


def test_slopes_that_hold_are_not_withdrawn(problem):
    checked = linearity.check_linearity(*problem)
    assert not checked.is_withdrawn
    assert checked.curved_parameters == []


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_finite_steps_that_overflow_withdraw_the_tangents(problem, value):
    objective, final = problem
    broken = final.linear._replace(jacobian=final.linear.jacobian.clone())
    broken.jacobian[0, 1] = value
    objective.linearise_by_differences = lambda raw, steps: (broken, ParameterInfluence(ONE, ONE))
    checked = linearity.check_linearity(objective, final)
    assert checked.is_withdrawn
    assert "tangents of b differ from finite steps" in checked.failure_reason


def test_a_parameter_that_fails_alone_is_no_estimate_and_the_others_stay(problem):
    objective, final = problem
    secants = final.linear._replace(jacobian=final.linear.jacobian.clone())
    secants.jacobian[:, 1] *= -1
    objective.linearise_by_differences = lambda raw, steps: (secants, ParameterInfluence(ONE, ONE))
    checked = linearity.check_linearity(objective, final)
    assert not checked.is_withdrawn
    assert checked.unusable_parameters == ("b",)
    assert "no estimate of b" in checked.warnings[0]
    assert torch.equal(checked.final.linear.jacobian[:, 1], secants.jacobian[:, 1])
    assert torch.equal(checked.final.linear.jacobian[:, ::2], final.linear.jacobian[:, ::2])


def test_without_grippers_that_feel_nothing_reaches_forces():
    objective = SimpleNamespace(unknowns=[0, 1])
    draw = torch.Generator().manual_seed(0)
    raws = torch.randn(12, 2, generator=draw, dtype=torch.float64)
    slope = torch.tensor([[1.0, 0, 0], [0, 0, 0]], dtype=torch.float64)
    near = [
        statistical_linearisation.Sample(raw, raw[:1], (raw @ slope)[None, None], torch.zeros(0, 3)) for raw in raws
    ]
    reach = statistical_linearisation._influence(objective, near, torch.zeros(2, dtype=torch.float64))
    assert reach.position[0] == pytest.approx(1.0, rel=1e-3)
    assert torch.equal(reach.force, torch.zeros(2, dtype=torch.float64))
