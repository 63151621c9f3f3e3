"""What the arms must stay clear of."""

from dataclasses import replace

import numpy as np
import torch
from scenes import by_arm, by_hand

from torchcloth import recordings as rec
from torchcloth.planning.clearance import clearance_of

PALM = 0.212  # m, the lower side of the gripper's body at home


def over(height):
    """The arm over a table so high."""
    table = rec.Collider(np.array([0.0, 0, height]), np.array([0.0, 0, 1.0]), 0.4)
    return replace(by_arm(), colliders={"table": table})


def angles(recording):
    own = recording.joints["arm"]
    return torch.as_tensor(own.t), {"arm": torch.as_tensor(own.q)}


def test_a_motion_into_the_table_is_not_clear():
    recording = over(PALM - 0.1)
    t, q = angles(recording)
    judge, doubt = clearance_of(recording, t, q, 0.05)
    assert not doubt
    assert judge.nearest(t, q)[1] is None
    q["arm"][:, 1] -= 0.12 * (t / t[-1])  # the shoulder leans, the hand goes down by 8 cm
    gap, refusal = judge.nearest(t, q)
    assert "the table" in str(refusal)
    assert gap.distance < 0.05


def test_solids_that_the_recorded_motion_went_through_are_no_judges():
    recording = over(PALM + 0.01)
    judge, doubt = clearance_of(recording, *angles(recording), 0.02)
    assert judge is None
    assert "the recorded motion itself is not clear" in doubt


def test_of_a_hand_without_an_arm_nothing_is_known():
    judge, doubt = clearance_of(by_hand(), torch.linspace(0, 1, 5), {}, 0.02)
    assert judge is None
    assert "not every gripper" in doubt
