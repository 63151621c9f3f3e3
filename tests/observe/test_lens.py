"""The lens against OpenCV's published formula, written here once more without the package, and against itself."""

import numpy as np
import pytest

from torchcloth.errors import InvalidInput
from torchcloth.observe import DepthCamera, Lens, render_depth, to_points

KINECT = DepthCamera.azure_kinect_nfov(np.eye(4))
LENSES = {
    "none": (),
    "brown-conrady 4": (-0.28, 0.07, 1e-3, -2e-3),
    "brown-conrady 5": (-0.30, 0.10, 1e-3, -5e-4, -0.02),
    "rational 8": tuple(KINECT.distortion),
    "thin prism 12": (*KINECT.distortion, 2e-3, -1e-3, 1e-3, 5e-4),
    "tilted 14": (*KINECT.distortion, 2e-3, -1e-3, 1e-3, 5e-4, 0.03, -0.02),
}
OPENCV = {  # px; cv2.projectPoints of OpenCV 5.0.0 with f = 500, centre (320, 240), for the points of the test below
    "brown-conrady 5": [
        [369.224875, 141.55025],
        [543.080395, 418.75131600000003],
        [123.45398181249999, 480.32110556250007],
    ],
    "rational 8": [
        [369.19138716921344, 141.62356371682307],
        [541.5801963267528, 417.2450557456523],
        [125.40264873809784, 477.8809043480165],
    ],
    "thin prism 12": [
        [369.2401371692134, 141.6491887168231],
        [541.9061463267528, 417.4920807456523],
        [125.78013623809784, 478.19716059801647],
    ],
    "tilted 14": [
        [369.05709118109274, 142.01973587784445],
        [546.3725291557515, 421.24566292564873],
        [124.46585755566764, 479.75165691079246],
    ],
}


def opencv(x, y, coefficients):
    """Of "Detailed Description" in OpenCV's calib3d, term by term."""
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, tx, ty = (*coefficients, *[0.0] * (14 - len(coefficients)))
    r = np.hypot(x, y)
    radial = (1 + k1 * r**2 + k2 * r**4 + k3 * r**6) / (1 + k4 * r**2 + k5 * r**4 + k6 * r**6)
    u = x * radial + 2 * p1 * x * y + p2 * (r**2 + 2 * x**2) + s1 * r**2 + s2 * r**4
    v = y * radial + p1 * (r**2 + 2 * y**2) + 2 * p2 * x * y + s3 * r**2 + s4 * r**4
    c, s = np.cos, np.sin
    R = np.array(
        [
            [c(ty), s(ty) * s(tx), -s(ty) * c(tx)],
            [0, c(tx), s(tx)],
            [s(ty), -c(ty) * s(tx), c(ty) * c(tx)],
        ]
    )
    keep = np.array([[R[2, 2], 0, -R[0, 2]], [0, R[2, 2], -R[1, 2]], [0, 0, 1]])
    a, b, w = keep @ R @ np.stack([u, v, np.ones_like(u)])
    return np.stack([a / w, b / w], -1)


@pytest.fixture(params=LENSES)
def coefficients(request):
    return LENSES[request.param]


@pytest.fixture
def rays():
    return np.random.default_rng(0).uniform(-0.55, 0.55, (2000, 2))


def test_it_is_the_published_formula(coefficients, rays):
    np.testing.assert_allclose(Lens(coefficients).distort(rays), opencv(*rays.T, coefficients), atol=1e-14)


def test_there_and_back_is_the_same_ray(coefficients, rays):
    lens = Lens(coefficients)
    np.testing.assert_allclose(lens.undistort(lens.distort(rays)), rays, atol=1e-9)


def test_opencv_s_own_numbers():
    points = np.array([[0.1, -0.2], [0.5, 0.4], [-0.45, 0.55]])
    for name, expected in OPENCV.items():
        np.testing.assert_allclose(500 * Lens(LENSES[name]).distort(points) + [320, 240], expected, atol=1e-9)


def test_every_pixel_of_the_kinect_and_back():
    pixels = np.stack(np.meshgrid(np.arange(640.0), np.arange(576.0)), -1)
    back, _ = KINECT.project(KINECT.unproject(pixels, np.full((576, 640), 1.3)))
    assert np.abs(back - pixels).max() < 1e-6  # nowhere NaN: the lens model covers the image


def test_the_kinect_s_field_of_view_is_the_maker_s_75_by_65_degrees():
    across = np.rad2deg(np.arctan(KINECT.pixel_rays[328, [0, -1], 0]))
    down = np.rad2deg(np.arctan(KINECT.pixel_rays[[0, -1], 321, 1]))
    # this device's image is 73.1 by 65.7 degrees along its axes; without the lens it would be 64.8 by 59.2
    assert np.ptp(across) == pytest.approx(75, abs=2)
    assert np.ptp(down) == pytest.approx(65, abs=2)


def test_where_the_image_folds_back_there_is_no_ray():
    lens = Lens((-0.3, 0.0, 0.0, 0.0))  # r (1 - 0.3 r^2) turns at r = 1.054, where it is 0.703
    turn = np.sqrt(1 / 0.9)
    assert lens.max_radius == pytest.approx(turn, abs=2.6e-3)  # one sample
    inner, outer = lens.distort(np.array([[1.0, 0.0], [1.2, 0.0]]))
    np.testing.assert_allclose(inner, [0.7, 0.0])
    assert np.isnan(outer).all()  # it falls at 0.68, where a ray at 0.93 falls too
    rays = lens.undistort(np.array([[0.7, 0.0], [0.71, 0.0], [0.5, 0.5001]]))
    np.testing.assert_allclose(rays[0], [1.0, 0.0])
    assert np.isnan(rays[1:]).all()


def test_pixels_without_a_ray_give_no_points_and_see_nothing(render, rectangle):
    camera = DepthCamera(
        200, 100, np.array([[80.0, 0, 99.5], [0, 80, 49.5], [0, 0, 1]]), np.eye(4), distortion=[-0.3, 0, 0, 0]
    )
    blind = np.isnan(camera.pixel_rays[..., 0])
    assert 0.3 < blind.mean() < 0.6
    depth, ids = render_depth(camera, [rectangle(-5, 5, -5, 5, 1.0)])
    np.testing.assert_array_equal(depth == 0, blind)
    np.testing.assert_array_equal(ids == -1, blind)
    points = to_points(camera, np.ones((100, 200)))
    assert len(points) == (~blind).sum()
    assert np.isfinite(points).all()


def test_a_distorted_image_of_a_plane_is_the_plane(render, rectangle):
    depth, _ = render(KINECT, [rectangle(-5, 5, -5, 5, 1.5, tilt=0.4)])
    points = to_points(KINECT, depth)
    assert len(points) == 640 * 576
    np.testing.assert_allclose(points[:, 2], 1.5 + 0.4 * points[:, 0], atol=2e-4)


@pytest.mark.parametrize("bad", [(1.0,), (0.1,) * 6, (np.nan, 0, 0, 0)])
def test_impossible_coefficients_are_refused(bad):
    with pytest.raises(InvalidInput, match="distortion"):
        DepthCamera(4, 3, np.eye(3), np.eye(4), distortion=bad)
