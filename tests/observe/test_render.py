import importlib

import numpy as np
import pytest

from torchcloth.errors import InvalidInput, MissingDependency
from torchcloth.observe import DepthCamera, build_solid_mesh, look_at, render_depth, to_points

KINECT = DepthCamera.azure_kinect_nfov(np.eye(4))


def test_a_plane_has_its_depth_at_every_pixel(render, rectangle):
    depth, ids = render(KINECT, [rectangle(-5, 5, -5, 5, 1.25)])
    assert depth.shape == ids.shape == (576, 640)
    assert (ids == 0).all()
    np.testing.assert_allclose(depth, 1.25, atol=1e-4)


def test_a_tilted_plane_has_the_depth_of_the_ray_plane_intersection(render, rectangle):
    camera = KINECT.without_distortion()
    depth, _ = render(camera, [rectangle(-5, 5, -5, 5, 1.5, tilt=0.4)])
    slope = (np.arange(640) - camera.K[0, 2]) / camera.K[0, 0]
    expected = 1.5 / (1 - 0.4 * slope)  # z = 1.5 + 0.4 x with x = slope z
    np.testing.assert_allclose(depth, np.broadcast_to(expected, depth.shape), atol=1e-4)


def test_a_world_pose_and_both_sides(render):
    camera = DepthCamera.azure_kinect_nfov(look_at([2.0, 0.5, 1.0], [0.5, 0.0, 0.3]))
    sheet = np.array([[0.5, -0.2, 0.1], [0.5, 0.2, 0.1], [0.5, 0.2, 0.5], [0.5, -0.2, 0.5]])
    for faces in ([[0, 1, 2], [0, 2, 3]], [[0, 2, 1], [0, 3, 2]]):
        depth, ids = render(camera, [(sheet, np.array(faces))])
        points = to_points(camera, depth, ids == 0)
        assert len(points) > 5000
        np.testing.assert_allclose(points[:, 0], 0.5, atol=1e-4)
        assert points[:, 1].min() == pytest.approx(-0.2, abs=0.004)  # a pixel is 3 mm there
        assert points[:, 2].max() == pytest.approx(0.5, abs=0.004)


def test_an_occluder_takes_points_away_and_is_named(render, rectangle):
    sheet, box = rectangle(-0.3, 0.3, -0.3, 0.3, 1.5), build_solid_mesh("box", (0.1, 0.1, 0.1), _at(0, 0, 1.0))
    free = render(KINECT, [sheet])[1] == 0
    depth, ids = render(KINECT, [sheet, box])
    assert (ids == 1).any()
    assert (free & (ids == 1)).sum() == free.sum() - (ids == 0).sum()
    assert depth[ids == 1].min() == pytest.approx(0.95, abs=1e-4)  # its front face
    assert ids[0, 0] == -1
    assert depth[0, 0] == 0


def test_out_of_range_is_not_seen_but_hides(render, rectangle):
    near, far = rectangle(-0.05, 0.05, -0.05, 0.05, 0.3), rectangle(-0.2, 0.2, -0.2, 0.2, 1.0)
    depth, ids = render(KINECT, [near, far, rectangle(-9, 9, -9, 9, 5.0)])
    assert not (ids == 0).any()
    assert not (ids == 2).any()
    assert ids[329, 322] == -1  # behind the near one
    np.testing.assert_allclose(depth[ids == 1], 1.0, atol=1e-4)


def test_no_mesh_and_bad_meshes(render):
    depth, ids = render(KINECT, [])
    assert not depth.any()
    assert (ids == -1).all()
    triangle = np.array([[0, 0, 1], [1, 0, 1], [0, 1, 1.0]])
    for vertices, faces in (
        (triangle[:, :2], [[0, 1, 2]]),
        (triangle, [[0, 1, 3]]),
        (triangle * np.nan, [[0, 1, 2]]),
    ):
        with pytest.raises(InvalidInput, match=r"meshes\[0\]"):
            render(KINECT, [(vertices, np.array(faces))])


def test_missing_open3d_says_how_to_install(monkeypatch):
    def missing(name):
        raise ImportError("libusb-1.0.so.0: cannot open shared object file")

    monkeypatch.setattr(importlib.import_module("torchcloth.observe.render"), "import_module", missing)
    with pytest.raises(MissingDependency, match=r"torchcloth\[observe\].*libusb-1\.0-0"):
        render_depth(KINECT, [])


def _at(x, y, z):
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    return pose
