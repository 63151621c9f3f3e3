"""Estimators on one interface, several starts, priors, and resuming where a search was stopped."""

import contextlib
import math
from itertools import pairwise

import pytest
import torch
from helpers import least_squares, twins
from helpers.least_squares import solve

from torchcloth._utils.resume import ResumableStore
from torchcloth.episodes.unknowns import apply_priors, collect_unknowns
from torchcloth.errors import InvalidInput
from torchcloth.identification import build_episode, identify
from torchcloth.identification.estimators import levenberg_marquardt, multistart
from torchcloth.identification.estimators.gradient_descent import minimise_by_gradient_descent
from torchcloth.identification.estimators.objective import Objective
from torchcloth.identification.nuisances import select_nuisances

PAIR = ["youngs_modulus", "air.normal"]


@pytest.mark.slow
def test_lbfgs_finds_what_gauss_newton_finds(model, brief):
    """The same cost by reverse mode: the ends differ by a part of a standard error."""
    near = {"youngs_modulus": 5e4}
    a = identify(model, brief, PAIR, guess=near, exact_bench=True)
    b = identify(model, brief, PAIR, method="lbfgs", guess=near)
    assert b.fit["converged"]
    for name in PAIR:
        assert abs(a.parameters[name].value - b.parameters[name].value) < 0.5 * a.parameters[name].std, name
    assert b.fit["simulations"] > a.fit["simulations"]


def test_plain_descent_goes_downhill_slowly(model, brief):
    fit = identify(model, brief, PAIR, method="gradient-descent", iterations=3)
    chamfer = [entry["chamfer"] for entry in fit.history]
    assert all(later < earlier for earlier, later in pairwise(chamfer))
    (E0, a0), (E1, a1) = ([entry[n] for n in PAIR] for entry in fit.history[:2])
    assert math.hypot(math.log(E1 / E0), (a1 - a0) / 1.2) == pytest.approx(0.1, rel=1e-3)  # the rate
    assert not fit.fit["converged"]
    assert "areal_density" not in fit.parameters  # measured to 2 %, it went to 0.4 instead of 0.3: nothing held it
    assert any(w.startswith("areal density was taken as exact") for w in fit.warnings)


@pytest.mark.parametrize("method", ["adam", "gradient-descent"])
@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"priors": {"youngs_modulus": (1e6, 1.01)}}, "priors; got youngs_modulus with method .*; expected none"),
        ({"nuisances": ["clock", "grasp"]}, "nuisances; got clock, grasp with method .*; expected none"),
        ({"use": ["force"]}, "use; got force with method .*; expected none"),
    ],
)
def test_a_distance_is_not_weighed_against_priors(model, brief, method, options, said):
    """The stranger's: the prior was ignored by the search, and part of the error that was reported of it."""
    with pytest.raises(InvalidInput, match=said):
        identify(model, brief, PAIR, method=method, **options)


@pytest.mark.parametrize("adam", [True, False])
def test_descent_steps_by_each_unknowns_own_size(model, brief, adam):
    """A bowl with its bottom at twice the start: bending, of 1e-5 N m, gets as near as stiffness and drag do."""
    names = ["youngs_modulus", "air.normal", "bending.stiffness"]
    objective = Objective(
        model,
        collect_unknowns(model, names, None),
        [build_episode(model, brief)],
        nuisances=select_nuisances([], ["rim"]),
    )
    bottom = objective.start + 0.5 * objective.typical_changes

    def value_and_slope(question, raw, loss):
        away = (raw - bottom) / objective.typical_changes
        return away.square().sum(), 2 * away / objective.typical_changes

    objective.value_and_gradient = value_and_slope
    end = minimise_by_gradient_descent(objective, objective.start, 40, 0.1, lambda raw, o: False, adam=adam)
    assert torch.allclose(objective.typical_changes[:3], torch.tensor([1.0, 1.2, 1e-5], dtype=torch.float64), rtol=0.2)
    assert float(((end - bottom) / objective.typical_changes).abs().max()) < 0.1


def test_a_search_that_was_stopped_ends_as_if_it_had_not_been(model, brief, tmp_path, monkeypatch):
    """Stopped after every single answer, for every estimator: same history, values and count of simulations."""

    class Stop(Exception):
        pass

    def write(*args):
        stored(*args)
        raise Stop

    stored = ResumableStore._write
    for method in ("gauss-newton", "lbfgs"):
        options = {"method": method, "iterations": 2, "guess": {"youngs_modulus": 5e4}, "exact_bench": True}
        whole, folder, resumed, stops = identify(model, brief, PAIR, **options), tmp_path / method, None, 0
        while resumed is None:
            with monkeypatch.context() as patch, contextlib.suppress(Stop):
                patch.setattr(ResumableStore, "_write", write)
                resumed = identify(model, brief, PAIR, journal=folder, resume=stops > 0, **options)
            stops += resumed is None
        assert stops > 5
        assert resumed.history == whole.history
        assert resumed.parameters == whole.parameters
        assert {**resumed.fit, "seconds": 0} == {**whole.fit, "seconds": 0}
        assert torch.equal(resumed.frames_after[0], whole.frames_after[0])
        with pytest.raises(InvalidInput, match="of another fit"):
            identify(model, brief, PAIR[:1], journal=folder, resume=True, **options)


