"""The pose network on MuJoCo's garments."""

import json

import pytest

pytest.importorskip("mujoco")
pytest.importorskip("lightning")

from torchcloth.training.pose.scenes import NOVEL_GARMENTS, build_scene
from torchcloth.training.studies import pose_garments
from torchcloth.training.studies.command import main


def test_scenes_are_garments_that_hang_and_dresses_are_among_them():
    scenes = [build_scene(seed, pose_garments.SPLIT) for seed in pose_garments.hanging_garments(8)]
    assert all(scene.shape.kind != "sheet" and not scene.has_table for scene in scenes)
    assert {scene.shape.kind for scene in scenes} >= set(NOVEL_GARMENTS)


def test_no_scene_is_refused(tmp_path, capsys):
    assert main(["pose_garments", "--out", str(tmp_path), "--scenes", "0"]) == 2
    assert "--scenes" in capsys.readouterr().err


@pytest.mark.slow
def test_the_network_sees_a_garment_that_mujoco_moves(tmp_path, capsys):
    assert main(["pose_garments", "--out", str(tmp_path), "--fast"]) == 0
    assert "The network on MuJoCo's garments" in capsys.readouterr().out
    (case,) = (v for v in json.loads((tmp_path / "pose_garments.json").read_text()).values() if isinstance(v, dict))
    assert len(case["rms"]) >= 10
    assert max(case["rms"]) < 0.05
    assert case["coverage"] > 0.8
