"""What is added to a motion, and its limits."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.planning_scenes import DURATION_S, UPPER_EDGE_M, build_nominal_cloth, make_arm_episode, make_hand_episode

from torchcloth import recordings as rec
from torchcloth.planning import episode_conversion
from torchcloth.planning.constrained_step import solve_constrained_step
from torchcloth.planning.episode_conversion import build_planned_episode, extract_motion_parameters, motion_warnings
from torchcloth.planning.motion_parameters import LinearBounds, SplineSpan, rotation_matrix
from torchcloth.robots import DEFAULT_JOINT_ACCELERATION, arm_from_recording, replay
from torchcloth.robots.primitives import GripperLimits


def courses(recording, waypoints=4, wait=0.1, limits=GripperLimits()):  # noqa: B008 - a tuple
    return extract_motion_parameters(
        build_nominal_cloth(recording), recording, waypoints, wait, DEFAULT_JOINT_ACCELERATION, limits
    )


def test_what_is_added_begins_and_ends_at_rest():
    span = SplineSpan(0.1, 0.5, 3)
    at, h = torch.tensor([0.1, 0.5]), 1e-4
    assert torch.allclose(span.basis(torch.tensor([0.0, 0.1])), torch.zeros(2, 3))
    assert torch.allclose(span.basis(torch.tensor([0.5, 0.9])), torch.tensor([[0.0, 0, 1], [0, 0, 1]]))
    speed = (span.basis(at + h) - span.basis(at - h)) / (2 * h)
    assert float(speed.abs().max()) < 0.05  # 1/s; on the way it is 13


def test_with_nothing_added_the_motion_is_the_recorded_one():
    for recording in (make_hand_episode(), make_arm_episode()):
        (course,) = courses(recording)
        (path,) = replay(recording).values()
        custom = course.trajectory(course.zero_waypoints)
        assert torch.allclose(custom.pose[: len(path.t)], path.pose, atol=1e-12)
        assert float(custom.t[-1]) == pytest.approx(DURATION_S + 0.1)
        assert torch.equal(custom.pose[-1], custom.pose[len(path.t) - 1])  # it waits where it ends


def test_turns_are_rotations():
    turn = torch.tensor([[0.0, 0.0, torch.pi / 2], [0.3, -0.2, 0.1]])
    result = rotation_matrix(turn)
    assert torch.allclose(result[0], torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), atol=1e-12)
    assert torch.allclose(result @ result.mT, torch.eye(3).expand(2, 3, 3), atol=1e-12)
    assert torch.allclose(result[1] @ turn[1], turn[1])


def test_limits_hold_between_waypoints_too():
    recording = make_arm_episode()
    (course,) = courses(recording)
    bounds, arm = LinearBounds.concatenate([course]), arm_from_recording(recording, "arm")
    at = torch.zeros(course.zero_waypoints.numel())
    step = solve_constrained_step(at, -torch.randn(len(at)), torch.eye(len(at)), bounds)
    assert bounds.nearest_limit(step)[0] > 0.99  # as far as it may go
    q = course.coordinates(step.reshape(4, 7))
    velocity = (q.diff(dim=0) / course.t.diff()[:, None]).abs()
    assert bool((velocity < 1.01 * arm.limits.velocity).all())
    custom = courses(recording)[0].q
    hardest = (
        ((custom[12:] - 2 * custom[6:-6] + custom[:-12]) / 0.06**2).abs().max()
    )  # what the recorded motion asks for
    result = ((q[12:] - 2 * q[6:-6] + q[:-12]) / 0.06**2).abs()
    assert float(result.max()) < 1.05 * max(DEFAULT_JOINT_ACCELERATION, float(hardest))


def test_a_motion_beyond_the_limits_is_no_reason_to_give_up():
    """The recorded one accelerates by more than 3 rad/s^2 already; other joints still have their room."""
    (course,) = courses(make_arm_episode())
    bounds = LinearBounds.concatenate([course])
    assert bool((bounds.low <= 0).all() and (bounds.high >= 0).all())
    assert float(bounds.high.min()) == 0.0


def test_a_hand_stays_above_the_table():
    (course,) = courses(make_hand_episode(table=0.45))
    bounds = LinearBounds.concatenate([course])
    down = torch.zeros(4, 6)
    down[:, 2] = -1.0
    step = solve_constrained_step(torch.zeros(24), -down.flatten(), torch.eye(24), bounds)
    assert float(course.trajectory(step.reshape(4, 6)).pose[:, 2, 3].min()) == pytest.approx(0.45, abs=1e-3)


def test_the_planned_episode_says_what_was_planned(tmp_path):
    for recording in (make_hand_episode(), make_arm_episode()):
        (course,) = courses(recording)
        z = 0.01 * torch.randn(course.zero_waypoints.shape)
        path = rec.write(build_planned_episode(recording, [course], [z]), tmp_path / course.name)
        (again,) = replay(rec.read(path)).values()
        assert torch.allclose(again.pose, course.trajectory(z).pose, atol=1e-9)
        assert again.closed.tolist() == course.closed.tolist()


def two_hands(longer, opens=None):
    """The sheet's edge held by two hands; the right one is recorded ``longer`` [s], and may open at a time."""
    recording = make_hand_episode()
    hand = recording.grippers["hand"]
    t = np.linspace(0.0, DURATION_S + longer, round((DURATION_S + longer) / 0.01) + 1)
    place = hand.position[:1] + np.stack([0.1 * t, 0 * t, 0 * t], -1)
    closed = np.ones(len(t), bool) if opens is None else t < opens - 1e-9
    right = rec.GripperMotion(t, place, np.tile([1.0, 0, 0, 0], (len(t), 1)), closed)
    grasps = {"hand": rec.GraspInfo(UPPER_EDGE_M[:3], 0.02), "right": rec.GraspInfo(UPPER_EDGE_M[4:], 0.02)}
    return replace(recording, grasps=grasps, grippers={"hand": hand, "right": right})


