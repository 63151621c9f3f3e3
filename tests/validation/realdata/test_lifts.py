"""The lifted cloths as recordings: crop, outliers, the path in the clouds' frame, and the side of the cloth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from torchcloth import recordings
from torchcloth.identification import build_cloth, build_episode, identify
from torchcloth.training.validation.realdata import lifts

pytestmark = pytest.mark.realdata


@pytest.fixture
def source(measured_in) -> Path:
    return measured_in("lifted_cloth_clouds")


def test_all_lifts_agree_on_the_camera(source):
    """Each of seven lifts is within a degree and 4 mm of the constants; highest points are within 4 mm of the path."""
    assert len(lifts.list_trials(source)) == 7
    for trial in lifts.list_trials(source):
        yaw, shift, rms = lifts.fit_registration(source, trial)
        assert np.degrees(yaw - lifts.CAMERA_YAW_RAD) == pytest.approx(0, abs=1.0), trial
        assert shift == pytest.approx(lifts.CAMERA_SHIFT_M, abs=4e-3), trial
        assert (rms < [4e-3, 4e-3, 9e-3]).all(), trial


def test_side(source):
    """Left and right corner of three lifts: 0.26 to 0.28 m; the crop hides corners of the others."""
    sides = np.array([lifts.measure_sides(source, trial) for trial in lifts.UNFOLDED_TRIALS])
    assert sides.mean() == pytest.approx(lifts.LIFTED_SIDE_M, abs=lifts.LIFTED_SIDE_STD_M)
    assert sides.std() < lifts.LIFTED_SIDE_STD_M


def test_crop_and_outliers(source):
    """0.03 to 0.1 % of the points are below the crop, up to 1 % are outliers; on demand all points are flagged."""
    assert len(lifts.list_trials(source)) == 7
    for trial in lifts.list_trials(source):
        clean, whole = lifts.read_episode(source, trial), lifts.read_episode(source, trial, crop=False)
        assert clean.points is not None
        assert whole.points is not None
        assert len(whole.points) == 25
        count = whole.extra["notes"]["points"]
        assert len(whole.points.xyz) == count["all"]
        assert 0 < count["below the crop"] < 2e-3 * count["all"]
        assert 0 < count["outliers, in frames that show the cloth"] < 0.01 * count["all"]
        flags = whole.points.extra["cloth"]
        first = 0 if clean.points.t[0] > 0 or flags[: whole.points.counts[0]].any() else clean.points.counts[0]
        assert np.array_equal(clean.points.xyz[first:], whole.points.xyz[flags])
        assert clean.points.xyz[first:, 2].min() > lifts.CROP_HEIGHT_M
        late = np.concatenate([clean.points.frame(i) for i in range(3, len(clean.points))])
        assert (
            late[:, 2].max()
            < lifts.to_cloud_frame(lifts.read_command(source))[:, 2].max() + lifts.MAX_RISE_ABOVE_GRIPPER_M + 1e-3
        )


def test_connected_components():
    """Two squares 50 mm apart, and one point between them."""
    square = np.stack([*np.meshgrid(np.linspace(0, 0.05, 20), np.linspace(0, 0.05, 20)), np.zeros((20, 20))], -1)
    cloud = np.concatenate([square.reshape(-1, 3), square.reshape(-1, 3) + np.array([0.1, 0, 0]), [[0.075, 0.02, 0.0]]])
    components = lifts.connected_components(cloud)
    assert len(set(components[:400])) == len(set(components[400:800])) == 1
    assert len({components[0], components[400], components[800]}) == 3


def test_a_written_episode_can_be_identified(source, tmp_path):
    recording = recordings.read(recordings.write(lifts.read_episode(source, "lift_paper"), tmp_path / "episode"))
    assert recording.points is not None
    episode = build_episode(build_cloth(recording), recording)
    assert len(episode.clouds) == len(recording.points)
    assert episode.times[0] == 0
    assert "commanded" in recording.grippers["gripper"].extra


@pytest.mark.slow
@pytest.mark.parametrize("trial", ["lift_paper", "lift_navy"])
def test_identify_runs(source, trial):
    """Robustness only: a fifth of the distance of a rigidly carried cloth, and no identifiable parameter."""
    recording = lifts.read_episode(source, trial, spacing=0.015)
    fit = identify(build_cloth(recording), recording, ["youngs_modulus"], iterations=1)
    assert fit.fit["chamfer_after"] < 0.3 * fit.fit["chamfer_null"]
    assert not fit.parameters["youngs_modulus"].identifiable
