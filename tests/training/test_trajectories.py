"""Garments that descent and a learner bring to a goal: the study's parts, and all of it, small."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from torchcloth.planning.objective import build_objective
from torchcloth.training.studies import trajectories
from torchcloth.training.studies.command import main
from torchcloth.training.studies.trajectories import FAST_SCALE, build_scene, make_hidden_goal, sample_surface
from torchcloth.training.studies.trajectory_execution import garment_spec
from torchcloth.training.studies.trajectory_scenes import check_limits, measure_chaos
from torchcloth.training.studies.trajectory_searches import search_by_cmaes, search_by_gauss_newton
from torchcloth.training.studies.trajectory_tables import build_summary_table, count_first_wins, retained_fraction
from torchcloth.training.validation.independent.garment import MujocoGarment


def test_points_lie_evenly_on_the_surface():
    x = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [3, 0, 0], [3, 3, 0]])
    points = sample_surface(x, torch.tensor([[0, 1, 2], [1, 3, 4]]), 4000, np.random.default_rng(0))
    assert float(points[:, 2].abs().max()) == 0.0
    small = ((points[:, 0] + points[:, 1]) < 1).double().mean()
    assert float(small) == pytest.approx(0.5 / 3.5, abs=0.02)


def test_the_goal_is_elsewhere_and_can_be_reached():
    scene = build_scene("dress", "drag", FAST_SCALE.fine, FAST_SCALE.waypoints)
    goal = make_hidden_goal(scene, np.random.default_rng(0))
    with torch.no_grad():
        x = scene.run.simulate({c.name: c.trajectory(c.zero_waypoints) for c in scene.courses})[-1]
    assert float(build_objective(goal, scene.cloth.mesh).distance(x)) > 3e-3
    assert goal.points.shape == (trajectories.GOAL_POINTS, 3)


@pytest.mark.long
def test_a_carried_garment_is_brought_to_the_goal_within_all_limits():
    scene = build_scene("dress", "carry", FAST_SCALE.coarse, FAST_SCALE.waypoints)
    goal = make_hidden_goal(scene, np.random.default_rng(0))
    descent = search_by_gauss_newton([scene], goal, 1)
    by_chance = search_by_cmaes(scene, goal, descent.history[-1].seconds, seed=0)
    assert descent.history[-1].motions == 2 + len(descent.best)
    assert descent.expected < 0.5 * descent.history[0].distance
    assert by_chance.expected < descent.history[0].distance
    for outcome in (descent, by_chance):
        assert check_limits(outcome.task, outcome.best)[0] == 0
    assert check_limits(descent.task, 20 * descent.best)[0] > 0
    assert measure_chaos(scene, scene.recorded_motion, np.random.default_rng(0), 1) < 5e-3


def test_the_summary_counts_garments_and_seeds():
    results = {
        f"dress-carry-{seed}-{method}": {
            "garment": "dress",
            "action": "carry",
            "seed": seed,
            "method": method,
            "recorded": 0.1,
            "recorded_expected": 0.1,
            "expected": expected,
            "executed": 0.02,
            "mujoco_executed": None,
            "motions": 10,
            "seconds": 1.0,
            "limit_violations": 0,
        }
        for seed, method, expected in [(0, "gauss-newton", 0.01), (0, "sac", 0.03), (1, "gauss-newton", 0.02)]
    }
    results["dress-carry-1-sac"] = results["dress-carry-0-sac"] | {"seed": 1, "expected": 0.015}
    assert count_first_wins(results, "sac", "carry") == (1, 2)
    assert retained_fraction(results["dress-carry-0-gauss-newton"]) == pytest.approx(0.08 / 0.09)
    assert build_summary_table(results).row_count == 4


def test_a_garment_hangs_in_mujoco_as_here():
    pytest.importorskip("mujoco")
    scene = build_scene("dress", "carry", FAST_SCALE.coarse, FAST_SCALE.waypoints)
    spec = replace(garment_spec("dress", scene), gravity=0.0, drag_normal=0.0)
    still = MujocoGarment(spec).run(spec.rest, np.array([0.0, 0.01]), {})
    assert np.abs(still.x[-1] - spec.rest).max() < 1e-4
    assert spec.masses.sum() == pytest.approx(spec.areal_density * spec.areas.sum())


@pytest.mark.slow
def test_all_methods_on_one_garment(tmp_path, capsys):
    assert main(["trajectories", "--fast", "--garments", "dress", "--out", str(tmp_path)]) == 0
    results = json.loads((tmp_path / "trajectories.json").read_text())
    assert results.pop("schema") == "torchcloth.study.trajectories/1"
    assert set(results) == {"chaos-dress-carry", *(f"dress-carry-0-{m}" for m in trajectories.METHOD_NAMES)}
    first = results["dress-carry-0-gauss-newton"]
    for method in trajectories.METHOD_NAMES:
        case = results[f"dress-carry-0-{method}"]
        assert case["recorded"] == first["recorded"]
        assert case["limit_violations"] == 0
    assert first["executed"] < 0.3 * first["recorded"]
    assert first["mujoco_executed"] < 0.3 * first["mujoco_recorded"]
    assert len(results["dress-carry-0-sac"]["history"]) == FAST_SCALE.sac + 1
    assert (tmp_path / "trajectories.png").stat().st_size > 10_000
    assert "half way after" in capsys.readouterr().out


def test_a_number_of_motions_that_is_none_is_refused(tmp_path, capsys):
    assert main(["trajectories", "--sac", "0", "--out", str(tmp_path / "out")]) == 2
    assert "--sac" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
