"""Parabolas lead the warm start from a wrong data sheet to where slopes are valid."""

import pytest
import torch

from torchcloth.diagnosis.decide.criteria import CRITERIA
from torchcloth.diagnosis.inference.warm_start import _fit_parabola, _minimise_parabola


def quotients(curve, ahead, back):
    """What differences along one coordinate are; of a step of no length, nothing."""
    zero = torch.zeros(1).double()
    up = (curve(ahead) - curve(zero)) / ahead if float(ahead) else torch.zeros(3, 1).double()
    down = (curve(zero) - curve(-back)) / back if float(back) else torch.zeros(3, 1).double()
    return up, down


@pytest.mark.parametrize(("ahead", "back"), [(1.0, 1.0), (1.0, 0.4), (0.3, 1.0), (1.0, 0.0), (0.0, 1.0)])
def test_a_parabola_passes_through_both_sides_however_far_each_goes(ahead, back):
    """One side that ends at once, as stiffening below none, leaves a straight line and not half a parabola."""
    a, b = (torch.tensor([step]).double() for step in (ahead, back))
    first, second = (torch.tensor(v).double()[:, None] for v in ([1.0, -2.0, 0.5], [0.3, 0.1, -0.2]))

    def curve(u):
        return first * u + second * u * u

    slope, bend = _fit_parabola(*quotients(curve, a, b), a, b)
    for end in (a, -b):
        torch.testing.assert_close(slope * end + bend * end**2, curve(end))
    assert torch.allclose(bend, second if ahead and back else 0 * second)


def test_the_lowest_place_lies_within_the_ends_and_the_others_make_up_for_it():
    """Two coordinates that do nearly the same, of which the first is wanted beyond its end."""
    rng = torch.Generator().manual_seed(0)
    a = torch.randn(50, generator=rng).double()
    slope = torch.stack([a, a + 0.3 * torch.randn(50, generator=rng).double()], 1)
    value = -slope @ torch.tensor([-0.8, 0.1]).double()
    none, pull = torch.zeros(2).double(), torch.full((2,), 1e-3).double()
    far = torch.full((2,), CRITERIA.warm_start.max_step_widths).double()
    free = _minimise_parabola(value, slope, 0 * slope, none, pull, (-far, far))
    assert free.tolist() == pytest.approx([-0.8, 0.1], abs=1e-3)
    bounded = _minimise_parabola(
        value, slope, 0 * slope, none, pull, (torch.tensor([0.0, -CRITERIA.warm_start.max_step_widths]).double(), far)
    )
    other = -float(slope[:, 1] @ value / (slope[:, 1] @ slope[:, 1]))
    assert bounded.tolist() == pytest.approx([0.0, other], abs=1e-3)
