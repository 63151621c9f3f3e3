import numpy as np
import pytest

from torchcloth.errors import InvalidInput
from torchcloth.observe import DepthNoise, StereoNoise, mask_depth_edges


@pytest.mark.parametrize("z", [0.4, 1.0, 2.5])
def test_measured_sigma_is_the_model_s(z):
    depth = np.full((200, 200), z, np.float32)
    noisy = DepthNoise().apply(depth, np.random.default_rng(1))
    expected = 0.0005 + 0.001 * max(z - 0.5, 0)
    # 40 000 samples: the standard deviation is known to 0.35 %
    assert (noisy - z).std() == pytest.approx(expected, rel=0.02)
    assert abs((noisy - z).mean()) < 4 * expected / 200


def test_jitter_adds_the_slope_s_share():
    # depth rises by 4 mm per pixel: a jitter of 0.25 px is 1 mm of depth
    depth = (1.0 + 0.004 * np.arange(200, dtype=np.float32))[None].repeat(200, 0)
    noise = DepthNoise(sigma_base=0.0, sigma_slope=0.0)
    error = (noise.apply(depth, np.random.default_rng(2)) - depth)[5:-5, 5:-5]
    assert error.std() == pytest.approx(0.001, rel=0.03)


def test_the_same_seed_gives_the_same_image_and_another_does_not():
    depth = np.full((30, 40), 1.2, np.float32)
    noise = DepthNoise(bias_amplitude=0.004)
    images = [
        noise.apply(depth, rng, noise.bias_field(depth.shape, rng)) for rng in map(np.random.default_rng, (7, 7, 8))
    ]
    np.testing.assert_array_equal(images[0], images[1])
    assert not np.array_equal(images[0], images[2])


def test_a_step_in_depth_is_lost_and_invalid_stays_invalid():
    depth = np.full((20, 30), 1.0, np.float32)
    depth[:, 15:] = 2.0
    depth[:, :3] = 0.0
    noisy = DepthNoise().apply(depth, np.random.default_rng(0))
    assert not noisy[:, 14:16].any()
    assert not noisy[:, :3].any()
    assert (noisy[:, 4:14] > 0).all()
    assert (noisy[:, 16:] > 0).all()


def test_a_missing_neighbour_is_no_edge():
    depth = np.full((5, 5), 2.0)
    depth[2, 2] = 0.0
    assert not mask_depth_edges(depth, 0.8).any()


def test_jitter_invents_no_points_between_two_surfaces():
    depth = np.full((40, 40), 1.0, np.float32)
    depth[:, 20:] = 1.5  # below the range at which edges are dropped
    noisy = DepthNoise(sigma_base=0.0, sigma_slope=0.0).apply(depth, np.random.default_rng(3))
    assert set(np.unique(noisy)) <= {np.float32(1.0), np.float32(1.5)}


def test_bias_is_smooth_has_its_amplitude_and_must_be_shared():
    noise = DepthNoise(sigma_base=0.0, sigma_slope=0.0, jitter=0.0, bias_amplitude=0.005, bias_length=10)
    field = noise.bias_field((400, 400), np.random.default_rng(0))
    assert field.std() == pytest.approx(1, rel=0.1)
    assert np.abs(np.diff(field, axis=0)).max() < 0.8
    depth = np.full((400, 400), 1.0, np.float32)
    np.testing.assert_allclose(noise.apply(depth, np.random.default_rng(0), field) - 1, 0.005 * field, atol=1e-6)
    with pytest.raises(InvalidInput, match="bias"):
        noise.apply(depth, np.random.default_rng(0))


def test_illegal_parameters_are_refused():
    with pytest.raises(InvalidInput, match="jitter"):
        DepthNoise(jitter=-1.0)
    with pytest.raises(InvalidInput, match="bias_length"):
        DepthNoise(bias_length=0.5)
    with pytest.raises(InvalidInput, match="depth"):
        DepthNoise().apply(np.zeros(4), np.random.default_rng(0))


def test_flying_pixels_lie_between_both_sides_of_an_edge_only():
    depth = np.full((200, 40), 1.0, np.float32)
    depth[:, 20:] = 1.5
    noise = DepthNoise(sigma_base=0.0, sigma_slope=0.0, jitter=0.0, flying_fraction=0.5)
    flown = noise.apply(depth, np.random.default_rng(0))
    between = (flown > 1.001) & (flown < 1.499)
    assert not between[:, :19].any()
    assert not between[:, 21:].any()
    assert between[:, 19:21].mean() == pytest.approx(0.5, abs=0.08)  # of 400 pixels


def test_the_kinect_s_bias_keeps_within_the_maker_s_bound():
    noise, depth = DepthNoise.azure_kinect(), np.full((576, 640), 2.0, np.float32)
    quiet = DepthNoise(0.0, 0.0, jitter=0.0, bias_amplitude=noise.bias_amplitude, bias_relative=noise.bias_relative)
    errors = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        errors.append(quiet.apply(depth, rng, quiet.bias_field(depth.shape, rng))[::40, ::40] - 2)
    inside = np.abs(errors) < 0.011 + 0.001 * 2
    assert inside.mean() == pytest.approx(0.954, abs=0.03)  # two standard deviations
    assert not noise.without_bias().has_bias


def test_a_bias_of_another_camera_is_refused_and_far_depths_are_none():
    depth, rng = np.full((30, 40), 1.0, np.float32), np.random.default_rng(0)
    for noise, other in ((DepthNoise(), StereoNoise.d435()), (StereoNoise.d435(), DepthNoise())):
        with pytest.raises(InvalidInput, match=r"bias; got shape .*; expected a field"):
            noise.apply(depth, rng, other.bias_field(depth.shape, rng))
    depth[0, 0] = np.inf
    assert DepthNoise().apply(depth, rng)[0, 0] == 0
