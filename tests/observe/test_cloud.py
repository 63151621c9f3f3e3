import numpy as np
import pytest

from torchcloth.errors import InvalidInput
from torchcloth.observe import (
    DepthCamera,
    DepthNoise,
    erode,
    look_at,
    thin_to_count,
    thin_to_spacing,
    to_points,
)

CAMERA = DepthCamera.azure_kinect_nfov(look_at([1.2, 0.3, 0.8], [0.3, 0.0, 0.2]))


def test_points_project_back_to_their_pixels_and_depths():
    rng = np.random.default_rng(0)
    depth = np.where(rng.random((576, 640)) < 0.01, rng.uniform(0.5, 3.0, (576, 640)), 0.0)
    mask = rng.random((576, 640)) < 0.5
    pixels, z = CAMERA.project(to_points(CAMERA, depth, mask))
    rows, columns = np.nonzero((depth > 0) & mask)
    np.testing.assert_allclose(pixels, np.stack([columns, rows], 1), atol=1e-8)
    np.testing.assert_allclose(z, depth[rows, columns], atol=1e-12)


def test_too_far_is_no_place():
    """Where nothing came back ROS writes infinity (REP 118), or NaN."""
    depth = np.zeros((576, 640))
    depth[300, 300:303] = 1.0, np.inf, np.nan
    pixels, _ = CAMERA.project(to_points(CAMERA, depth))
    np.testing.assert_allclose(pixels, [[300, 300]], atol=1e-8)


def test_points_that_are_nowhere_are_in_no_cube():
    points = np.array([[np.nan] * 3, [0.0, 0, 0], [0, np.inf, 0], [0.001, 0, 0], [0.5, 0, 0]])
    np.testing.assert_array_equal(thin_to_spacing(points, 0.01), points[[1, 4]])
    assert thin_to_spacing(points[:1], 0.01).shape == (0, 3)


def test_noise_moves_points_along_their_rays_only():
    depth = np.full((576, 640), 1.1, np.float32)
    noisy = DepthNoise(jitter=0.0).apply(depth, np.random.default_rng(0))
    pixels, _ = CAMERA.project(to_points(CAMERA, noisy))
    assert np.abs(pixels - np.rint(pixels)).max() < 1e-8


def test_images_of_another_size_are_refused():
    with pytest.raises(InvalidInput, match="depth"):
        to_points(CAMERA, np.ones((640, 576)))
    with pytest.raises(InvalidInput, match="mask"):
        to_points(CAMERA, np.ones((576, 640)), np.ones((2, 2), bool))


def test_erosion_takes_the_rim_and_leaves_the_image_border():
    mask = np.zeros((9, 9), bool)
    mask[2:7, 2:] = True
    assert erode(mask, 1).sum() == 3 * 6
    assert erode(mask, 2)[4, 4:].all()
    assert erode(mask, 2).sum() == 5
    np.testing.assert_array_equal(erode(mask, 0), mask)


def test_thinning_to_a_count_keeps_measured_points():
    points = np.random.default_rng(0).standard_normal((500, 3))
    few = thin_to_count(points, 60, np.random.default_rng(1))
    assert few.shape == (60, 3)
    assert set(map(tuple, few)) <= set(map(tuple, points))
    assert len(set(map(tuple, few))) == 60
    np.testing.assert_array_equal(few, thin_to_count(points, 60, np.random.default_rng(1)))
    assert thin_to_count(points, 900, np.random.default_rng(1)) is points
    with pytest.raises(InvalidInput, match="count"):
        thin_to_count(points, 0, np.random.default_rng(1))


def test_thinning_to_a_spacing_keeps_one_measured_point_per_cube():
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (4000, 3))
    few = thin_to_spacing(points, 0.02)
    cubes = np.floor(few / 0.02)
    assert len(np.unique(cubes, axis=0)) == len(few) == len(np.unique(np.floor(points / 0.02), axis=0))
    assert set(map(tuple, few)) <= set(map(tuple, points))
    assert len(thin_to_spacing(np.zeros((0, 3)), 0.1)) == 0
    with pytest.raises(InvalidInput, match="spacing"):
        thin_to_spacing(points, 0.0)


def test_whole_numbers_are_no_metres():
    with pytest.raises(InvalidInput, match=r"depth; got whole numbers \(uint16\); expected metres.*0.001"):
        to_points(CAMERA, np.full((576, 640), 800, np.uint16))
