"""Noise that neighbouring points share, frozen clouds, and a stated noise that is far off."""

import json
from dataclasses import replace

import numpy as np
import pytest
from helpers.swinging_cloth import gripper_path, make_clouds, make_episode

from torchcloth.inspection import inspect, show
from torchcloth.inspection.corrections import check_recording
from torchcloth.inspection.noise import estimate_cloud_noise
from torchcloth.inspection.patch_noise import (
    NO_REST,
    STILL_MOVING,
    check_stated_noise,
    describe_stated_noise,
    estimate_patch_noise,
)
from torchcloth.robots.paths import holding_paths  # pyright: ignore[reportMissingImports] - mapped from robots/

WHITE_STD_M, SHARED_STD_M = 0.002, 0.003
REST_S = 1.4  # before the gripper moves
WAVE_COUNT, WAVE_LENGTH_M = 6, 0.15


def add_shared_error(clouds, std=SHARED_STD_M, seed=1):
    """Add an error along y that is smooth over the cloth and new in each frame."""
    rng = np.random.default_rng(seed)
    waves, phases = rng.standard_normal((2, WAVE_COUNT)) / WAVE_LENGTH_M, rng.uniform(0, 2 * np.pi, WAVE_COUNT)
    size = std * np.sqrt(2 / WAVE_COUNT) * rng.standard_normal((len(clouds), WAVE_COUNT))
    error = (np.repeat(size, clouds.counts, axis=0) * np.sin(clouds.xyz[:, [0, 2]] @ waves + phases)).sum(1)
    return replace(clouds, xyz=clouds.xyz + error[:, None] * [0.0, 1.0, 0.0])


def estimate(clouds):
    return estimate_patch_noise(clouds, clouds.t < REST_S, gripper_path(clouds.t)[:, None])


@pytest.fixture(scope="module")
def white():
    return make_clouds(noise=WHITE_STD_M)


@pytest.fixture(scope="module")
def shared(white):
    return add_shared_error(white)


@pytest.mark.parametrize("count", [600, 5000])
def test_white_noise_is_not_shared_by_neighbours(count):
    std = estimate(make_clouds(noise=WHITE_STD_M, count=count)).std
    assert std is not None
    assert std < 0.15 * WHITE_STD_M


def test_what_neighbours_share_is_measured_beside_what_they_do_not(shared):
    assert estimate(shared).std == pytest.approx(SHARED_STD_M, rel=0.25)
    noise = estimate_cloud_noise(shared, shared.t < REST_S)
    assert noise is not None
    assert noise.std == pytest.approx(WHITE_STD_M, rel=0.15)  # which alone does not show it


def test_nothing_is_measured_without_frames_at_rest(shared):
    grippers = gripper_path(shared.t)[:, None]
    never = estimate_patch_noise(shared, np.zeros(len(shared), bool), grippers)
    assert (never.std, never.frames, never.method) == (None, 0, NO_REST)
    assert estimate_patch_noise(shared, shared.t < REST_S, grippers[:, :0]).method == NO_REST


def test_cloth_that_swings_below_grippers_that_stand_is_no_noise(white):
    """It moves least where it is fixed, and a camera errs everywhere."""
    t, below = np.repeat(white.t, white.counts), 0.5 - white.xyz[:, 2]
    swing = 0.1 * below * np.sin(2 * np.pi * 1.3 * t)
    swinging = replace(white, xyz=white.xyz + swing[:, None] * [0.0, 1.0, 0.0])
    assert estimate(swinging).method == STILL_MOVING


@pytest.mark.parametrize(("stated", "said"), [(0.0012, "less than half of"), (0.002, None), (0.008, "more than twice")])
def test_a_stated_noise_that_is_far_off_is_named(shared, stated, said):
    recording = make_episode(points=shared, observation_noise_std=stated)
    note = check_stated_noise(recording, holding_paths(recording))
    assert (note is None) is (said is None)
    if note is not None:
        assert said in note
        assert "shared by neighbouring points" in note


def test_the_checks_before_a_fit_name_it(white):
    notes = check_recording(make_episode(points=white.select(white.t < 2.5), observation_noise_std=0.0005)).notes
    assert ["the stated noise" in note for note in notes] == [True]


def test_other_layers_are_no_part_of_a_patch(white):
    """A patch that is far behind in one frame is left out."""
    jumping = white.xyz + np.repeat(white.t > 1.0, white.counts)[:, None] * [0.0, 0.2, 0.0]
    assert estimate(replace(white, xyz=jumping)).method == NO_REST


def test_a_stated_noise_is_too_large_only_where_all_of_the_noise_was_measured(shared):
    noise, patch = estimate_cloud_noise(shared, None), estimate(shared)
    assert "more than twice" in (describe_stated_noise(0.01, noise, patch) or "")
    assert describe_stated_noise(0.01, noise, replace(patch, std=None)) is None
    assert describe_stated_noise(0.01, noise, None) is None
    assert "less than half" in (describe_stated_noise(0.0005, noise, None) or "")
    assert describe_stated_noise(None, noise, patch) is None


def test_wrinkles_between_sparse_points_are_no_noise():
    """Patches of twice the area show more of them, and the stated noise is not judged."""
    sparse = make_clouds(noise=0.0005, count=90)
    ripple = 0.01 * np.sin(2 * np.pi * sparse.xyz[:, [2]] / 0.2)
    noise = estimate_cloud_noise(replace(sparse, xyz=sparse.xyz + ripple * [0.0, 1.0, 0.0]), None)
    assert noise is not None
    assert not noise.is_resolved
    assert describe_stated_noise(0.0005, noise, None) is None


def test_inspection_reports_frozen_clouds_and_shared_noise(capsys):
    shared = add_shared_error(make_clouds(noise=WHITE_STD_M, count=200, rate=8.0))
    frames = [shared.frame(30 if i in (31, 32) else i) for i in range(len(shared))]
    report = inspect(make_episode(points=replace(shared, xyz=np.concatenate(frames)), observation_noise_std=0.0012))
    content = json.loads(json.dumps(report.as_dict(), allow_nan=False))
    assert content["frozen_clouds"] == [31, 32]
    assert content["patch_noise"]["std"] == pytest.approx(SHARED_STD_M, rel=0.4)  # from ten frames
    assert any("the stated noise" in note for note in content["notes"])
    show(report)
    shown = capsys.readouterr().out
    assert "frozen clouds" in shown
    assert "noise shared by neighbours" in shown
