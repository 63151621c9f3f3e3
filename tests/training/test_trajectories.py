"""Garments that descent and a learner bring to a goal: the study's parts, and all of it, small."""

import json

import numpy as np
import pytest
import torch

from torchcloth.planning.objective import build_objective
from torchcloth.training.studies import trajectories
from torchcloth.training.studies.command import main
from torchcloth.training.studies.trajectories import FAST_SCALE, build_scene, make_hidden_goal, sample_surface


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


@pytest.mark.slow
def test_all_methods_on_one_garment(tmp_path, capsys):
    assert main(["trajectories", "--fast", "--garments", "dress", "--out", str(tmp_path)]) == 0
    results = json.loads((tmp_path / "trajectories.json").read_text())
    assert results.pop("schema") == "torchcloth.study.trajectories/1"
    assert set(results) == {f"dress-{method}" for method in trajectories.METHOD_NAMES}
    for case in results.values():
        assert case["expected"] == min(d for d in case["history"] if d is not None)
        assert case["recorded"] == results["dress-sac"]["recorded"]
    assert results["dress-gauss-newton"]["executed"] < results["dress-gauss-newton"]["recorded"]
    assert len(results["dress-sac"]["history"]) == FAST_SCALE.sac + 1
    assert (tmp_path / "trajectories.png").stat().st_size > 10_000
    assert "half way after" in capsys.readouterr().out


def test_a_number_of_motions_that_is_none_is_refused(tmp_path, capsys):
    assert main(["trajectories", "--sac", "0", "--out", str(tmp_path / "out")]) == 2
    assert "--sac" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
