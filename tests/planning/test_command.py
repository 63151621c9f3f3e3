"""``torchcloth plan``: files, table, refusals."""

import json
import shutil

import numpy as np
import pytest
import torch
from helpers.planning_scenes import build_nominal_cloth, make_arm_episode, make_hand_episode
from helpers.schema_checks import check_written

from torchcloth import recordings as rec
from torchcloth.cli import main
from torchcloth.diagnosis import build_base_model, save_model
from torchcloth.diagnosis.causes.hypotheses import list_known_hypotheses
from torchcloth.identification import build_episode
from torchcloth.planning.result import PLANNED_PROVENANCE

OPTIONS = ["--iterations", "3", "--wait", "0.1", "--waypoints", "2"]


@pytest.fixture
def folder(tmp_path):
    return rec.write(make_arm_episode(), tmp_path / "episode")


def goal_in(place):
    """The cloth as it hangs at first, 3 cm in front."""
    x = build_episode(build_nominal_cloth(make_arm_episode()), make_arm_episode(), 20.0).initial.numpy()
    np.save(place / "goal.npy", x + np.array([0.03, 0.0, 0.0]))
    return place / "goal.npy"


@pytest.fixture
def goal(tmp_path):
    return goal_in(tmp_path)


@pytest.fixture(scope="module")
def planned(tmp_path_factory):
    """What the command has written, for who begins with it; not to be changed."""
    place = tmp_path_factory.mktemp("planned")
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    try:
        episode_of = rec.write(make_arm_episode(), place / "episode")
        arguments = ["--goal", str(goal_in(place)), "--out", str(place / "out"), *OPTIONS]
        assert main(["plan", str(episode_of), *arguments]) == 0
    finally:
        torch.set_default_dtype(before)
    return place / "out"


def test_writes_what_was_planned(folder, goal, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["plan", str(folder), "--goal", str(goal), "--out", str(out), *OPTIONS]) == 0
    words = json.loads((out / "plan.json").read_text())
    check_written(words, "plan")
    assert words["distance"]["after"][0] < 0.3 * words["distance"]["before"][0]
    assert words["nearest_limit"]["limit"].endswith("of arm")
    assert words["warnings"] == []
    planned = rec.read(out / "episode")
    assert planned.provenance == PLANNED_PROVENANCE
    assert planned.joints["arm"].q.shape[1] == 7
    assert (out / "plan.png").stat().st_size > 10_000
    assert sorted(file.name for file in out.iterdir()) == ["episode", "plan.json", "plan.png"]
    message = capsys.readouterr().out
    assert "recorded motion" in message
    assert "nearest solids" in message
    assert "motion 2:" in message
    assert main(["plan", str(folder), "--goal", str(goal), "--out", str(out), *OPTIONS]) == 0  # over an earlier plan
    assert "replaced" in capsys.readouterr().out


def test_plans_with_the_model_of_a_diagnosis(folder, goal, planned, tmp_path, capsys):
    """Air that brakes, and a camera that believes itself 3 cm farther along x: the goal is where it sees the cloth."""
    recording = rec.read(folder)
    named = {h.name: h for h in list_known_hypotheses()}
    model = (
        build_base_model(recording)
        .with_hypothesis(named["air.drag_n"], 1.2)
        .with_hypothesis(named["obs.extrinsic[x]"], 0.03)
    )
    covariance = 0.01 * torch.diag(model.point.new_tensor([1.0] * (len(model.point) - 1) + [1e-6]))
    save_model(tmp_path / "model.tcm", model, recording, covariance)
    arguments = [
        "--goal",
        str(goal),
        "--fit",
        str(tmp_path / "model.tcm"),
        "--samples",
        "3",
        "--out",
        str(tmp_path / "o"),
    ]
    assert main(["plan", str(folder), *arguments, *OPTIONS]) == 0
    words = json.loads((tmp_path / "o" / "plan.json").read_text())
    assert len(set(words["distance"]["after"])) == 3
    assert "mean of the models" in capsys.readouterr().out
    assert max(words["distance"]["before"]) < 5e-3  # that camera sees the cloth there already
    assert json.loads((planned / "plan.json").read_text())["distance"]["before"][0] > 0.02


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--goal", "nowhere.npy"], "goal"),
        (["--fit", "nowhere"], "nowhere"),
        (["--samples", "0"], "--samples"),
        (["--samples", "4"], "--samples"),
        (["--waypoints", "0"], "waypoints"),
        (["--wait", "-1"], "wait"),
        (["--resume"], "resume"),
    ],
    ids=lambda value: value[0] if isinstance(value, list) else "",
)
def test_wrong_input_is_one_line_and_leaves_nothing(folder, goal, tmp_path, capsys, more, message):
    out = tmp_path / "out"
    assert main(["plan", str(folder), "--goal", str(goal), "--out", str(out), *OPTIONS, *more]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line
    assert not out.exists()


def test_what_was_recorded_where_the_plan_would_go_stays(folder, goal, tmp_path, capsys):
    custom = rec.write(make_hand_episode(), tmp_path / "out" / "episode")
    assert main(["plan", str(folder), "--goal", str(goal), "--out", str(custom.parent), *OPTIONS]) == 2
    assert "no earlier plan" in capsys.readouterr().err
    assert rec.read(custom).provenance == make_hand_episode().provenance


def test_what_was_filmed_where_the_plan_would_go_stays(folder, goal, planned, tmp_path, capsys):
    out = shutil.copytree(planned, tmp_path / "out")
    (out / "episode" / "cam0").mkdir()
    assert main(["plan", str(folder), "--goal", str(goal), "--out", str(out), *OPTIONS]) == 2
    assert "holds more than one" in capsys.readouterr().err
    assert (out / "episode" / "cam0").is_dir()


def test_nothing_is_written_into_the_episode(folder, goal, planned, tmp_path, capsys):
    out = shutil.copytree(planned, tmp_path / "out")
    before = (out / "episode" / "motion.npz").read_bytes()
    assert main(["plan", str(out / "episode"), "--goal", str(goal), "--out", str(out), *OPTIONS]) == 2  # its own plan
    assert (out / "episode" / "motion.npz").read_bytes() == before
    assert main(["plan", str(folder), "--goal", str(goal), "--out", str(folder / "plan"), *OPTIONS]) == 2
    assert "outside" in capsys.readouterr().err
