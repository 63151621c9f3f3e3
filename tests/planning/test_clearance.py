"""What the arms must stay clear of."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.planning_scenes import build_nominal_cloth, make_arm_episode, make_hand_episode

from torchcloth import recordings as rec
from torchcloth.planning.clearance import build_clearance
from torchcloth.planning.episode_conversion import extract_motion_parameters
from torchcloth.robots import DEFAULT_JOINT_ACCELERATION
from torchcloth.robots.primitives import GripperLimits

PALM = 0.212  # m, the lower side of the gripper's body at home


def over(height):
    """The arm over a table so high."""
    table = rec.Collider(np.array([0.0, 0, height]), np.array([0.0, 0, 1.0]), 0.4)
    return replace(make_arm_episode(), colliders={"table": table})


def looked_at(recording, least):
    """(the course, what it is held against, why nothing is)."""
    courses = extract_motion_parameters(
        build_nominal_cloth(recording), recording, 2, 0.1, DEFAULT_JOINT_ACCELERATION, GripperLimits()
    )
    return courses[0], *build_clearance(recording, courses, torch.tensor([[0.7, 0.0, 0.0]]), least)


def test_a_motion_into_the_table_is_not_clear():
    course, judge, doubt = looked_at(over(PALM - 0.1), 0.05)
    assert not doubt
    q = course.coordinates_at_check_times(course.zero_waypoints)
    assert judge.smallest_gap({"arm": q})[1] is None
    t = course.span.bound_check_times
    q[:, 1] -= 0.12 * t / t[-1]  # the shoulder leans, the hand goes down by 8 cm
    gap, refusal = judge.smallest_gap({"arm": q})
    assert "the table" in str(refusal)
    assert gap.distance < 0.05


def test_the_table_reaches_to_the_goal():
    recording = over(PALM - 0.1)
    courses = extract_motion_parameters(
        build_nominal_cloth(recording), recording, 2, 0.1, DEFAULT_JOINT_ACCELERATION, GripperLimits()
    )
    near, far = (build_clearance(recording, courses, torch.tensor([[x, 0.0, 0.0]]), 0.05)[0] for x in (0.6, 1.5))
    assert far.scene.table.x[1] == pytest.approx(1.6)
    assert near.scene.table.x[1] < 1.0


def test_solids_that_the_recorded_motion_went_through_are_no_judges():
    _, judge, doubt = looked_at(over(PALM + 0.01), 0.02)
    assert judge is None
    assert "the recorded motion itself is not clear" in doubt


def test_of_a_hand_without_an_arm_nothing_is_known():
    _, judge, doubt = looked_at(make_hand_episode(), 0.02)
    assert judge is None
    assert "not every gripper" in doubt


def test_a_named_arm_without_joints_need_not_be_known():
    """No arm moves what it holds: that nothing is kept clear is all that there is to say."""
    unknown = replace(make_hand_episode(), robots={"hand": rec.RobotInfo("ur5e", np.eye(4))})
    _, judge, doubt = looked_at(unknown, 0.05)
    assert judge is None
    assert "not every gripper that holds the cloth is moved by an arm" in doubt
