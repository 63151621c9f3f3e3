"""What the data can tell, on problems where it is known."""

import math
from types import SimpleNamespace

import pytest
import torch
from helpers import stretched_sheets, twins

from torchcloth.episodes.unknowns import collect_unknowns
from torchcloth.identification import identify
from torchcloth.identification.uncertainty.estimates import Estimate
from torchcloth.identification.uncertainty.identifiability import (
    ParameterInfluence,
    describe_influences,
    find_combinations,
    suggest_experiment,
)

NAMES = ("youngs_modulus", "areal_density", "air.normal")


@pytest.fixture
def unknowns(model):
    return collect_unknowns(model, NAMES, None)


@pytest.mark.parametrize("start_size", [0.0, 0.5, 20.0])
def test_an_amplitudes_prior_is_as_wide_as_its_start_asks_for(model, start_size):
    """A stiff start on a data sheet may be wrong by its own size."""
    typical = model.effects["air"].amplitudes["normal"].typical
    with torch.no_grad():
        model.effects["air"].normal.raw.fill_(start_size * typical)
    (unknown,) = collect_unknowns(model, ("air.normal",), None)
    assert unknown.prior_std == 2.0 * max(typical, abs(unknown.start))


def start(unknowns):
    return torch.tensor([u.start for u in unknowns])


def after(information, unknowns):
    """Covariance with the priors."""
    return torch.linalg.inv(information + torch.diag(torch.tensor([u.prior_std**-2 for u in unknowns])))


def test_a_ratio_that_alone_is_known_is_named(unknowns):
    """ln E - ln rho to 2 %, nothing else: positions without force."""
    slope = torch.tensor([1.0, -1.0, 0.0])
    result = find_combinations(unknowns, start(unknowns), after(torch.outer(slope, slope) / 0.02**2, unknowns))
    known = [c for c in result if c.determined]
    assert len(known) == 1
    assert set(known[0].powers) == {"youngs_modulus", "areal_density"}
    assert known[0].powers["youngs_modulus"] * known[0].powers["areal_density"] == pytest.approx(-1.0, rel=1e-6)
    assert known[0].std == pytest.approx(0.02, rel=1e-3)
    assert known[0].text in ("youngs_modulus · areal_density^-1", "areal_density · youngs_modulus^-1")


def test_parameters_that_are_known_alone_are_no_combination(unknowns):
    information = torch.diag(torch.tensor([1e4, 1e2, 1e3]))
    assert find_combinations(unknowns, start(unknowns), after(information, unknowns)) == []


def test_nuisances_are_allowed_for(unknowns):
    """An offset that only shows together with the modulus: without its prior the modulus would not be known."""
    together = torch.tensor([1.0, 0.0, 0.0, 1.0])
    information = torch.outer(together, together) / 0.01**2 + torch.diag(torch.tensor([0, 1e4, 1e4, 0.5**-2]))
    prior = torch.diag(torch.tensor([*(u.prior_std**-2 for u in unknowns), 0.0]))
    marginal = torch.linalg.inv(information + prior)
    assert float(marginal[0, 0]) ** 0.5 == pytest.approx(0.5, rel=0.05)
    assert not [c for c in find_combinations(unknowns, start(unknowns), marginal) if c.determined]


def test_a_singular_covariance_has_no_combinations(unknowns):
    """As of a motion whose slopes run away: the fit must still be told."""
    for covariance in (torch.ones(3, 3), torch.zeros(3, 3), torch.full((3, 3), torch.inf)):
        assert find_combinations(unknowns, start(unknowns), covariance.double()) == []


def test_reach_is_told_in_millimetres_and_newtons(unknowns):
    reach = ParameterInfluence(torch.tensor([2e-3, 1e-3, 0.0]), torch.tensor([0.5, 0.0, 0.0]))
    known = {n: Estimate(1.0, 0.1, (0.8, 1.2), "-", 1.0, n == "youngs_modulus") for n in NAMES}
    result = describe_influences(unknowns, start(unknowns), reach, known)
    assert result["youngs_modulus"].displacement_per_10_percent_mm == pytest.approx(0.2)  # of the logarithm
    assert result["youngs_modulus"].force_per_10_percent_n == pytest.approx(0.05)
    assert result["youngs_modulus"].displacement_per_prior_std_mm == pytest.approx(2 * math.log(10))
    assert result["youngs_modulus"].experiment == ""
    assert result["areal_density"].statement == "not identifiable from these data"
    assert "weigh" in result["areal_density"].experiment
    assert result["air.normal"].statement == "no effect on these data"


def test_every_parameter_has_an_experiment():
    for name in ("youngs_modulus", "weft_modulus", "bending.stiffness", "bending.damping_time", "cone", "air.wind"):
        assert suggest_experiment(name) != suggest_experiment("something else")
    assert "force" in suggest_experiment("youngs_modulus")
    assert "overhang" in suggest_experiment("bending.stiffness")


@pytest.mark.slow
def test_without_force_only_the_ratio_and_with_force_both():
    """Equivalence 2 of mechanics: motion alone does not know a scale. A twin's density, free of its measurement."""
    with twins.use_float64():
        pulled = stretched_sheets.record_episode()
        model = stretched_sheets.build_start_cloth(pulled, youngs_modulus=6.5e4, poisson_ratio=0.3)
        for name in ("air.normal", "bending.stiffness"):  # they would tell a scale
            model.get_submodule(f"effects.{name}").set(0.0)
    names = ["youngs_modulus", "areal_density"]
    options = {"iterations": 2, "nuisances": {"grasp": 1e-3}, "exact_bench": True}
    blind = identify(model, pulled, names, use=["points"], **options)
    felt = identify(model, pulled, names, **options)
    assert blind.parameters["areal_density"].std > 3 * felt.parameters["areal_density"].std
    best = blind.combinations[0]
    assert best.powers["areal_density"] / best.powers["youngs_modulus"] == pytest.approx(-1.0, abs=0.4)
    content = felt.as_dict()
    assert set(content["identifiability"]) == set(names)
    assert SimpleNamespace(**content["identifiability"]["youngs_modulus"]).force_per_10_percent_n > 0.01
