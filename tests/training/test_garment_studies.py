"""Garments, chamfer and factors: the scenes, the measures, and that all three read the same cases."""

import json
import math

import numpy as np
import pytest
import torch

from torchcloth.training.studies import command
from torchcloth.training.studies.manipulations import cases, joint, paper_tables, study_cases
from torchcloth.training.studies.manipulations.measures import pooled_variance, sample_spread
from torchcloth.training.studies.manipulations.scenes import (
    ACTIONS,
    GRIPS,
    POSTURES,
    SPEEDS,
    STUDY_GARMENTS,
    Discretisation,
    Fabric,
    Scene,
    manipulations,
)

SMALL = cases.Setup(triangles=90, gap=0.09, rate=6.0, points=60, iterations=1)

# Why: training/studies/manipulations/scenes.py.
pytestmark = pytest.mark.filterwarnings("ignore:contact. 100 % of the triangles")


# -- scenes ----------------------------------------------------------------------------------------------------------


def test_factors_are_balanced_over_actions_and_each_other():
    nine = manipulations("dress", 9)
    for factor, levels in (("speed", SPEEDS), ("grip", GRIPS), ("posture", POSTURES)):
        pairs = {(m.action, getattr(m, factor)) for m in nine}
        assert len(pairs) == len(ACTIONS) * len(levels)
    assert len({(m.grip, m.posture) for m in nine}) == 9


@pytest.mark.parametrize("garment", STUDY_GARMENTS)
@pytest.mark.parametrize("number", range(3))
def test_scenes_start_at_their_grips_above_the_table_whatever_the_mesh(garment, number):
    manipulation = manipulations(garment)[number]
    coarse, fine = (Scene(manipulation, Discretisation(n, 0.06)) for n in (130, 300))
    for scene in (coarse, fine):
        assert scene.mesh.vertices[:, 2].min() > 0
        for name, vertices in scene.gripped_vertices.items():
            hand = scene.action.motion[name].pose[0, :3, 3].numpy()
            assert np.linalg.norm(scene.mesh.vertices[vertices].mean(0) - hand) < 0.05
    for name, path in coarse.action.motion.items():
        np.testing.assert_allclose(path.pose, fine.action.motion[name].pose, atol=0.02)


def test_the_truth_is_the_papers_and_the_start_is_wrong():
    for garment in STUDY_GARMENTS:
        true, start = Fabric.true(garment), Fabric.true(garment).start()
        assert true.youngs_modulus == pytest.approx(1e3 * paper_tables.PARAMETERS["youngs_modulus"][garment][0])
        assert true.poisson_ratio == pytest.approx(paper_tables.PARAMETERS["poisson_ratio"][garment][0])
        ratios = np.array(list(start.named().values())) / np.array(list(true.named().values()))
        assert (np.abs(np.log(ratios)) > 0.2).all()


# -- measures --------------------------------------------------------------------------------------------------------


def test_coefficient_of_variation_is_the_samples():
    over = sample_spread([1.0, 2.0, 3.0])
    assert (over.mean, over.count) == (2.0, 3)
    assert over.cov == pytest.approx(0.5)
    assert math.isnan(sample_spread([1.0]).cov)
    assert math.isnan(sample_spread([]).mean)


def test_the_papers_pooled_variance_is_that_of_all_values():
    rng = np.random.default_rng(0)
    values = rng.normal(size=12)
    first = pooled_variance({"a": values[:4], "b": values[4:7], "c": values[7:], "none": []})
    other = pooled_variance({"a": values[::2], "b": values[1::2]})
    assert first.pooled_variance == pytest.approx(values.var())
    assert other.pooled_variance == pytest.approx(values.var())
    assert first.mean == pytest.approx(values.mean())
    assert set(first.levels) == {"a", "b", "c"}
    assert pooled_variance({"a": [1.0, 1.0], "b": [3.0, 3.0]}).between == pytest.approx(1.0)
    assert math.isnan(pooled_variance({"a": []}).pooled_variance)


