"""The pose of a camera, from an arm in its view."""

import numpy as np
import pytest
from helpers.arm_view import write_arm_view

from torchcloth import observe
from torchcloth import recordings as rec
from torchcloth.cli import main
from torchcloth.errors import InvalidInput
from torchcloth.observe.camera_pose_search import find_moving_points, search_starts

pytest.importorskip("pytorch_kinematics")
pytestmark = pytest.mark.usefixtures("needs_open3d")


@pytest.fixture(scope="module")
def make_view(needs_open3d):
    from torchcloth.training.studies import camera

    return camera.make_view


@pytest.fixture(scope="module")
def view(make_view):
    return make_view("kinect", 3, shrink=4)


def solve(view, **options) -> observe.CameraPose:
    return observe.find_camera_pose(view.camera, view.depths, view.arm, view.arm_std, **options)


@pytest.mark.slow
def test_a_pose_and_a_lag_are_found_without_a_start(view):
    """With noise, encoders that are off, a cloth in the gripper and a table."""
    pose = solve(view)
    off = pose.compare(view.camera.T_world_camera)
    assert np.linalg.norm(off[:3]) < 0.02
    assert np.linalg.norm(off[3:]) < np.deg2rad(0.8)
    assert off @ np.linalg.solve(pose.covariance, off) < 40
    assert pose.is_determined
    assert pose.arm[0] == pytest.approx(view.lag, abs=0.005)


@pytest.mark.slow
def test_the_start_is_near(view):
    """What moves in the images is the arm and the cloth that it holds."""
    clouds = find_moving_points(view.camera, view.depths)
    starts = search_starts(clouds, view.arm(np.zeros(8)), None)
    off = [observe.CameraPose(T, *7 * [None]).compare(view.camera.T_world_camera) for T in starts]
    assert min(np.linalg.norm(x[3:]) for x in off) < 0.4


def test_an_arm_that_stands_still_gives_no_pose(make_view):
    view = make_view("kinect", 5, has_faults=False, shrink=8, amplitude=0.0)
    with pytest.raises(InvalidInput, match=r"motion of the arm; got next to none; .* in its view"):
        solve(view, start=view.camera.T_world_camera)


def test_a_camera_that_does_not_see_the_arm_gives_no_pose(make_view):
    """Its images show a wall."""
    view = make_view("kinect", 5, has_faults=False, shrink=8)
    wall = view._replace(depths=np.full_like(view.depths, 1.5))
    with pytest.raises(InvalidInput, match=r"0 images in which something moves; .* 3 images or more"):
        solve(wall)


def test_images_in_millimetres_are_refused(view):
    with pytest.raises(InvalidInput, match=r"depths; got uint16 .* in metres"):
        solve(view._replace(depths=(1000 * view.depths).astype(np.uint16)))


@pytest.fixture
def folder(tmp_path):
    """An episode whose camera is 6 cm from where it says, and its true pose."""
    return write_arm_view(tmp_path / "guessed")


@pytest.mark.slow
def test_convert_writes_the_pose(folder, tmp_path, capsys):
    episode, truth = folder
    assert main(["convert", str(episode), str(tmp_path / "placed"), "--camera-from-arm", "cam0"]) == 0
    text = capsys.readouterr().out
    assert "cam0: pose from the arm, to " in text
    assert "degrees off, more than errors explain" in text
    pose = rec.read(tmp_path / "placed").cameras["cam0"].T_world_camera
    np.testing.assert_allclose(pose, truth, atol=5e-3)


def test_a_camera_of_another_name_is_refused(folder, tmp_path, capsys):
    episode, _ = folder
    for verb in (["convert", str(episode), str(tmp_path / "placed")], ["inspect", str(episode)]):
        assert main([*verb, "--camera-from-arm", "cam7"]) == 2
        assert capsys.readouterr().err == "torchcloth: camera; got 'cam7'; expected one of cam0\n"
    assert not (tmp_path / "placed").exists()
