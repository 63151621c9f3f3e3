"""Feasibility of an experiment for the arms, and its conversion to an episode that drives them."""

import shutil
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers import sheet_episodes
from helpers.undecided_search import make_undecided_search

from torchcloth import recordings, robots
from torchcloth.diagnosis.experiment import motions, proposal
from torchcloth.diagnosis.experiment.feasibility import (
    EXPERIMENT_FOLDER,
    PROPOSAL_PROVENANCE,
    FeasibleExperiment,
    check_feasibility,
    write_episode,
)
from torchcloth.diagnosis.experiment.motions import Experiment, make_episode
from torchcloth.recordings.templates import TEMPLATE_FILES, as_template

FAST = Experiment("swing-fast")


def quiet(_):
    pass


@pytest.fixture(scope="module")
def shipped():
    return recordings.read(files("torchcloth") / "examples" / "bimanual_swing")


@pytest.fixture(scope="module")
def slowed(shipped):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(motions, "EXPERIMENTS", (FAST,))
        (found,) = check_feasibility([shipped], quiet)
    return found


def test_an_experiment_is_as_fast_as_the_arms(shipped, slowed):
    assert slowed.plan.slowdown > 1.5
    assert slowed.experiment.speed == pytest.approx(1 / slowed.plan.slowdown)
    wanted, done = make_episode(FAST, shipped), slowed.episode
    for name, asked in wanted.grippers.items():
        t = asked.t * slowed.plan.slowdown
        at = np.stack([np.interp(t, done.grippers[name].t, done.grippers[name].position[:, k]) for k in range(3)], 1)
        np.testing.assert_allclose(at, asked.position, atol=3e-4)
    assert done.split == {"motion": str(slowed.experiment)}
    assert done.points.t[-1] == pytest.approx(wanted.points.t[-1] * slowed.plan.slowdown, abs=0.1)


def test_where_no_arm_is_named_none_is_asked(monkeypatch):
    monkeypatch.setattr(motions, "EXPERIMENTS", (FAST, Experiment("turn", 90.0)))
    found = check_feasibility([sheet_episodes.make_episode()], lambda _: pytest.fail("an arm was asked"))
    assert [c.experiment for c in found] == [FAST, Experiment("turn", 90.0)]
    assert {(c.plan, c.why_not, c.not_checked) for c in found} == {(None, None, None)}


def test_what_is_in_the_arms_way_is_said_and_not_proposed(shipped, monkeypatch):
    monkeypatch.setattr(motions, "EXPERIMENTS", (FAST,))
    far = {name: replace(r, T_world_base=r.T_world_base + np.eye(4, k=3) * 3.0) for name, r in shipped.robots.items()}
    paths = {name: robots.to_gripper_motion(path) for name, path in robots.replay(shipped).items()}
    (refused,) = check_feasibility([replace(shipped, grippers=paths, joints={}, robots=far)], quiet)
    assert "reach" in refused.why_not
    found, content, setting = make_undecided_search(("env.gravity_tilt[y]", "obs.rotation[x]"))
    turn = FeasibleExperiment(Experiment("turn", -90.0), make_episode(Experiment("turn", -90.0), setting.recordings[0]))
    hang = replace(refused, experiment=Experiment("hang"))
    monkeypatch.setattr(proposal, "check_feasibility", lambda *_: [hang, turn])
    proposed = proposal.propose_experiment(found, content, setting, quiet)
    assert (proposed.content["motion"], proposed.content["arms"]) == ("turn", None)
    assert proposed.episode is turn.episode
    plan = SimpleNamespace(slowdown=1.3, limiting_joint="joint4 of left: acceleration")
    monkeypatch.setattr(proposal, "check_feasibility", lambda *_: [hang, replace(turn, plan=plan)])
    arms = proposal.propose_experiment(found, content, setting, quiet).content["arms"]
    assert arms == {"slowdown": 1.3, "limited_by": plan.limiting_joint, "refused": {"hang": refused.why_not}}
    monkeypatch.setattr(proposal, "check_feasibility", lambda *_: [hang])
    assert proposal.propose_experiment(found, content, setting, quiet) is None


