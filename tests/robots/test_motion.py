"""Joint waypoints to pose trajectories."""

import copy
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import torchcloth.robots as robots
from torchcloth import recordings as rec
from torchcloth.errors import InvalidInput, RecordingError
from torchcloth.robots.replay import unwrap_joints
from torchcloth.types import Trajectory


@pytest.fixture
def arm():
    return robots.load("rizon4", frame="tcp_closed")


@pytest.fixture
def waypoints(arm):
    turn = torch.tensor([0.3, 0.2, -0.1, 0.2, 0.1, -0.2, 0.3], dtype=torch.float64)
    return torch.stack([arm.home, arm.home + turn, arm.home - turn, arm.home])


TIMES = torch.tensor([0.0, 0.5, 1.5, 2.0], dtype=torch.float64)


def test_passes_the_waypoints_on_time(arm, waypoints):
    motion = arm.motion(waypoints, TIMES, period=0.03)
    assert isinstance(motion, Trajectory)
    assert motion.pose.shape == (len(motion.t), 4, 4)
    assert (motion.t[0], motion.t[-1]) == (0.0, 2.0)
    assert 0 < motion.t.diff().min() <= motion.t.diff().max() <= 0.03 + 1e-12
    at = torch.searchsorted(motion.t, TIMES - 1e-9)
    torch.testing.assert_close(motion.t[at], TIMES)
    torch.testing.assert_close(motion.pose[at], arm(waypoints))


def test_a_whole_number_of_periods_is_kept(arm, waypoints):
    motion = arm.motion(waypoints, TIMES, period=0.01)
    assert len(motion.t) == 201
    torch.testing.assert_close(motion.t.diff(), torch.full((200,), 0.01, dtype=torch.float64))


def test_velocity_is_continuous_and_zero_at_both_ends(arm, waypoints):
    motion = arm.motion(waypoints, TIMES, period=1e-3)
    velocity = motion.pose[:, :3, 3].diff(dim=0) / motion.t.diff()[:, None]
    assert velocity[0].norm() < 0.01
    assert velocity[-1].norm() < 0.01
    assert velocity.diff(dim=0).norm(dim=-1).max() < 0.01  # a kink would jump by the speed itself, about 0.5 m/s
    assert velocity.norm(dim=-1).max() > 0.3


def test_reproduces_a_parabola(crane):
    """Catmull-Rom with uneven times is exact for quadratic motions away from its ends."""
    arm = robots.load(crane, frame="hook")
    t = torch.tensor([0.0, 0.3, 1.0, 1.4, 2.0], dtype=torch.float64)
    start, gain = torch.tensor([0.0, 0.6, 0.0]).double(), torch.tensor([0.1, 0.05, -0.1]).double()
    stop = torch.zeros(5, dtype=torch.bool)
    motion = arm.motion(start + gain * t[:, None] ** 2, t, period=0.05, stop=stop)
    inner = (motion.t >= 0.3) & (motion.t <= 1.4)
    torch.testing.assert_close(motion.pose[inner], arm(start + gain * motion.t[inner, None] ** 2))


def test_stop_holds_still(arm, waypoints):
    q = waypoints[[0, 1, 1, 2]]
    still = arm.motion(q, TIMES, stop=torch.ones(4, dtype=torch.bool))
    dwell = (still.t >= 0.5) & (still.t <= 1.5)
    torch.testing.assert_close(still.pose[dwell], arm(q[1]).expand(int(dwell.sum()), 4, 4))
    passing = arm.motion(q, TIMES)
    assert (passing.pose[dwell] - arm(q[1])).abs().max() > 1e-3


def test_gripper_switches_at_its_waypoint(arm, waypoints):
    closed = torch.tensor([False, True, True, False])
    motion = arm.motion(waypoints, TIMES, closed, period=0.07)
    assert torch.equal(motion.closed, (motion.t > 0.5 - 1e-9) & (motion.t < 2.0 - 1e-9))
    assert arm.motion(waypoints, TIMES).closed.all()


def test_batch_and_gradients(arm, waypoints):
    q = torch.stack([waypoints, waypoints.flip(0)])
    motion = arm.motion(q, TIMES)
    assert motion.pose.shape == (2, 201, 4, 4)
    torch.testing.assert_close(motion.pose[1], arm.motion(waypoints.flip(0), TIMES).pose)

    def poses(q, t):
        return arm.motion(q, t, period=0.4).pose

    inputs = (waypoints.clone().requires_grad_(), TIMES.clone().requires_grad_())
    assert torch.autograd.gradcheck(poses, inputs, check_forward_ad=True)
    assert torch.autograd.gradgradcheck(poses, inputs)


def test_limits_are_refused_by_name(arm, waypoints, crane):
    high = waypoints.clone()
    high[1, 3] = 2.9
    with pytest.raises(InvalidInput, match=r"position limit of joint 'joint4' at t = 0\.\d+ s; got 2\.9\d* rad"):
        arm.motion(high, TIMES)
    with pytest.raises(InvalidInput, match=r"velocity limit of joint 'joint1' .*2\.0944 rad/s"):
        arm.motion(waypoints, TIMES / 10)
    assert arm.motion(high, TIMES, check_limits=False).pose.isfinite().all()

    custom = robots.load(crane, frame="hook")
    q = custom.home + torch.tensor([[0.0, 0.0, 0.0], [0.0, 2.0, 0.0]], dtype=torch.float64)
    with pytest.raises(InvalidInput, match=r"position limit of joint 'travel'.* m;"):
        custom.motion(q, [0.0, 20.0])
    q[1, 1] = 1.0
    with pytest.raises(InvalidInput, match=r"velocity limit of joint 'travel'.* m/s;"):
        custom.motion(q, [0.0, 1.0])
    q[1] = torch.tensor([100.0, 0.2, 0.0])  # a continuous joint has neither limit
    assert custom.motion(q, [0.0, 1.0]).pose.isfinite().all()