def test_what_was_recorded_longer_waits_as_well():
    """It had driven on through the wait, where no limit is looked at: it comes to rest."""
    left, right = courses(two_hands(longer=0.3), wait=0.2)
    for course, stops in ((left, 0.0), (right, 0.1 / right.limits.acceleration)):
        pose = course.trajectory(course.zero_waypoints).pose
        after = course.t > DURATION_S + stops + 0.01
        assert int(after.sum()) > 5
        assert torch.equal(pose[after], pose[after][-1:].expand_as(pose[after]))
    beyond = right.recorded_coordinates[-1, 0] - right.recorded_coordinates[right.t <= DURATION_S + 1e-9][-1, 0]
    assert float(beyond) == pytest.approx(0.1**2 / (2 * right.limits.acceleration), rel=1e-3)


def test_what_is_under_way_at_the_end_comes_to_rest_within_the_limits():
    """It had been stopped in 10 ms."""
    recording = make_arm_episode()
    custom = recording.joints["arm"]
    q = custom.q.copy()
    q[:, 0] += 0.6 * custom.t  # rad/s
    recording = replace(recording, joints={"arm": replace(custom, q=q)})
    for wait, message in ((0.5, "it takes 0.20 s of the wait to come to rest"), (0.1, "wait 0.20 s or longer")):
        (course,) = extract_motion_parameters(build_nominal_cloth(recording), recording, 4, wait, 3.0, GripperLimits())
        (doubt,) = motion_warnings(recording, [course])
        assert message in doubt
        velocity = course.q.diff(dim=0) / course.t.diff()[:, None]
        hardest = (velocity.diff(dim=0)[:, 0] / course.t.diff()[1:])[course.t[:-2] > DURATION_S - 1e-9].abs().max()
        assert float(hardest) == pytest.approx(3.0 if wait > 0.2 else 6.0, rel=0.1)
        assert torch.equal(velocity[-1], torch.zeros(7)) == (wait > 0.2)
        bounds = LinearBounds.concatenate([course])
        last = [
            k for k, name in enumerate(bounds.names) if name == f"acceleration of {course.coordinate_names[0]} of arm"
        ][-1]
        assert float(bounds.high[last]) < 4.0  # the halt is no recorded motion
        assert bool(
            (course.span.bound_check_times > DURATION_S + 0.5 * min(wait, 0.2)).any()
        )  # limits of positions hold there, too


def test_a_gripper_that_had_let_go_before_moves_as_recorded():
    recording = two_hands(longer=0.0, opens=0.05)
    late = replace(recording, points=rec.PointClouds(np.array([0.1, 0.2]), np.zeros((2, 3)), np.ones(2, int)))
    assert [course.name for course in courses(late, waypoints=2)] == ["hand"]