def test_the_proposed_one_is_an_episode_without_blanks(slowed, tmp_path):
    blank = np.zeros((len(slowed.episode.grippers["left"].t), 3))
    felt = {name: replace(g, force=blank, torque=blank) for name, g in slowed.episode.grippers.items()}
    assert write_episode(replace(slowed.episode, grippers=felt), tmp_path) is None
    written = recordings.read(tmp_path / EXPERIMENT_FOLDER)
    assert (written.points, written.truth, written.grippers["left"].force) == (None, None, None)
    for name, path in robots.replay(written).items():  # the joints, through the arms
        torch.testing.assert_close(path.pose[:, :3, 3], torch.as_tensor(written.grippers[name].position))
    np.testing.assert_array_equal(written.cloth.initial_vertices, slowed.episode.cloth.initial_vertices)


def test_a_proposal_replaces_the_last_one_and_nothing_that_was_recorded(slowed, tmp_path):
    hang = make_episode(Experiment("hang"), sheet_episodes.make_episode())
    assert write_episode(hang, tmp_path) is None
    assert write_episode(slowed.episode, tmp_path) is None
    assert recordings.read(tmp_path / EXPERIMENT_FOLDER).split == slowed.episode.split
    at_rest = TEMPLATE_FILES - {"robots", "cloth_velocities.npy"}
    assert set(p.name for p in (tmp_path / EXPERIMENT_FOLDER).iterdir()) == at_rest
    assert write_episode(None, tmp_path) is None
    assert not (tmp_path / EXPERIMENT_FOLDER).exists()
    push = {name: replace(g, force=np.ones((len(g.t), 3))) for name, g in slowed.episode.grippers.items()}
    felt = replace(as_template(slowed.episode, PROPOSAL_PROVENANCE), grippers=push, joints={})
    for recorded in (hang, felt, replace(felt, provenance="measured", grippers=slowed.episode.grippers)):
        recordings.write(recorded, tmp_path / EXPERIMENT_FOLDER, overwrite=True)
        before = {p.name: p.stat().st_mtime_ns for p in (tmp_path / EXPERIMENT_FOLDER).iterdir()}
        for episode in (slowed.episode, None):
            assert "left as it is" in write_episode(episode, tmp_path)
            assert {p.name: p.stat().st_mtime_ns for p in (tmp_path / EXPERIMENT_FOLDER).iterdir()} == before


@pytest.mark.parametrize("make", [lambda p: p.write_text("mine"), lambda p: p.symlink_to("elsewhere"), Path.mkdir])
def test_what_is_no_proposal_is_left_and_no_diagnosis_is_lost_for_it(slowed, tmp_path, make):
    make(tmp_path / EXPERIMENT_FOLDER)
    if (tmp_path / EXPERIMENT_FOLDER).is_dir():
        (tmp_path / EXPERIMENT_FOLDER / "notes.txt").write_text("mine")
    assert "left as it is" in write_episode(slowed.episode, tmp_path)
    nameless = replace(slowed.episode, provenance="", grippers={}, joints={}, cloth=None)
    assert "was not written" in write_episode(nameless, tmp_path / "other")
    assert not (tmp_path / "other").exists()


def test_a_urdf_beside_the_episode_is_found_from_a_proposal(shipped, tmp_path):
    (tmp_path / "e").mkdir()
    shutil.copy(robots.description.locate_urdf("rizon4"), tmp_path / "e" / "arm.urdf")
    own = {name: replace(r, model="arm.urdf") for name, r in shipped.robots.items()}
    episode = make_episode(FAST, replace(shipped, robots=own, path=tmp_path / "e"))
    assert {r.model for r in episode.robots.values()} == {str(tmp_path / "e" / "arm.urdf")}
    assert robots.arm_from_recording(episode, "left").model == str(tmp_path / "e" / "arm.urdf")


def test_arms_that_cannot_be_asked_forbid_nothing(shipped, monkeypatch):
    """Of a model that is not here, or whose solids are meshes; one without motion is not looked at."""
    monkeypatch.setattr(motions, "EXPERIMENTS", (FAST,))
    paths = {name: robots.to_gripper_motion(path) for name, path in robots.replay(shipped).items()}
    plain = replace(shipped, grippers=paths, joints={})
    strange = {name: replace(r, model="nobody's") for name, r in shipped.robots.items()}
    (found,) = check_feasibility([replace(plain, robots=strange)], quiet)
    assert "nobody's" in found.not_checked
    assert (found.plan, found.why_not) == (None, None)
    assert found.episode.joints == {}
    with monkeypatch.context() as patch:
        patch.setattr(robots.Arm, "links_without_primitives", ("link3",))
        (found,) = check_feasibility([plain], quiet)
    assert "meshes" in found.not_checked
    alone = replace(plain, grasps={"left": shipped.grasps["left"]})
    assert set(make_episode(FAST, alone).robots) == {"left"}
