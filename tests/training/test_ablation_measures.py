"""The measures of the ablation against closed forms, brute force and scipy."""

import math

import numpy as np
import pytest
import torch

import torchcloth as tc
from torchcloth.dynamics.contact import Contact
from torchcloth.errors import InvalidInput
from torchcloth.materials import AEP
from torchcloth.training.ablation.measures import (
    bidirectional_chamfer,
    energies_without_each,
    energy_contributions,
    from_unbounded_poisson,
    rank_correlation,
    scaled_poisson,
    to_unbounded_poisson,
)
from torchcloth.training.ablation.paper_tables import CHAMFER, ENERGY
from torchcloth.training.ablation.scenes import (
    LEVELS,
    PARAMETERS,
)


def test_rescaling_of_poissons_ratio():
    """f is 0 at 0, 2 at 1/4, increasing, and its inverse undoes it; scaling keeps to [0, 0.5) and keeps the order."""
    assert to_unbounded_poisson(0.0) == 0.0
    assert to_unbounded_poisson(0.25) == pytest.approx(2.0)
    nu = np.linspace(0, 0.499, 200)
    f = np.array([to_unbounded_poisson(x) for x in nu])
    assert (np.diff(f) > 0).all()
    np.testing.assert_allclose([from_unbounded_poisson(y) for y in f], nu, atol=1e-12)
    for reference in (0.071, 0.121, 0.45):
        scaled = [scaled_poisson(reference, level / 100) for level in (0, *LEVELS)]
        assert scaled[0] == pytest.approx(0, abs=1e-12)
        assert (np.diff(scaled) > 0).all()
        assert scaled[-1] < 0.5
        assert scaled_poisson(reference, 1.0) == pytest.approx(reference)
    assert scaled_poisson(0.1, 0.5) == pytest.approx(0.5 - 1 / (0.5 * (1 / 0.4 - 2) + 2))
    assert from_unbounded_poisson(math.inf) == 0.5


@pytest.mark.parametrize("nu", [-0.01, 0.5, math.nan])
def test_poissons_ratio_out_of_bounds(nu):
    with pytest.raises(InvalidInput, match="nu"):
        to_unbounded_poisson(nu)


def test_chamfer_is_the_sum_of_both_directions():
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(40, 3)), rng.normal(size=(55, 3)) + 0.3
    distance = np.linalg.norm(a[:, None] - b[None], axis=-1)
    truth = distance.min(1).mean() + distance.min(0).mean()
    assert bidirectional_chamfer(torch.tensor(a), torch.tensor(b)) == pytest.approx(truth, rel=1e-12)
    assert bidirectional_chamfer(torch.tensor(b), torch.tensor(a)) == pytest.approx(truth, rel=1e-12)
    assert bidirectional_chamfer(torch.tensor(a), torch.tensor(a)) == 0.0


def test_a_small_shift_counts_twice():
    """While every vertex stays nearest to itself."""
    x = torch.cartesian_prod(*(torch.arange(5, dtype=torch.float64),) * 2, torch.zeros(1, dtype=torch.float64))
    assert bidirectional_chamfer(x, x + torch.tensor([0.1, 0.0, 0.0])) == pytest.approx(0.2)


def test_energy_without_each_parameter():
    """A sheet under uniform stretch (a, b), its directors compressed to R33 and sheared by r: closed form."""
    youngs, nu, k, gamma, play = 300e3, 0.12, 5e6, 4e5, 0.25
    material = AEP(youngs, nu, contact_stiffness=k, shear_stiffness=gamma, convention="paper")
    cloth = tc.Cloth(
        tc.meshes.rectangle(0.3, 0.2, triangles=24), material, 0.2, contact=Contact(0.08, free_compression=play)
    )
    a, b, height, r = 1.03, 0.98, 0.6, 0.1
    state = cloth.rest_state()
    state = state._replace(
        x=state.x * torch.tensor([a, b, 1.0]), d3=torch.tensor([r, 0.0, height]).expand_as(state.d3).clone()
    )
    result = {name: float(value.detach()) for name, value in energies_without_each(cloth.build_model(), state).items()}
    area, h = 0.06, 1e-3
    mu, lam = youngs / (2 * (1 + nu)), youngs * nu / ((1 + nu) * (1 - 2 * nu))
    stretch = (a - 1) ** 2 + (b - 1) ** 2
    terms = {
        "mu": area * h * mu * stretch,
        "nu": area * h * lam / 2 * (a * b - 1) ** 2,
        "k": area * h * k / 3 * (1 - height - play) ** 3,
        "gamma": area * h * gamma * r**2,  # the paper's convention has no half
    }
    total = sum(terms.values())
    assert result["total"] == pytest.approx(total, rel=1e-9)
    assert result["E"] == pytest.approx(terms["k"] + terms["gamma"], rel=1e-9)
    for j in ("nu", "k", "gamma"):
        assert result[j] == pytest.approx(total - terms[j], rel=1e-9)
    assert result["nu = 0"] == pytest.approx(total - terms["mu"] - terms["nu"] + area * h * youngs / 2 * stretch)
    share = energy_contributions({name: np.array([value, 3 * value]) for name, value in result.items()})
    assert share["k"] == pytest.approx(terms["k"] / total)
    assert share["E"] + share["k"] + share["gamma"] == pytest.approx(1.0)


def test_rank_correlation():
    assert rank_correlation([1, 2, 2, 3], [1, 2, 3, 4]) == pytest.approx(0.9 / 0.9**0.5)  # tied ranks are 2.5
    assert rank_correlation([1, 2, 3], [2.0, 8.0, 9.0]) == pytest.approx(1.0)
    assert math.isnan(rank_correlation([1.0, 1.0], [1.0, 2.0]))


def test_the_papers_tables_are_whole():
    for table, width in ((CHAMFER, len(LEVELS)), (ENERGY, None)):
        assert set(table) == {"fling", "drag", "cover"}
        for row in table.values():
            assert list(row) == list(PARAMETERS)
            assert width is None or {len(cells) for cells in row.values()} == {width}
    assert CHAMFER["cover"]["E"][-1] == 0.51
    assert ENERGY["cover"]["k"] == 12.6
