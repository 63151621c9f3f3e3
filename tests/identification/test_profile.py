"""Profiles: invariant to how a parameter is written down, open where the data leave it open, exact after a stop."""

import json
import math
from types import SimpleNamespace

import pytest
import torch
from helpers import least_squares
from helpers.least_squares import solve

from torchcloth.errors import InvalidInput
from torchcloth.identification import identify
from torchcloth.identification.estimators import levenberg_marquardt
from torchcloth.identification.fit_warnings import warn_of_skew
from torchcloth.identification.uncertainty.estimates import Estimate, EstimateSet
from torchcloth.identification.uncertainty.profile_likelihood import compute_profiles

BEND = 1.0


def toy(model=lambda raw: raw, loud=5.0):
    """The linear problem seen through ``model``, with so much noise that an error bar reaches far."""
    generator = torch.Generator().manual_seed(3)
    jacobian = least_squares.draw_jacobian(generator)
    data = jacobian @ least_squares.TRUE_UNKNOWNS + loud * least_squares.draw_noise(generator, 0.0)
    return least_squares.ToyProblem(lambda raw: jacobian @ model(raw), data, *least_squares.row_layout(), prior_std=1e4)


def profiled(given, clip=lambda raw: raw, names="abc"):
    """(optimum, its covariance by the cost's own curvature, profiles by name)."""
    final = solve(given, start=least_squares.TRUE_UNKNOWNS.clone())
    covariance = torch.linalg.inv(levenberg_marquardt.robust_curvature(given.problem(), final))
    unknowns = [SimpleNamespace(name=n, clip=clip, value=lambda raw: raw) for n in "abc"]
    objective = SimpleNamespace(problem=given.problem, unknowns=unknowns)
    return final, covariance, compute_profiles(objective, final, covariance, names, lambda _: False)


def test_profiles_of_a_linear_problem_are_the_quadratic_intervals():
    """Up to residuals that cross the Huber bound on the way."""
    _, covariance, result = profiled(toy())
    for k, name in enumerate("abc"):
        low, high = result[name].ci95
        half = 1.96 * float(covariance[k, k].sqrt())
        assert (high - low) / 2 == pytest.approx(half, rel=0.05)
        assert result[name].skew == pytest.approx(1.0, abs=0.05)
        assert result[name].cost_rise[len(result[name].cost_rise) // 2] == 0.0


def test_profiles_do_not_depend_on_how_a_parameter_is_written():
    """The same problem in y and in log(1 + BEND y) / BEND: the ends are images of each other, so one is skew."""
    _, _, plain = profiled(toy())
    final, covariance, bent = profiled(toy(lambda raw: torch.expm1(BEND * raw) / BEND))
    for k, name in enumerate("abc"):
        wanted = [math.log1p(BEND * end) / BEND for end in plain[name].ci95]
        assert bent[name].ci95 == pytest.approx(wanted, abs=0.04 * (wanted[1] - wanted[0]))
        quadratic = float(final.raw[k] - 1.96 * covariance[k, k].sqrt())
        assert abs(bent[name].ci95[0] - wanted[0]) < 0.3 * abs(quadratic - wanted[0])
        assert bent[name].skew < 0.93


def test_an_interval_is_open_where_the_cost_does_not_rise():
    """One unknown saturates: from some value on, more of it changes nothing."""
    saturating = lambda raw: torch.cat([1 - torch.exp(-raw[:1]), raw[1:]])  # noqa: E731
    given = toy(saturating, loud=30.0)
    _, _, result = profiled(given)
    low, high = result["a"].ci95
    assert high is None
    assert low is not None
    assert result["a"].skew is None
    assert max(result["a"].cost_rise[-2:]) < 1.92
    assert None not in result["b"].ci95


def test_an_interval_ends_where_the_domain_does():
    """A legal range that begins within a standard error of the optimum."""
    final, covariance, _ = profiled(toy(), names="")
    bound = float(final.raw[0] - 0.7 * covariance[0, 0].sqrt())
    _, _, result = profiled(toy(), clip=lambda raw: max(raw, bound), names="a")
    assert result["a"].ci95[0] == bound
    assert result["a"].ci95[1] is not None
    assert result["a"].cost_rise[0] == pytest.approx(0.5 * 0.7**2, rel=0.1)


def test_a_profile_replaces_the_interval_and_can_be_resumed(model, brief, tmp_path):
    """Stopped within the profile: what follows is bit by bit what would have been."""
    options = {"iterations": 4, "guess": {"youngs_modulus": 5e4}, "exact_bench": True, "profile": ["youngs_modulus"]}
    calls = []
    whole = identify(model, brief, ["youngs_modulus"], on_progress=lambda *call: calls.append(call), **options)
    profile = whole.profiles["youngs_modulus"]
    assert whole.parameters["youngs_modulus"].ci95 == profile.ci95
    assert whole.parameters["membrane_stiffness"].ci95 == pytest.approx([1e-3 * end for end in profile.ci95])
    assert profile.skew == pytest.approx(1.0, abs=0.3)
    content = json.loads(whole.save(tmp_path / "result").read_text())
    assert content["profiles"]["youngs_modulus"]["values"] == profile.values
    assert len(calls) > len(whole.history) + 4  # progress goes on, the history does not

    class Stop(Exception):
        pass

    def stop(*_):
        seen.append(1)
        if len(seen) == len(whole.history) + 3:
            raise Stop

    seen = []
    with pytest.raises(Stop):
        identify(model, brief, ["youngs_modulus"], journal=tmp_path / "j", on_progress=stop, **options)
    resumed = identify(model, brief, ["youngs_modulus"], journal=tmp_path / "j", resume=True, **options)
    assert resumed.profiles == whole.profiles
    assert resumed.history == whole.history


def test_a_profile_of_what_is_not_fitted_is_refused(model, brief):
    with pytest.raises(InvalidInput, match=r"profile; got 'air.normal'; expected some of youngs_modulus"):
        identify(model, brief, ["youngs_modulus"], profile=["air.normal"])


def test_a_profile_is_offered_where_slopes_change():
    known = Estimate(2.0, 0.1, (1.8, 2.2), "-", 1.0, True)
    missing = Estimate(2.0, 1.9, (0.1, 9.0), "-", 1.0, False)
    result = EstimateSet({"a": known, "b": missing}, {})
    assert warn_of_skew(result, ["b"]) == []
    assert warn_of_skew(result, ["a", "b"])[0].endswith("profile (--profile a) shows it")
