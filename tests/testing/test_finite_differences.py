"""The sweep accepts right derivatives of every kind and rejects wrong ones, whatever single step they might pass."""

import math

import pytest
import torch

from torchcloth.errors import InvalidInput
from torchcloth.testing import check_gradients, finite_difference_sweep

POINT, ALONG = torch.tensor([0.7, 0.3], dtype=torch.float64), torch.tensor([1.0, -0.5], dtype=torch.float64)


def wave(x):
    return (x[0] * 3).sin() * x[1].exp()


SLOPE = (3 * math.cos(2.1) - 0.5 * math.sin(2.1)) * math.exp(0.3)


def test_a_right_derivative_passes_and_reports_its_error():
    sweep = finite_difference_sweep(wave, POINT, ALONG, SLOPE)
    assert sweep.check(1e-9) < 1e-9
    assert "slope" in str(sweep)


@pytest.mark.parametrize("error", [1e-2, 1e-4, -1e-4, 1e-6, 3e-7])
def test_a_wrong_derivative_fails(error):
    """Also where the truncation error cancels it at one of the steps."""
    sweep = finite_difference_sweep(wave, POINT, ALONG, SLOPE * (1 + error))
    with pytest.raises(AssertionError, match="claimed derivative"):
        sweep.check(1e-7)


def test_a_lucky_step_does_not_save_a_wrong_derivative():
    """The claim is the estimate at the second coarsest step: exact there, wrong elsewhere."""
    lucky = float(finite_difference_sweep(wave, POINT, ALONG, SLOPE).estimates[1])
    assert abs(lucky / SLOPE - 1) > 1e-4
    with pytest.raises(AssertionError):
        finite_difference_sweep(wave, POINT, ALONG, lucky).check(1e-7)


def test_parabolas_have_no_truncation_error():
    finite_difference_sweep(lambda x: (x * x).sum(), POINT, ALONG, 2 * float(POINT @ ALONG)).check(1e-10)


def test_a_derivative_of_zero():
    finite_difference_sweep(lambda x: 0 * x.sum() + 3.0, POINT, ALONG, 0.0).check()
    with pytest.raises(AssertionError):
        finite_difference_sweep(wave, POINT, ALONG, 0.0).check()


def test_a_kink_within_reach_is_left_out():
    def kinked(x):
        return wave(x) + (x[0] - 0.72).clamp(min=0)

    finite_difference_sweep(kinked, POINT, ALONG, SLOPE).check(1e-8)


@pytest.mark.parametrize("claim", [SLOPE, SLOPE + 1.0, SLOPE + 0.5])
def test_a_kink_at_the_point_fails(claim):
    """At 0.5, half of both slopes, every central difference agrees: only the second differences show the kink."""
    sweep = finite_difference_sweep(lambda x: wave(x) + (x[0] - 0.7).clamp(min=0), POINT, ALONG, claim)
    with pytest.raises(AssertionError):
        sweep.check()


def test_nan_fails():
    with pytest.raises(AssertionError, match="not finite"):
        finite_difference_sweep(lambda x: (x[0] - 0.7).sqrt(), POINT, ALONG, 1.0).check()
    with pytest.raises(AssertionError, match="not finite"):
        finite_difference_sweep(wave, POINT, ALONG, float("nan")).check()


def test_noise_that_hides_the_derivative_fails():
    """A function rounded to float32 cannot show 1e-7, and the sweep says so instead of accepting."""
    with pytest.raises(AssertionError):
        finite_difference_sweep(lambda x: wave(x).float().double(), POINT, ALONG, SLOPE).check(1e-7)


def test_refusals():
    with pytest.raises(InvalidInput, match="float64"):
        finite_difference_sweep(wave, POINT.float(), ALONG, SLOPE)
    with pytest.raises(InvalidInput, match="scalar"):
        finite_difference_sweep(lambda x: x, POINT, ALONG, SLOPE)


def test_check_gradients_may_demand_that_inputs_act():
    apart = {"a": POINT, "b": ALONG}
    check_gradients(lambda a, b: a.sin() + 0 * b, apart)
    with pytest.raises(AssertionError, match=r"'b': it does not move the result"):
        check_gradients(lambda a, b: a.sin() + 0 * b, apart, acts=True)
    check_gradients(lambda a, b: a.sin() + b, apart, acts=True)


def test_check_gradients_names_the_input():
    best = check_gradients(lambda a, b: a.sin() * b, {"a": POINT, "b": ALONG})
    assert max(best.values()) < 1e-7
    with pytest.raises(AssertionError, match="gradient in 'b'"):
        check_gradients(lambda a, b: a.sin() * b.detach(), {"a": POINT, "b": ALONG})


@pytest.mark.parametrize("claim", [math.inf, -math.inf])
def test_a_derivative_without_bounds_fails(claim):
    x, one = torch.tensor([2.0], dtype=torch.float64), torch.ones(1, dtype=torch.float64)
    with pytest.raises(AssertionError, match="not finite"):
        finite_difference_sweep(lambda p: p.square().sum(), x, one, claim).check()
