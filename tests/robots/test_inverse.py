"""Inverse kinematics, always judged by the forward map."""

import pytest
import torch

from torchcloth import robots
from torchcloth.errors import InvalidInput
from torchcloth.robots import inverse


@pytest.fixture
def arm():
    return robots.load("rizon4", frame="tcp_closed")


def assert_reached(arm, q, poses):
    assert (arm(q) - poses)[..., :3, 3].norm(dim=-1).max() < 1e-4
    assert (arm(q) - poses)[..., :3, :3].abs().max() < 1e-4
    assert (q >= arm.limits.soft_lower).all()
    assert (q <= arm.limits.soft_upper).all()


def line(arm, count):
    """A straight pull of 0.2 m towards the base with a wave in height, from home."""
    poses = arm(arm.home).repeat(count, 1, 1)
    way = torch.linspace(0, 1, count, dtype=torch.float64)
    poses[:, 0, 3] -= 0.2 * way
    poses[:, 2, 3] += 0.1 * torch.sin(6 * way)
    return poses


@pytest.mark.parametrize("model", robots.list_models())
def test_round_trip(model, random_q):
    arm = robots.load(model)
    poses = arm(random_q(arm, 30, seed=1))
    for pose in poses:
        assert_reached(arm, arm.inverse(pose), pose)


def test_half_a_turn_away(arm):
    pose = arm(arm.home)
    pose[:3, :3] = pose[:3, :3] @ torch.diag(torch.tensor([-1.0, -1, 1], dtype=torch.float64))
    assert_reached(arm, arm.inverse(pose), pose)


def test_path_is_continuous(arm):
    poses = line(arm, 100)
    q = arm.inverse(poses)
    assert_reached(arm, q, poses)
    assert q.diff(dim=0).abs().max() < 0.05  # 3 mm a step: no jump to another branch


def test_posture_depends_on_the_path_not_on_its_sampling(arm):
    fine, coarse = arm.inverse(line(arm, 191)), arm.inverse(line(arm, 20))
    assert (fine[::10] - coarse).abs().max() < 0.01


def test_spare_freedom_goes_to_the_reference(arm):
    poses = line(arm, 50)
    elbow = arm.home.clone()
    elbow[2] = 1.0
    without, pulled = arm.inverse(poses), arm.inverse(poses, reference=elbow)
    assert_reached(arm, pulled, poses)
    assert (pulled[-1] - elbow)[2].abs() < (without[-1] - elbow)[2].abs() - 0.02


def test_starts_from_q0_and_repeats_itself(arm, random_q):
    q0 = random_q(arm, 1, seed=3)[0]
    torch.testing.assert_close(arm.inverse(arm(q0), q0), q0)
    pose = arm(random_q(arm, 1, seed=4)[0])
    assert torch.equal(arm.inverse(pose), arm.inverse(pose))


def test_single_precision():
    arm = robots.load("rizon4", dtype=torch.float32)
    poses = line(arm, 20)
    assert_reached(arm, arm.inverse(poses), poses)


def test_own_robot_with_a_prismatic_joint(crane, random_q):
    arm = robots.load(crane, frame="hook")
    for q in random_q(arm, 5):
        assert_reached(arm, arm.inverse(arm(q)), arm(q))


def test_names_the_first_pose_out_of_reach(arm):
    poses = line(arm, 10)
    poses[6:, 0, 3] += 5.0
    with pytest.raises(InvalidInput, match=r"pose 6 cannot be reached by 'rizon4' .* m and .* rad left"):
        arm.inverse(poses, iterations=20)


def test_names_the_joint_at_its_limit(crane):
    arm = robots.load(crane, frame="hook")
    beyond = arm(torch.tensor([0.0, 1.8, 0.0], dtype=torch.float64))
    with pytest.raises(InvalidInput, match=r"pose 0 .*at its soft limit: travel"):
        arm.inverse(beyond)


def test_refuses_what_is_no_pose(arm):
    pose = arm(arm.home)
    for bad, match in [
        (pose[:3], "pose has the wrong shape"),
        (pose[None][:0], "pose has the wrong shape"),
        (2 * pose, "pose is not a rigid pose"),
        (pose * float("nan"), "pose is not a rigid pose"),
    ]:
        with pytest.raises(InvalidInput, match=match):
            arm.inverse(bad)
    with pytest.raises(InvalidInput, match="q0 has the wrong shape"):
        arm.inverse(pose, arm.home[None])
    with pytest.raises(InvalidInput, match="tolerance; got nan"):
        arm.inverse(pose, tolerance=float("nan"))
    with pytest.raises(InvalidInput, match="reference has the wrong shape"):
        arm.inverse(pose, reference=arm.home[:6])


def test_paths_side_by_side_know_nothing_of_each_other(arm, random_q):
    elsewhere = line(arm, 10)
    elsewhere[:, 1, 3] += 0.1
    beyond = line(arm, 10)
    beyond[6:, 0, 3] += 5.0
    hard = arm(random_q(arm, 1, seed=7)).expand(10, -1, -1)  # far from home
    paths = torch.stack([line(arm, 10), beyond, elsewhere, hard])
    home = arm.home.expand(4, -1)
    one, missing, other, far = inverse.solve_inverse_kinematics(arm, paths, home, home, 1e-6, 100)
    assert isinstance(missing, inverse.UnreachablePose)
    assert missing.pose_index == 6
    for result, poses in ((one, paths[0]), (other, elsewhere), (far, hard)):
        assert_reached(arm, result, poses)
        torch.testing.assert_close(result, arm.inverse(poses, tolerance=1e-6), rtol=0, atol=1e-6)
