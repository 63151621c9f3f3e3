"""Before a fit: frozen clouds are left out, and a clock that is off is set."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.swinging_cloth import make_clouds, make_episode

from torchcloth.inspection.corrections import MIN_CLOCK_PRIOR_STD_S, check_all, check_recording, find_frozen_clouds

LAG_S = 0.08


@pytest.fixture(scope="module")
def clouds():
    return make_clouds()


@pytest.fixture(scope="module")
def late():
    return make_episode(points=make_clouds(lag=LAG_S))


def freeze(points, first, count):
    """Repeat one cloud bit for bit, as a camera does that hangs."""
    frames = [points.frame(first if first <= i < first + count else i) for i in range(len(points))]
    return replace(points, xyz=np.concatenate(frames), counts=np.array([len(frame) for frame in frames]))


def test_a_recording_without_faults_is_left_as_it_is(clouds):
    recording = make_episode(points=clouds)
    checked = check_recording(recording)
    assert checked.recording is recording
    assert checked.notes == []
    assert checked.clock_std is None


def test_frozen_clouds_are_left_out_and_named(clouds):
    frozen = freeze(clouds, 3, 4)
    assert np.flatnonzero(find_frozen_clouds(frozen)).tolist() == [4, 5, 6]
    checked = check_recording(make_episode(points=frozen))
    assert len(checked.recording.points) == len(clouds) - 3
    np.testing.assert_array_equal(checked.recording.points.t, np.delete(clouds.t, [4, 5, 6]))
    assert f"3 of {len(clouds)} clouds equal the one before bit for bit" in checked.notes[0]


def test_a_camera_that_shows_one_cloud_only_is_left_to_the_fit(clouds):
    frozen = freeze(clouds, 0, len(clouds))
    assert len(check_recording(make_episode(points=frozen)).recording.points) == len(clouds)


def test_a_clock_that_is_off_is_set_within_its_error(late):
    checked = check_recording(late)
    assert checked.clock_std >= MIN_CLOCK_PRIOR_STD_S
    assert abs(-checked.recording.clock_offset - LAG_S) < 3 * checked.clock_std
    assert "the clock was corrected" in checked.notes[0]


def test_the_motion_still_covers_the_first_frame(late):
    """A motion that begins with the first frame leaves no room for an earlier one."""
    start = late.points.t[0]
    hands = {name: clip_start(hand, start) for name, hand in late.grippers.items()}
    checked = check_recording(replace(late, grippers=hands))
    assert checked.notes
    assert checked.recording.points.t[0] + checked.recording.clock_offset >= start
    assert checked.clock_std > 0.5 * LAG_S


def clip_start(hand, start):
    later = hand.t > start
    parts = (getattr(hand, name)[later] for name in ("position", "quat_wxyz", "closed"))
    position, quat, closed = (np.concatenate([part[:1], part]) for part in parts)
    return replace(hand, t=np.concatenate([[start], hand.t[later]]), position=position, quat_wxyz=quat, closed=closed)


def test_a_clock_that_the_recording_sets_is_kept(late):
    right = replace(late, clock_offset=-LAG_S)
    assert check_recording(right).recording is right


def test_of_several_recordings_the_least_certain_clock_counts(late, clouds):
    recordings, notes, std = check_all([make_episode(points=clouds), late])
    assert [r.clock_offset == 0.0 for r in recordings] == [True, False]
    assert len(notes) == 1
    assert std == check_recording(late).clock_std
