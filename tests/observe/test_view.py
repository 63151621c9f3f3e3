import numpy as np
import pytest

from torchcloth.errors import InvalidInput
from torchcloth.observe import (
    DepthCamera,
    DepthNoise,
    StereoNoise,
    View,
    build_solid_mesh,
    build_solid_meshes,
    capture,
    decode_depth,
    encode_depth,
)

KINECT = DepthCamera.azure_kinect_nfov(np.eye(4))
D435 = DepthCamera.realsense_d435(np.eye(4))


class Solid:
    kind = "box"
    size = (0.1, 0.1, 0.1)

    def __init__(self, *heights):
        self.pose = np.tile(np.eye(4), (len(heights), 1, 1))
        self.pose[:, 2, 3] = heights


@pytest.mark.parametrize(
    ("camera", "noise"), [(KINECT, DepthNoise.azure_kinect()), (D435, StereoNoise.d435())], ids=["kinect", "d435"]
)
def test_points_are_the_cloth_s_within_the_noise(render, rectangle, camera, noise):
    sheet = rectangle(-0.2, 0.2, -0.2, 0.2, 1.2)
    view = View(camera, noise.without_bias(), mask_erosion=3)
    alone = capture(view, *sheet, rng=np.random.default_rng(0))
    hidden = capture(view, *sheet, build_solid_meshes([Solid(0.8)], at=0), rng=np.random.default_rng(0))
    assert hidden.depth.shape == hidden.mask.shape == (camera.height, camera.width)
    assert hidden.depth.dtype == np.float32
    assert 0.5 < len(hidden.points) / len(alone.points) < 0.95
    error = alone.points[:, 2] - 1.2
    inner = np.abs(alone.points[:, :2]).max(1) < 0.17  # flying pixels and fattened edges aside
    assert error[inner].std() == pytest.approx(noise.sigma(1.2), rel=0.1)
    assert hidden.depth[hidden.depth > 0].min() < 0.8  # the box is in the image
    assert np.mean(hidden.points[:, 2] < 1.1) < 1e-3  # but not in the points, bar its fattened corners


def test_a_device_keeps_its_bias(render, rectangle):
    sheet, rng = rectangle(-0.5, 0.5, -0.5, 0.5, 1.0), np.random.default_rng(0)
    with pytest.raises(InvalidInput, match="bias"):
        capture(View(D435, StereoNoise.d435()), *sheet, rng=rng)
    view = View(D435, StereoNoise.d435()).with_bias(rng)
    first, second = (capture(view, *sheet, rng=rng).points[:, 2].mean() for _ in range(2))
    assert first == pytest.approx(second, abs=2e-4)
    other = capture(View(D435, StereoNoise.d435()).with_bias(rng), *sheet, rng=rng).points[:, 2].mean()
    assert abs(first - other) > 1e-3
    assert View(D435).with_bias(rng).bias is None


def test_an_ideal_sensor_and_few_points(render, rectangle):
    view = View(KINECT, max_points=50)
    seen = capture(view, *rectangle(-0.2, 0.2, -0.2, 0.2, 1.2), rng=np.random.default_rng(0))
    assert len(seen.points) == 50
    np.testing.assert_allclose(seen.points[:, 2], 1.2, atol=1e-4)


def test_solids_of_a_moment():
    solids = [Solid(0.5, 0.9)]
    for k, height in enumerate((0.5, 0.9)):
        pose = np.eye(4)
        pose[2, 3] = height
        np.testing.assert_array_equal(
            build_solid_meshes(solids, at=k)[0][0], build_solid_mesh("box", Solid.size, pose)[0]
        )


def test_stored_and_read_again():
    depth = np.array([[0.0, 0.5004, 1.2345], [65.5, 70.0, np.nan]])
    image = encode_depth(depth)
    assert image.dtype == np.uint16
    np.testing.assert_array_equal(image, [[0, 500, 1234], [65500, 0, 0]])
    np.testing.assert_allclose(decode_depth(image)[0], [0, 0.5, 1.234], atol=1e-6)
    np.testing.assert_allclose(decode_depth(encode_depth(depth, 1e-4), 1e-4)[0], [0, 0.5004, 1.2345], atol=6e-5)
    with pytest.raises(InvalidInput, match="depth_scale"):
        encode_depth(depth, 0.0)
    with pytest.raises(InvalidInput, match="whole numbers"):
        encode_depth(np.full((4, 4), 800, np.uint16))