# -- cases -----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def solved():
    """A dragged dress."""
    torch.set_default_dtype(torch.float64)
    return cases.solve_case(SMALL, manipulations("dress")[2])


@pytest.mark.slow
def test_a_case_holds_estimates_and_distances(solved):
    assert solved["truth"]["youngs_modulus"] == pytest.approx(129320)
    assert set(solved["estimates"]) == {*cases.PAPER_PARAMETERS, *cases.EXTRA_PARAMETERS}
    assert 0.05 < solved["hidden"] < 0.7
    distance = solved["distance"]
    assert distance["fit"]["surface"] < 0.2 * distance["null"]["surface"], (
        "a simulation follows the cloth, a rigid one does not"
    )
    for state in distance.values():
        assert state["surface"] < state["vertices"]
    # nothing is folded yet: what contact seems to move is the ripples of simulations spread around the solution
    assert solved["moves_mm"]["youngs_modulus"] > 2 * solved["moves_mm"]["contact_stiffness"]
    assert not solved["estimates"]["contact_stiffness"]["identifiable"]
    json.dumps(solved, allow_nan=False)


def test_only_early_frames_are_fitted():
    model, data = cases.simulate_observation(SMALL, manipulations("dress")[2])
    early = data.until(0.5)
    points, all_points = early.recording.require("points"), data.recording.require("points")
    assert len(points.t) == len(early.x) == round(len(all_points.t) / 2)
    assert len(points.xyz) == points.counts.sum()
    np.testing.assert_array_equal(points.xyz, all_points.xyz[: len(points.xyz)])
    assert len(model.mesh.vertices) == data.x.shape[1], "the truth is given at the fit's vertices"
    np.testing.assert_allclose(data.x[0], early.recording.cloth.initial_vertices)


# -- the commands ----------------------------------------------------------------------------------------------------


def call(name, out, *more):
    return command.main([name, "--out", str(out), "--fast", *more])


def pretended(solved, factor):
    """A solver that returns the solved case for every manipulation, its E estimated at ``factor`` times the truth."""

    def solve(setup, manipulation):
        estimates = {name: dict(e) for name, e in solved["estimates"].items()}
        e, truth = estimates["youngs_modulus"], Fabric.true(manipulation.garment).named()
        value = factor * truth["youngs_modulus"] * (1 + 0.1 * manipulation.number)
        e |= {"identifiable": True, "value": value, "ci95": [0.9 * value, 1.1 * value]}
        return solved | {"manipulation": manipulation.facts(), "truth": truth, "estimates": estimates}

    return solve


@pytest.mark.slow
def test_three_studies_share_their_cases(solved, tmp_path, monkeypatch, capsys):
    computed = []
    solve = pretended(solved, 0.95)
    monkeypatch.setattr(
        study_cases,
        "solve_case",
        lambda setup, manipulation: computed.append(manipulation.name) or solve(setup, manipulation),
    )
    assert call("garments", tmp_path, "--count", "3") == 0
    printed = capsys.readouterr().out
    assert len(computed) == 9
    assert "not identifiable" in printed
    assert "638.7" in printed, "the paper's number beside it"
    result = json.loads((tmp_path / "garments.json").read_text())["garments"]["dress"]
    assert result["youngs_modulus"]["mean"] == pytest.approx(0.95 * 1.1 * 129320)
    assert result["youngs_modulus"]["cov"] == pytest.approx(0.1 / 1.1)
    assert result["youngs_modulus"]["identified"] == 3
    assert result["youngs_modulus"]["covered"] == 2, "0.95 and 1.045 of the truth, not 1.14"
    assert result["contact_stiffness"]["mean"] is None, "no number where nothing is identified"

    assert call("chamfer", tmp_path, "--count", "3") == 0
    assert "17.14" in capsys.readouterr().out
    by = json.loads((tmp_path / "chamfer.json").read_text())["by"]
    assert by["action"]["drag"]["surface"]["fit"]["mean"] == pytest.approx(solved["distance"]["fit"]["surface"])
    assert by["garment"]["shirt"]["vertices"]["fit"]["count"] == 3

    assert call("factors", tmp_path, "--count", "3") == 0
    assert "8.74e-05" in capsys.readouterr().out
    estimates = json.loads((tmp_path / "factors.json").read_text())
    e = estimates["parameters_over_truth"]["grip"]["youngs_modulus"]
    assert e["mean"] == pytest.approx(0.95 * 1.1)
    assert e["between"] == pytest.approx(e["pooled_variance"]), (
        "with three manipulations a level of grip is one of them"
    )
    assert len(computed) == 9, "nothing was run again"
    for name in ("garments", "chamfer", "factors"):
        assert (tmp_path / f"{name}.png").stat().st_size > 10_000


