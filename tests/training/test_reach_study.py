"""Plans that another engine carries out: the study's parts, and one small case."""

import json

import numpy as np
import pytest

from torchcloth.training.studies import reach
from torchcloth.training.studies.command import main
from torchcloth.training.validation.independent.motions import make_motion

TINY = reach.Scale(motions=("hang",), nodes=9, fit_nodes=7, iterations=3)


def test_the_hidden_path_begins_as_the_known_one_and_ends_elsewhere():
    scene = reach.build_scenes(TINY)
    motion = make_motion("swing", scene.true.sheet)
    hidden = reach._shift_end(motion, np.random.default_rng(0))
    for name, pose in motion.pose.items():
        assert np.allclose(hidden.pose[name][0], pose[0])
        away = np.linalg.norm(hidden.pose[name][-1, :3, 3] - pose[-1, :3, 3])
        assert 0.01 < away < 3 * reach.GOAL_SHIFT_M
    apart = [np.linalg.norm(np.subtract(*(m.pose[n][-1, :3, 3] for n in m.pose))) for m in (motion, hidden)]
    assert apart[0] == pytest.approx(apart[1])


def test_the_data_sheet_is_wrong_as_it_says():
    scene = reach.build_scenes(TINY)
    assert scene.stated.sheet.membrane_stiffness == 3 * scene.true.sheet.membrane_stiffness
    assert scene.stated.plate.stiffness == 0.4 * scene.true.plate.stiffness


@pytest.mark.slow
def test_a_plan_is_carried_out(tmp_path, monkeypatch, capsys):
    """With the data sheet alone: a fit would take minutes, and cloth that hangs hardly asks for one."""
    monkeypatch.setattr(reach, "PLAN_OPTIONS", {"data sheet": {}})
    monkeypatch.setattr(reach, "FAST_SCALE", TINY)
    monkeypatch.setattr(reach, "fit_fabric", lambda scale, folder: {})
    assert main(["reach", "--fast", "--out", str(tmp_path)]) == 0
    case = json.loads((tmp_path / "reach.json").read_text())["0-hang"]
    assert case["data sheet"]["distance"] < 0.5 * case["recorded"]["distance"]
    assert case["data sheet"]["vertices"] < 0.5 * case["recorded"]["vertices"]
    assert "the hidden path itself" in capsys.readouterr().out
