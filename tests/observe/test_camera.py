import numpy as np
import pytest

from torchcloth import recordings
from torchcloth.errors import InvalidInput
from torchcloth.observe import DepthCamera, look_at


@pytest.fixture
def camera():
    return DepthCamera.azure_kinect_nfov(look_at([1.5, 0.4, 0.6], [0.5, 0.0, 0.3]))


def test_projecting_what_was_unprojected_returns_the_pixel(camera):
    rng = np.random.default_rng(0)
    pixels, depth = rng.uniform([0, 0], [639, 575], (50, 2)), rng.uniform(0.5, 3.8, 50)
    back, z = camera.project(camera.unproject(pixels, depth))
    np.testing.assert_allclose(back, pixels, atol=1e-9)  # rounding only
    np.testing.assert_allclose(z, depth, atol=1e-12)


def test_the_target_is_seen_at_the_principal_point_and_up_is_up(camera):
    pixel, depth = camera.project([0.5, 0.0, 0.3])
    np.testing.assert_allclose(pixel, camera.K[:2, 2], atol=1e-9)
    assert depth == pytest.approx(np.linalg.norm([1.0, 0.4, 0.3]))
    assert camera.project([0.5, 0.0, 0.4])[0][1] < 328.5  # rows count downwards
    assert camera.project([0.5, 0.1, 0.3])[0][0] > 321.0  # seen from +x, +y is on the right


def test_a_ray_s_parameter_is_its_depth(camera):
    origin, directions = camera.rays()
    assert directions.shape == (576, 640, 3)
    np.testing.assert_allclose(origin + 1.7 * directions[100, 200], camera.unproject([200, 100], 1.7), atol=1e-12)


def test_the_d435_s_field_of_view_is_the_maker_s():
    # datasheet: 87 +- 3 by 58 +- 1 degrees; the device whose numbers these are says 89.97 across
    camera = DepthCamera.realsense_d435(np.eye(4))
    across, down = (np.rad2deg(2 * np.arctan(size / 2 / 424.229)) for size in (848, 480))
    assert across == pytest.approx(89.97, abs=0.01)
    assert down == pytest.approx(58, abs=1.1)
    assert (camera.width, camera.height, camera.range) == (848, 480, (0.2, 10.0))


def test_a_recorded_camera_and_back(camera):
    recorded = recordings.Camera(**camera.to_calibration(), depth_scale=0.001)
    again = DepthCamera.from_recording(recorded, camera.range)
    np.testing.assert_array_equal(again.pixel_rays, camera.pixel_rays)
    points = np.random.default_rng(0).uniform(-0.3, 0.3, (20, 3))
    np.testing.assert_array_equal(again.project(points)[0], camera.project(points)[0])
    assert again.range == (0.5, 3.86)
    assert camera.without_distortion().lens.is_identity


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"width": 0}, "camera size"),
        ({"K": np.diag([500.0, -500.0, 1.0])}, "K"),
        ({"T_world_camera": np.diag([1.0, 1.0, -1.0, 1.0])}, "T_world_camera"),
        ({"T_world_camera": np.eye(3)}, "T_world_camera"),
        ({"range": (2.0, 1.0)}, "range"),
    ],
)
def test_an_impossible_camera_is_refused(change, message):
    good = {"width": 4, "height": 3, "K": np.diag([500.0, 500.0, 1.0]), "T_world_camera": np.eye(4)}
    with pytest.raises(InvalidInput, match=message):
        DepthCamera(**{**good, **change})


def test_looking_along_up_is_refused():
    with pytest.raises(InvalidInput, match="target"):
        look_at([0, 0, 1], [0, 0, 0])
    for eye in ([np.nan, 0, 1], [np.inf, 0, 1]):
        with pytest.raises(InvalidInput, match="target"):
            look_at(eye, [0, 0, 0])
    assert look_at([0, 0, 1], [0, 0, 0], up=[1, 0, 0])[2, 2] == -1
