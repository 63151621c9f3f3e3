import numpy as np
import pytest

from torchcloth.errors import InvalidInput
from torchcloth.observe import DepthCamera, look_at, mask_steep_pixels, reproject, sample_colors, to_points

POSE = look_at([1.2, 0.3, 0.8], [0.4, 0.0, 0.2])
KINECT = DepthCamera.azure_kinect_nfov(POSE)


@pytest.fixture
def color_camera():
    """Beside the depth camera, with a lens of its own."""
    pose = POSE.copy()
    pose[:3, 3] += pose[:3, :3] @ [0.05, 0.01, 0.0]
    K = np.array([[300.0, 0, 319.5], [0, 300, 179.5], [0, 0, 1]])
    return DepthCamera(640, 360, K, pose, distortion=[0.1, -0.05, 1e-3, -5e-4, 0.01])


@pytest.fixture
def meshes(rectangle):
    """A wall and a smaller sheet before it, in the world."""

    def placed(vertices, faces):
        return vertices @ POSE[:3, :3].T + POSE[:3, 3], faces

    return [placed(*rectangle(-0.15, 0.1, -0.1, 0.15, 0.8, 0.1)), placed(*rectangle(-3, 3, -3, 3, 1.3, 0.2))]


def agree(result, true, edge=0.02):
    """Share of the pixels away from edges at which both see, and the largest error there."""
    both = (result > 0) & (true > 0) & ~mask_steep_pixels(true, edge)
    error = np.abs(result - true)[both]
    return both.sum() / ((true > 0) & ~mask_steep_pixels(true, edge)).sum(), error


def test_without_its_lens_the_image_is_that_of_an_ideal_camera(render, meshes):
    rectified = KINECT.without_distortion()
    result = reproject(render(KINECT, meshes)[0], KINECT, rectified)
    share, error = agree(result, render(rectified, meshes)[0])
    assert share > 0.97
    assert np.quantile(error, 0.99) < 2e-4
    assert error.max() < 5e-3


def test_too_far_is_seen_by_nobody(render, rectangle):
    camera = DepthCamera(40, 30, np.array([[50.0, 0, 19.5], [0, 50, 14.5], [0, 0, 1]]), np.eye(4))
    depth = render(camera, [rectangle(-0.1, 0.1, -0.1, 0.1, 0.8)])[0]
    far = np.where(depth > 0, depth, np.inf)
    np.testing.assert_array_equal(reproject(far, camera, camera), reproject(depth, camera, camera))
    assert not mask_steep_pixels(far, 0.02).any()


def test_depth_laid_onto_colour_is_what_the_colour_camera_would_have_seen(render, meshes, color_camera):
    result = reproject(render(KINECT, meshes)[0], KINECT, color_camera)
    true = render(color_camera, meshes)[0]
    # only where the depth camera looks
    here = (color_camera.height, color_camera.width)
    points = color_camera.unproject_pixels(*(i.ravel() for i in np.indices(here)), true.ravel())
    pixels, _ = KINECT.project(points)
    inside = ((pixels > 2) & (pixels < [637, 573])).all(-1).reshape(here)
    share, error = agree(result, np.where(inside, true, 0))
    assert share > 0.9  # the near sheet hides the wall from one of the two
    assert np.quantile(error, 0.99) < 2e-4


def test_points_take_the_colour_of_their_body_and_hidden_ones_take_none(render, meshes, color_camera):
    ids = render(color_camera, meshes)[1]
    color = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 0]], np.uint8)[ids]
    depth, truth = render(KINECT, meshes)
    registered = reproject(depth, KINECT, color_camera)
    points = to_points(KINECT, depth)
    body = truth[depth > 0]
    colors, seen = sample_colors(points, color, color_camera, registered)
    away = ~mask_steep_pixels(depth, 0.02)[depth > 0]
    right = colors[np.arange(len(points)), body] == 255
    assert right[seen & away].mean() > 0.995
    blind, _ = sample_colors(points, color, color_camera)
    hidden = ~seen & (blind[:, 0] == 255) & (body == 1)  # wall behind the sheet, which would have been red
    assert hidden.sum() > 100
    assert 0.5 < seen.mean() < 1


def test_images_of_another_size_are_refused(color_camera):
    with pytest.raises(InvalidInput, match="depth"):
        reproject(np.zeros((4, 4)), KINECT, color_camera)
    with pytest.raises(InvalidInput, match="color"):
        sample_colors(np.zeros((4, 3)), np.zeros((4, 4, 3)), color_camera)
    color = np.zeros((color_camera.height, color_camera.width, 3), np.uint8)
    with pytest.raises(InvalidInput, match=r"color; got float64; expected uint8"):
        sample_colors(np.zeros((4, 3)), color / 255, color_camera)
    with pytest.raises(InvalidInput, match=r"depth; .*registered"):  # that of the depth camera
        sample_colors(np.zeros((4, 3)), color, color_camera, np.zeros((KINECT.height, KINECT.width)))


@pytest.mark.parametrize("nothing", [0.0, np.nan])
def test_pixels_without_a_reading_hide_nothing(color_camera, nothing):
    color = np.full((color_camera.height, color_camera.width, 3), 7, np.uint8)
    point = color_camera.unproject_pixels(
        np.array([color_camera.height // 2]), np.array([color_camera.width // 2]), [1.0]
    )
    depth = np.full(color.shape[:2], nothing)
    assert sample_colors(point, color, color_camera, depth)[1].all()
    assert not sample_colors(point, color, color_camera, np.full(color.shape[:2], 0.5))[1].any()


def test_steps_in_depth_are_steep_and_gentle_slopes_are_not():
    depth = (1 + 0.003 * np.arange(30))[None].repeat(20, 0)
    assert not mask_steep_pixels(depth, 0.02).any()
    depth[:, 15:] += 0.1
    assert mask_steep_pixels(depth, 0.02)[:, 14:16].all()
    assert mask_steep_pixels(depth, 0.02).sum() == 40
    depth[:, 15:] = 0
    assert not mask_steep_pixels(depth, 0.02).any()