def test_takes_masks_as_recordings_hold_them(arm, waypoints):
    holding, stop = [True, True, False, False], [True, False, False, True]
    wanted = arm.motion(waypoints, TIMES, torch.tensor(holding), stop=torch.tensor(stop))
    for make in (list, np.array):
        result = arm.motion(waypoints.numpy(), TIMES.numpy(), make(holding), stop=make(stop))
        assert all(torch.equal(a, b) for a, b in zip(result, wanted, strict=True))


def test_refuses_half_the_digits(arm):
    with pytest.raises(InvalidInput, match=r"precision of the arm; got float16; expected float32 or float64"):
        copy.deepcopy(arm).half()(arm.home)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_refuses_joints_that_are_rounded_by_millimetres(arm, waypoints, dtype):
    """Reported: the pose of joints in bfloat16 is up to 10.5 mm off, without a word."""
    rounded = waypoints.to(dtype)
    pose = arm(waypoints)
    for name, call in {
        "q": lambda: arm(rounded),
        "t": lambda: arm.motion(waypoints, torch.as_tensor(TIMES).to(dtype)),
        "pose": lambda: arm.inverse(pose.to(dtype)),
        "q0": lambda: arm.inverse(pose, rounded[0]),
        "base": lambda: robots.load("rizon4", base=torch.eye(4, dtype=dtype)),
    }.items():
        with pytest.raises(InvalidInput, match=rf"precision of {name}; got b?float16; expected float32 or float64"):
            call()
    with pytest.raises(InvalidInput, match="precision of q; got float16"):
        arm(waypoints.numpy().astype("float16"))


def test_refuses_what_does_not_match(arm, waypoints):
    def refused(match, q=waypoints, t=TIMES, **options):
        with pytest.raises(InvalidInput, match=match):
            arm.motion(q, t, **options)

    refused("t must increase", t=TIMES.flip(0))
    refused("t must increase", t=torch.tensor([0.0, 1, 1, 2]))
    refused("t has the wrong shape", t=TIMES[:3])
    refused("q has the wrong shape", q=waypoints[:, :6])
    refused("q has the wrong shape", q=waypoints[0])
    refused("too few waypoints", q=waypoints[:1], t=TIMES[:1])
    refused("q is not finite", q=waypoints * float("nan"))
    refused("closed has the wrong shape or type", closed=torch.ones(3, dtype=torch.bool))
    refused("closed has the wrong shape or type", closed=torch.ones(4))
    refused("stop has the wrong shape or type", stop=torch.ones(3, dtype=torch.bool))
    refused("period", period=0.0)


def test_a_path_is_recorded_and_replayed(random_q, tmp_path):
    """Any turns, half a turn among them, and quaternions without jumps of sign."""
    arm = robots.load("rizon4")
    pose = arm(random_q(arm, 40, seed=5))
    pose[0, :3, :3] = torch.diag(torch.tensor([1.0, -1, -1], dtype=torch.float64))
    path = Trajectory(torch.linspace(0, 1, 40, dtype=torch.float64), pose, torch.arange(40) < 30)
    motion = robots.to_gripper_motion(path)
    again = robots.replay(
        rec.Recording(
            cloth=rec.ClothInfo(areal_density=0.2, sheet=(0.1, 0.1)), provenance="test", grippers={"hand": motion}
        )
    )["hand"]
    torch.testing.assert_close(again.pose, pose, atol=1e-12, rtol=0)
    assert torch.equal(again.closed, path.closed)
    assert ((motion.quat_wxyz[1:] * motion.quat_wxyz[:-1]).sum(-1) >= 0).all()


def test_a_pose_is_enough_where_no_arm_is_named(random_q):
    """Joints are kept beside it, of an arm that nobody describes."""
    q = random_q(robots.load("rizon4"), 6, seed=1)
    t = np.linspace(0.0, 1.0, 6)
    pose = rec.GripperMotion(t, np.outer(t, [0.1, 0.0, 0.0]), np.tile([1.0, 0, 0, 0], (6, 1)), np.ones(6, bool))
    sheet = rec.ClothInfo(areal_density=0.2, sheet=(0.1, 0.1))
    joints = {"hand": rec.JointMotion(t, q.numpy())}
    episode = rec.Recording(cloth=sheet, provenance="test", grippers={"hand": pose}, joints=joints)
    assert robots.replay(episode)["hand"].pose[-1, :3, 3].tolist() == [0.1, 0.0, 0.0]
    with pytest.raises(RecordingError, match="no robot"):
        robots.replay(replace(episode, grippers={}))


def test_joints_that_turn_without_end_are_recorded_without_jumps():
    arm = SimpleNamespace(joint_types=("continuous", "revolute"), validate_joints=lambda q: q)
    q = unwrap_joints(arm, np.array([[3.1, 3.1], [-3.1, -3.1], [3.1, 3.1]]))
    np.testing.assert_allclose(q, [[3.1, 3.1], [2 * np.pi - 3.1, -3.1], [3.1, 3.1]])