def test_a_hand_recorded_longer_lets_go_in_the_wait_when_it_did():
    _, course = courses(two_hands(longer=0.3, opens=DURATION_S + 0.1), wait=0.3)
    assert float(course.t[~course.closed][0]) == pytest.approx(DURATION_S + 0.1, abs=1e-6)


def test_a_hand_lets_go_when_it_did():
    """At 0.1 * 3, which is later than the other's knot at 0.3 by one bit."""
    recording = two_hands(longer=0.0, opens=0.1 * 3)
    t = recording.grippers["right"].t.copy()
    t[30] = 0.1 * 3
    assert t[30] > 0.3 == recording.grippers["hand"].t[30]
    right = replace(recording.grippers["right"], t=t, closed=t < 0.1 * 3)
    _, course = courses(replace(recording, grippers={**recording.grippers, "right": right}))
    assert float(course.t[~course.closed][0]) == pytest.approx(0.3, abs=1e-6)


def test_accelerations_are_bounded_where_they_are_greatest():
    """At the ends of what is added; there half of them was looked at."""
    (course,) = courses(make_hand_episode(), waypoints=4)
    bounds = LinearBounds.concatenate([course])
    added = torch.zeros(4, 6)
    added[0, 0] = 1.0
    of_x = [k for k, name in enumerate(bounds.names) if name == "acceleration of x of hand"]
    result = (bounds.rows @ added.flatten())[of_x]
    fine = torch.linspace(0.0, DURATION_S, 4001)
    curve = course.span.basis(fine)[:, 0]
    true = (curve[2:] - 2 * curve[1:-1] + curve[:-2]) / float(fine[1]) ** 2
    assert float(result[0]) == pytest.approx(float(true[0]), rel=0.01)
    assert float(result.abs().max()) == pytest.approx(float(true.abs().max()), rel=0.01)


def test_a_recorded_motion_that_is_under_way_is_no_acceleration():
    recording = two_hands(longer=0.0)
    late = replace(recording, points=rec.PointClouds(np.array([0.1, 0.2]), np.zeros((2, 3)), np.ones(2, int)))
    _, course = courses(late, waypoints=2)  # 0.1 m/s all the time
    bounds = LinearBounds.concatenate([course])
    first = bounds.names.index("acceleration of x of right")
    assert course.span.begin == pytest.approx(0.1)
    assert float(bounds.high[first]) == pytest.approx(course.limits.acceleration, rel=1e-3)
    assert float(bounds.low[first]) == pytest.approx(-course.limits.acceleration, rel=1e-3)


def test_joints_that_turn_without_end_go_the_short_way(monkeypatch):
    recording, arm = make_arm_episode(), arm_from_recording(make_arm_episode(), "arm")
    joints = recording.joints["arm"]
    turned = joints.q.copy()
    turned[20:, 6] -= 2 * np.pi  # as encoders say it
    monkeypatch.setattr(episode_conversion, "arm_from_recording", lambda *_: arm)
    arm.joint_types = (*arm.joint_types[:6], "continuous")
    wrapped = replace(recording, joints={"arm": replace(joints, q=turned)})
    (course,), (plain,) = courses(wrapped), courses(recording)
    np.testing.assert_allclose(course.q, plain.q, atol=1e-12)


def test_an_arm_that_stands_by_need_not_be_known():
    adjacent = {"spare": rec.JointMotion(np.arange(5) / 10, np.zeros((5, 6)))}
    (course,) = courses(replace(make_hand_episode(), joints=adjacent))
    assert course.name == "hand"
    assert not motion_warnings(replace(make_hand_episode(), joints=adjacent), [course])


def test_of_a_table_that_leans_its_height_below_the_path_is_kept():
    recording = make_hand_episode(table=0.1)
    assert not motion_warnings(recording, courses(recording))
    for angle, message in ((0.2, "hand: table is inclined"), (1.2, "hand: table is too steep")):
        table = replace(recording.colliders["table"], normal=np.array([np.sin(angle), 0.0, np.cos(angle)]))
        inclined = replace(recording, colliders={"table": table})
        assert [w for w in motion_warnings(inclined, courses(inclined)) if w.startswith(message)]
