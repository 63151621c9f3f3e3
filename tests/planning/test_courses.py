"""What is added to a motion, and its limits."""

import pytest
import torch
from scenes import LASTS, by_arm, by_hand, cloth_of

from torchcloth.planning.courses import Bounds, Span, rotation
from torchcloth.planning.feasible import step_within
from torchcloth.planning.staging import as_episode, courses_of
from torchcloth.robots import ACCELERATION, arm_of, replay
from torchcloth.robots.primitives import Limits


def courses(recording, waypoints=4, wait=0.1, limits=Limits()):  # noqa: B008 - a tuple
    return courses_of(cloth_of(recording), recording, waypoints, wait, ACCELERATION, limits)


def test_what_is_added_begins_and_ends_at_rest():
    span = Span(0.1, 0.5, 3)
    at, h = torch.tensor([0.1, 0.5]), 1e-4
    assert torch.allclose(span.basis(torch.tensor([0.0, 0.1])), torch.zeros(2, 3))
    assert torch.allclose(span.basis(torch.tensor([0.5, 0.9])), torch.tensor([[0.0, 0, 1], [0, 0, 1]]))
    speed = (span.basis(at + h) - span.basis(at - h)) / (2 * h)
    assert float(speed.abs().max()) < 0.05  # 1/s; on the way it is 13


def test_with_nothing_added_the_motion_is_the_recorded_one():
    for recording in (by_hand(), by_arm()):
        (course,) = courses(recording)
        (path,) = replay(recording).values()
        own = course.trajectory(course.nothing)
        assert torch.allclose(own.pose[: len(path.t)], path.pose, atol=1e-12)
        assert float(own.t[-1]) == pytest.approx(LASTS + 0.1)
        assert torch.equal(own.pose[-1], own.pose[len(path.t) - 1])  # it waits where it ends


def test_turns_are_rotations():
    turn = torch.tensor([[0.0, 0.0, torch.pi / 2], [0.3, -0.2, 0.1]])
    found = rotation(turn)
    assert torch.allclose(found[0], torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), atol=1e-12)
    assert torch.allclose(found @ found.mT, torch.eye(3).expand(2, 3, 3), atol=1e-12)
    assert torch.allclose(found[1] @ turn[1], turn[1])


def test_limits_hold_between_waypoints_too():
    recording = by_arm()
    (course,) = courses(recording)
    bounds, arm = Bounds.of([course]), arm_of(recording, "arm")
    at = torch.zeros(course.nothing.numel())
    step = step_within(at, -torch.randn(len(at)), torch.eye(len(at)), bounds)
    assert bounds.nearest(step)[0] > 0.99  # as far as it may go
    q = course.coordinates(step.reshape(4, 7))
    velocity = (q.diff(dim=0) / course.t.diff()[:, None]).abs()
    assert bool((velocity < 1.01 * arm.limits.velocity).all())
    own = courses(recording)[0].q
    hardest = ((own[12:] - 2 * own[6:-6] + own[:-12]) / 0.06**2).abs().max()  # what the recorded motion asks for
    found = ((q[12:] - 2 * q[6:-6] + q[:-12]) / 0.06**2).abs()
    assert float(found.max()) < 1.05 * max(ACCELERATION, float(hardest))


def test_a_motion_beyond_the_limits_is_no_reason_to_give_up():
    """The recorded one accelerates by more than 3 rad/s^2 already; other joints still have their room."""
    (course,) = courses(by_arm())
    bounds = Bounds.of([course])
    assert bool((bounds.low <= 0).all() and (bounds.high >= 0).all())
    assert float(bounds.high.min()) == 0.0


def test_a_hand_stays_above_the_table():
    (course,) = courses(by_hand(table=0.45))
    bounds = Bounds.of([course])
    down = torch.zeros(4, 6)
    down[:, 2] = -1.0
    step = step_within(torch.zeros(24), -down.flatten(), torch.eye(24), bounds)
    assert float(course.trajectory(step.reshape(4, 6)).pose[:, 2, 3].min()) == pytest.approx(0.45, abs=1e-3)


def test_the_planned_episode_says_what_was_planned(tmp_path):
    from torchcloth import recordings as rec

    for recording in (by_hand(), by_arm()):
        (course,) = courses(recording)
        z = 0.01 * torch.randn(course.nothing.shape)
        path = rec.write(as_episode(recording, [course], [z]), tmp_path / course.name)
        (again,) = replay(rec.read(path)).values()
        assert torch.allclose(again.pose, course.trajectory(z).pose, atol=1e-9)
        assert again.closed.tolist() == course.closed.tolist()
