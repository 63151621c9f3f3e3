"""The lifted cloths as episodes: crop, outliers, the path in the clouds' frame, and the side of the cloth."""

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
    """Seven lifts, each on its own: within a degree and 4 mm of the constants, highest points 4 mm beside the path."""
    assert len(lifts.trials(source)) == 7
    for trial in lifts.trials(source):
        yaw, shift, rms = lifts.register(source, trial)
        assert np.degrees(yaw - lifts.YAW) == pytest.approx(0, abs=1.0), trial
        assert shift == pytest.approx(lifts.SHIFT, abs=4e-3), trial
        assert (rms < [4e-3, 4e-3, 9e-3]).all(), trial


def test_side(source):
    """Left and right corner of three lifts: 0.26 to 0.28 m; the crop hides corners of the others."""
    found = np.array([lifts.sides(source, trial) for trial in lifts.SPREAD])
    assert found.mean() == pytest.approx(lifts.SIDE, abs=lifts.SIDE_STD)
    assert found.std() < lifts.SIDE_STD


def test_crop_and_outliers(source):
    """What is dropped: 0.03 to 0.1 % below the crop, up to 1 % outliers; kept flagged on demand."""
    assert len(lifts.trials(source)) == 7
    for trial in lifts.trials(source):
        clean, whole = lifts.episode(source, trial), lifts.episode(source, trial, crop=False)
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
        assert clean.points.xyz[first:, 2].min() > lifts.CROP
        late = np.concatenate([clean.points.frame(i) for i in range(3, len(clean.points))])
        assert late[:, 2].max() < lifts.registered(lifts.command(source))[:, 2].max() + lifts.RISE + 1e-3


def test_pieces():
    """Two squares 50 mm apart, and one point between them."""
    square = np.stack([*np.meshgrid(np.linspace(0, 0.05, 20), np.linspace(0, 0.05, 20)), np.zeros((20, 20))], -1)
    cloud = np.concatenate([square.reshape(-1, 3), square.reshape(-1, 3) + np.array([0.1, 0, 0]), [[0.075, 0.02, 0.0]]])
    found = lifts.pieces(cloud)
    assert len(set(found[:400])) == len(set(found[400:800])) == 1
    assert len({found[0], found[400], found[800]}) == 3


def test_through_the_disk_and_into_identify(source, tmp_path):
    recording = recordings.read(recordings.write(lifts.episode(source, "lift_paper"), tmp_path / "episode"))
    assert recording.points is not None
    taken = build_episode(build_cloth(recording), recording)
    assert len(taken.clouds) == len(recording.points)
    assert taken.times[0] == 0
    assert "commanded" in recording.grippers["gripper"].extra


@pytest.mark.slow
@pytest.mark.parametrize("trial", ["lift_paper", "lift_navy"])
def test_identify_runs(source, trial):
    """Robustness only: a fifth of the distance of a cloth carried rigidly, and no parameter called identified."""
    recording = lifts.episode(source, trial, spacing=0.015)
    fit = identify(build_cloth(recording), recording, ["youngs_modulus"], iterations=1)
    assert fit.fit["chamfer_after"] < 0.3 * fit.fit["chamfer_null"]
    assert not fit.parameters["youngs_modulus"].identifiable