# -- starts ----------------------------------------------------------------------------------------------------------


def test_starts_are_spread_over_two_decades(model):
    unknowns = collect_unknowns(model, ["youngs_modulus", "poisson_ratio", "air.normal"], (0.3, 0.005))
    begin = torch.tensor([u.start for u in unknowns], dtype=torch.float64)
    result = torch.stack(multistart.sample_starts(unknowns, begin, 33))
    assert torch.equal(result[0], begin)
    decades = (result[:, 0] - begin[0]) / 2.302585
    assert float(decades.min()) < -0.9
    assert float(decades.max()) > 0.9
    counts = torch.histc(decades[1:], 4, -1, 1)
    assert float(counts.min()) >= 7  # evenly
    assert float(result[:, 2].min()) >= 0.0  # amplitudes stay legal
    assert torch.equal(result[:, 3], begin[3].expand(33))  # what was measured stays


def test_starts_that_agree_are_counted():
    toy, _ = least_squares.make_linear_problem(0)
    ends = [solve(toy), solve(toy, start=torch.tensor([1.0, -1.0, 0.5], dtype=torch.float64))]
    astray = ends[0]._replace(raw=ends[0].raw + 5.0)
    astray = levenberg_marquardt.evaluate_point(toy.problem(), astray.raw, toy._linearise(astray.raw))
    reached = multistart.select_best(toy.problem(), [astray, *ends])
    assert (reached.agreeing, reached.simulated) == (2, 3)
    assert float((reached.raw - ends[0].raw).abs().max()) < 1e-2


def test_several_starts_are_reported(model, brief):
    fit = identify(model, brief, ["youngs_modulus"], starts=4, iterations=4, exact_bench=True)
    assert fit.fit["starts"] == 4
    assert fit.fit["starts_agreeing"] >= 3
    assert fit.parameters["membrane_stiffness"].value == pytest.approx(twins.TRUE_FABRIC.membrane, rel=0.15)


# -- priors ----------------------------------------------------------------------------------------------------------


def test_a_prior_of_ones_own(model, brief):
    unknowns = collect_unknowns(model, ["youngs_modulus", "poisson_ratio"], None)
    given = apply_priors(unknowns, {"youngs_modulus": (5e4, 1.5), "poisson_ratio": (0.3, 0.02)})
    assert given[0].value(given[0].prior_mean) == pytest.approx(5e4)
    assert given[0].prior_std == pytest.approx(0.405, abs=1e-3)  # ln 1.5
    assert given[1].slope(given[1].prior_mean) * given[1].prior_std == pytest.approx(0.02)
    assert [u.measured for u in given] == [False, True]  # 1.5 times is no measurement, a fifteenth is
    fit = identify(
        model, brief, ["poisson_ratio"], priors={"poisson_ratio": (0.3, 0.01)}, iterations=2, exact_bench=True
    )
    assert fit.parameters["poisson_ratio"].value == pytest.approx(0.3, abs=0.02)
    assert fit.parameters["poisson_ratio"].source == "prior"


def test_what_counts_as_large_does_not_depend_on_how_vague_a_prior_is(model):
    """An amplitude is judged against its typical size, and a wider prior is no knowledge."""
    of_part = collect_unknowns(model, ["air.normal"], None)
    (vague,), (narrow,) = (apply_priors(of_part, {"air.normal": (1.2, std)}) for std in (10.0, 0.5))
    assert of_part[0].typical_amplitude == vague.typical_amplitude == narrow.typical_amplitude == pytest.approx(1.2)
    assert (vague.prior_std, narrow.prior_std) == pytest.approx((10.0, 0.5))


@pytest.mark.parametrize(
    ("priors", "said"),
    [
        ({"stiffness": (1.0, 2.0)}, r"priors; got 'stiffness'; expected some of youngs_modulus"),
        ({"youngs_modulus": (5e4, 0.5)}, r"prior of youngs_modulus; got .*; expected \(value, factor > 1\)"),
        ({"youngs_modulus": (-5e4, 2.0)}, r"expected a value > 0"),
    ],
)
def test_wrong_priors_are_named(model, priors, said):
    with pytest.raises(InvalidInput, match=said):
        apply_priors(collect_unknowns(model, ["youngs_modulus"], None), priors)


@pytest.mark.parametrize("method", ["adam", "gradient-descent"])
def test_a_method_that_follows_the_distance_alone_has_one_start(model, brief, method):
    """Several are compared by Gauss-Newton's cost, with its priors."""
    with pytest.raises(InvalidInput, match=rf"starts; got 2 with method '{method}'; expected 1"):
        identify(model, brief, ["youngs_modulus"], method=method, starts=2)