@pytest.mark.slow
def test_a_failed_case_is_counted_and_no_number(solved, tmp_path, monkeypatch, capsys):
    case = {key: solved[key] for key in ("truth", "hidden")}
    monkeypatch.setattr(
        study_cases,
        "solve_case",
        lambda setup, manipulation: case | {"manipulation": manipulation.facts(), "failed": "torn"},
    )
    for name in ("garments", "chamfer", "factors"):
        assert call(name, tmp_path, "--garments", "dress") == 0
        assert "nan" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--count", "0"], "--count"),
        (["--triangles", "-3"], "--triangles"),
        (["--gap", "nan"], "--gap"),
        (["--share", "1.5"], "--share"),
        (["--report"], "no finished case"),
    ],
)
def test_refusals_write_nothing(arguments, message, tmp_path, capsys):
    for name in ("garments", "chamfer", "factors"):
        assert call(name, tmp_path / "out", *arguments) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        assert message in error
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_another_setting_needs_another_folder(solved, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(study_cases, "solve_case", pretended(solved, 1.0))
    assert call("garments", tmp_path, "--garments", "dress") == 0
    assert call("chamfer", tmp_path, "--garments", "dress", "--gap", "0.07") == 2
    assert "gap" in capsys.readouterr().err


@pytest.mark.slow
def test_a_joint_fit_takes_calm_cases_with_the_same_grips(solved, tmp_path, monkeypatch, capsys):
    fitted = {}

    def solve_together(setup, manipulated):
        fitted[manipulated[0].garment] = [manipulation.number for manipulation in manipulated]
        return {
            **pretended(solved, 0.9)(setup, manipulated[0]),
            "manipulations": [manipulation.facts() for manipulation in manipulated],
        }

    monkeypatch.setattr(joint, "solve_together", solve_together)
    ask = "--joint", "--count", "10", "--garments", "dress"
    assert call("garments", tmp_path, *ask, "--report") == 2
    assert "no finished case" in capsys.readouterr().err
    assert fitted == {}
    assert call("garments", tmp_path, *ask) == 0
    assert fitted == {"dress": [0, 5, 9]}, "covers and drags at the corners"
    fitted.clear()
    assert call("garments", tmp_path, *ask, "--report") == 0
    assert fitted == {}
    printed = capsys.readouterr().out
    assert "0.81 … 0.99" in printed
    assert "3 episodes" in printed


@pytest.mark.slow
def test_two_manipulations_can_be_fitted_at_once():
    joint_fit = cases.solve_together(SMALL, [manipulations("dress")[i] for i in (2, 6)])  # both held lower
    assert set(joint_fit["estimates"]) == {*cases.PAPER_PARAMETERS, *cases.EXTRA_PARAMETERS}
    assert len(joint_fit["manipulations"]) == 2
    json.dumps(joint_fit, allow_nan=False)


@pytest.mark.slow
def test_the_fast_studies(tmp_path, capsys):
    """One manipulation of every garment, each by another action, about a minute."""
    for name in ("garments", "chamfer", "factors"):
        assert call(name, tmp_path) == 0
    by = json.loads((tmp_path / "chamfer.json").read_text())["by"]["action"]
    for action in ACTIONS:
        distances = by[action]["surface"]
        assert distances["fit"]["mean"] < distances["null"]["mean"], action
