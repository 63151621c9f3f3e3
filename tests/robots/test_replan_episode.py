"""Joint motions for the paths of an episode, judged by the arms' own kinematics."""

from dataclasses import replace
from importlib.resources import files

import numpy as np
import pytest
import torch

from torchcloth import recordings, robots
from torchcloth.diagnosis.experiment.motions import rotation_about_z
from torchcloth.errors import InvalidInput
from torchcloth.robots import primitives
from torchcloth.robots.replan_episode import scene_from_episode

DOWN = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))


@pytest.fixture(scope="module")
def swing():
    """Paths of a primitive with tools that point down and turn on the way, in an episode that names the arms."""
    action = primitives.swing({"left": (0.5, 0.2, 0.6), "right": (0.5, -0.2, 0.6)})
    tools = {name: path._replace(pose=path.pose.clone()) for name, path in action.motion.items()}
    for path in tools.values():
        angle = 3.0 * (path.pose[:, :2, 3] - path.pose[0, :2, 3]).sum(-1)
        path.pose[:, :3, :3] = torch.as_tensor(rotation_about_z(angle.numpy())) @ DOWN
    shipped = recordings.read(files("torchcloth") / "examples" / "bimanual_swing")
    grippers = {name: robots.to_gripper_motion(path) for name, path in tools.items()}
    return replace(shipped, grippers=grippers, joints={}, robots=robots.bimanual_rig().robot_infos())


def moved(recording, shift=(0.0, 0.0, 0.0), faster=1.0):
    grippers = {
        name: replace(g, t=g.t / faster, position=g.position + np.asarray(shift))
        for name, g in recording.grippers.items()
    }
    return replace(recording, grippers=grippers)


def test_joints_lead_through_the_recorded_path_and_turn_as_it_does(swing):
    scene, plan = scene_from_episode(swing), robots.joint_motion_for_episode(swing)
    done = plan.motion(scene)
    for name, path in robots.replay(swing).items():
        t = path.t * plan.slowdown
        at = np.stack([np.interp(t, done[name].t, done[name].pose[:, k, 3]) for k in range(3)], 1)
        np.testing.assert_allclose(at, path.pose[:, :3, 3], atol=3e-4)
        k = int(path.pose[:, 0, 3].sub(path.pose[0, 0, 3]).abs().argmax())
        same = int((done[name].t - t[k]).abs().argmin())
        turned, asked = (p[i, :3, :3] @ p[0, :3, :3].mT for p, i in ((done[name].pose, same), (path.pose, k)))
        torch.testing.assert_close(turned, asked, atol=1e-4, rtol=0)
        assert (asked - torch.eye(3)).abs().max() > 0.1
        assert done[name].closed.all()
    again = robots.replay(replace(swing, grippers={}, joints=plan.joint_motions(), robots=scene.robot_infos()))
    torch.testing.assert_close(again["left"].pose, done["left"].pose)


@pytest.mark.slow
def test_what_is_too_fast_takes_longer_and_what_is_out_of_reach_is_refused(swing):
    usual, hurried = (robots.joint_motion_for_episode(moved(swing, faster=f)) for f in (0.2, 3.0))
    assert usual.slowdown == 1.0 < 1.2 < hurried.slowdown
    with pytest.raises(InvalidInput, match="reach"):
        robots.joint_motion_for_episode(moved(swing, shift=(1.5, 0.0, 0.0)))


def test_a_level_plane_is_a_table_under_cloth_and_paths(swing):
    lowest = min(g.position[:, 2].min() for g in swing.grippers.values())
    plane = recordings.Collider(np.array([0.0, 0.0, lowest + 0.1]), np.array([0.0, 0.0, 1.0]))
    with pytest.raises(InvalidInput, match="table"):
        robots.joint_motion_for_episode(replace(swing, colliders={"table": plane}))
    wall = recordings.Collider(np.array([-3.0, 0.0, 0.0]), np.array([1.0, 0.0, 0.0]))
    assert scene_from_episode(replace(swing, colliders={"wall": wall})).table is None


def test_a_table_is_as_high_as_its_plane_is_anywhere_under_the_cloth(swing):
    tilt = np.array([0.05, 0.0, 1.0]) / np.hypot(0.05, 1.0)
    one = recordings.Collider(np.array([0.0, 0.0, 0.1]), tilt)
    same = recordings.Collider(np.array([2.0, 0.0, 0.0]), tilt)  # another point of it
    tables = [scene_from_episode(replace(swing, colliders={"t": c})).table for c in (one, same)]
    assert tables[0].height == pytest.approx(tables[1].height)
    assert tables[0].height == pytest.approx(0.1 - 0.05 * tables[0].x[0])


def test_without_an_arm_for_every_gripper_there_is_nothing_to_plan(swing):
    assert robots.joint_motion_for_episode(replace(swing, robots={})) is None
    assert robots.joint_motion_for_episode(replace(swing, robots={"left": swing.robots["left"]})) is None
    assert robots.joint_motion_for_episode(replace(swing, grippers={}, robots={})) is None
    other = robots.Scene({"left": robots.load("rizon4")})
    with pytest.raises(InvalidInput, match=r"scene; got \['right'\]"):
        robots.joint_motion_for_episode(swing, other)
    strange = {name: replace(r, model="nobody's") for name, r in swing.robots.items()}
    with pytest.raises(InvalidInput, match="nobody's"):
        robots.joint_motion_for_episode(replace(swing, robots=strange))
