from dataclasses import replace

import numpy as np
import pytest

from torchcloth.errors import InvalidInput
from torchcloth.observe import StereoNoise
from torchcloth.observe.stereo import draw_patch_noise, mask_stereo_shadow

FB = 424 * 0.05  # px m
QUIET = StereoNoise(subpixel=0.0, step=0.0, holes=0.0, fattening=0)


def step(near, far, left=60, right=100, shape=(40, 160)):
    """A near strip before a far wall."""
    depth = np.full(shape, far, np.float32)
    depth[:, left:right] = near
    return depth


@pytest.mark.parametrize("z", [0.5, 1.0, 2.0])
def test_measured_sigma_is_the_stated_one_and_intel_s_formula(z):
    noisy = StereoNoise().apply(np.full((300, 848), z, np.float32), np.random.default_rng(0))[:, 100:]
    error = noisy[noisy > 0] - z
    # patches of 4 pi 2^2 px: about 4500 independent errors, known to 1.1 %
    assert error.std() == pytest.approx(float(StereoNoise().sigma(z)), rel=0.05)
    assert float(StereoNoise().sigma(z)) == pytest.approx(z**2 * 0.08 / FB, rel=0.01)  # RMS = z^2 subpixel / (f b)
    assert abs(np.median(error)) < 0.1 * error.std() + z**2 / 64 / FB  # half a step of disparity


def test_errors_are_alike_within_a_patch():
    noise = StereoNoise(step=0.0, holes=0.0, patch=3.0)
    error = (noise.apply(np.full((240, 400), 1.0, np.float32), np.random.default_rng(1)) - 1)[:, 40:]
    for lag in (1, 3, 6):
        result = (error[:, :-lag] * error[:, lag:]).mean() / error.var()
        assert result == pytest.approx(np.exp(-(lag**2) / 4 / 9), abs=0.06)  # two Gaussians of 3 px
    assert draw_patch_noise((64, 64), 0.0, np.random.default_rng(0)).std() == pytest.approx(1, abs=0.05)


def test_disparities_come_in_steps():
    noisy = replace(QUIET, subpixel=0.3, step=1 / 32).apply(
        np.full((50, 200), 1.3, np.float32), np.random.default_rng(0)
    )
    steps = 32 * FB / noisy[:, 60:].astype(float)
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-3)
    assert len(np.unique(np.rint(steps))) > 20


def test_a_shadow_as_wide_as_the_step_in_disparity_falls_to_the_left():
    near, far = 0.6, 1.2
    band = FB / near - FB / far  # 17.7 px
    seen = QUIET.apply(step(near, far), np.random.default_rng(0)) > 0
    row = seen[20]
    assert not row[60 - int(band) : 60].any()
    assert row[60:].all()
    assert row[int(FB / far) + 1 : 60 - int(band) - 2].all()
    assert not row[: int(FB / far)].any()  # out of the right imager's view: the invalid band
    assert mask_stereo_shadow(FB / step(near, far)).sum() == (~seen).sum()


def test_a_near_surface_is_fattened_to_the_right_too():
    noisy = replace(QUIET, fattening=3).apply(step(0.6, 1.2), np.random.default_rng(0))
    np.testing.assert_allclose(noisy[20, 57:103], 0.6, atol=1e-4)
    assert noisy[20, 103] == pytest.approx(1.2, abs=1e-4)
    assert noisy[20, 56] == 0  # shadow


def test_holes_have_their_share():
    noisy = replace(QUIET, holes=0.05, patch=2.0).apply(np.full((400, 800), 1.0, np.float32), np.random.default_rng(0))
    missing = (noisy[:, 30:] == 0).mean()
    assert missing == pytest.approx(0.05, abs=0.01)


def test_the_bias_of_a_device_is_its_scale_and_its_warp():
    depth = np.full((100, 300), 1.0, np.float32)
    scales = []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        noise = replace(QUIET, bias_scale=0.0193)
        scales.append(noise.apply(depth, rng, noise.bias_field(depth.shape, rng))[:, 60:].mean() - 1)
    assert np.std(scales) == pytest.approx(0.0193, rel=0.15)  # 200 devices: known to 5 %
    warped = replace(QUIET, bias_disparity=0.1, bias_length=40)
    field = warped.bias_field(depth.shape, np.random.default_rng(0))
    error = warped.apply(depth, np.random.default_rng(0), field)[:, 60:] - 1
    np.testing.assert_allclose(error, FB / (FB + field[1][:, 60:]) - 1, atol=1e-6)


def test_what_is_not_seen_stays_unseen_and_parameters_are_checked():
    assert not StereoNoise().apply(np.zeros((20, 30)), np.random.default_rng(0)).any()
    far = np.zeros((60, 80))
    far[:, 40:] = 6.0  # less than a pixel of disparity: nothing beside it is fattened
    seen = StereoNoise(focal=100.0, baseline=0.05, holes=0.0).apply(far, np.random.default_rng(0))
    assert not seen[:, :40].any()
    assert seen[:, 40:].any()
    for bad in ({"focal": 0.0}, {"baseline": -1.0}, {"holes": 1.0}, {"bias_length": 0.1}, {"subpixel": np.nan}):
        with pytest.raises(InvalidInput, match=next(iter(bad))):
            StereoNoise(**bad)
    with pytest.raises(InvalidInput, match="bias"):
        StereoNoise.d435().apply(np.ones((4, 4)), np.random.default_rng(0))
