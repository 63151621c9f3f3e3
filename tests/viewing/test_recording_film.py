"""A recording as a film: clocks, places, and what is not there."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.rich_recording import make_recording
from PIL import Image

from torchcloth import recordings as rec
from torchcloth import robots
from torchcloth.errors import RecordingError
from torchcloth.viewing import film_from_recording
from torchcloth.viewing.film import posed_vertices


@pytest.fixture
def rich(tmp_path) -> rec.Recording:
    """Every stream there is; observations run 10 ms behind the motion's clock."""
    return make_recording(tmp_path)


def test_frames_are_the_points_on_the_motions_clock(rich):
    film = film_from_recording(rich)
    assert film.times == pytest.approx(rich.points.t + 0.01)
    for i in range(3):
        np.testing.assert_allclose(film.clouds["points"].frames[i], rich.points.frame(i), atol=1e-6)


def test_markers_that_were_not_seen_are_not_shown(rich):
    drawn = film_from_recording(rich).clouds["markers"].frames
    assert [len(frame) for frame in drawn] == [2, 1, 2]
    np.testing.assert_allclose(drawn[1][0], rich.markers.xyz[1, 1], atol=1e-6)


def test_an_arm_with_other_joints_than_were_recorded_is_a_note(rich):
    name = next(name for name in rich.joints if name in rich.robots)
    fewer = replace(rich.joints[name], q=rich.joints[name].q[:, :-1])
    film = film_from_recording(replace(rich, joints={name: fewer}))
    assert not any(part.startswith(f"arms/{name}") for part in film.solids)
    assert any(f"arm {name!r} is not drawn: q has the wrong shape or type; got" in note for note in film.notes)


def test_what_was_seen_at_another_time_is_not_shown(rich):
    late = replace(rich, markers=replace(rich.markers, t=rich.markers.t + 5.0))
    assert [len(frame) for frame in film_from_recording(late).clouds["markers"].frames] == [0, 0, 0]


def test_a_slower_stream_is_shown_all_the_time(rich):
    """Markers five times as seldom as points: each frame has the nearest of them."""
    t = np.linspace(0.1, 0.5, 21)
    points = rec.PointClouds(t, np.zeros((21, 3)), np.ones(21, int))
    slow = replace(rich, points=points, markers=replace(rich.markers, t=np.array([0.1, 0.2, 0.3, 0.4])))
    assert [len(frame) for frame in film_from_recording(slow).clouds["markers"].frames][:18] == [2] * 3 + [1] * 5 + [
        2
    ] * 10


def depth_only(tmp_path, rich):
    """A camera 1 m above a level floor at z = 0.25 m, on which a box of 0.1 m stands; its left half is masked out."""
    T = np.diag([1.0, -1, -1, 1])
    T[2, 3] = 1.25
    depth = np.full((120, 160), 1000, np.uint16)
    depth[40:80, 60:100] = 900
    mask = np.zeros((120, 160), np.uint8)
    mask[:, 80:] = 255
    streams = {}
    for kind, image in (("depth", depth), ("mask", mask)):
        Image.fromarray(image).save(tmp_path / f"{kind}.png")
        paths = (tmp_path / f"{kind}.png",) * 2
        streams[kind] = rec.ImageStream(kind, np.arange(2), np.array([0.1, 0.2]), paths, (160, 120))
    K = np.array([[150.0, 0, 79.5], [0, 150, 59.5], [0, 0, 1]])
    camera = rec.Camera(width=160, height=120, K=K, T_world_camera=T, depth_scale=0.001, **streams)
    return replace(rich, points=None, markers=None, joints={}, cameras={"cam0": camera})


def test_depth_is_shown_where_there_is_nothing_else(rich, tmp_path):
    film = film_from_recording(depth_only(tmp_path, rich))
    (cloud,) = film.clouds.values()
    assert [len(frame) > 500 for frame in cloud.frames] == [True, True]
    assert len(cloud.frames[0]) <= 4000
    x, _, z = cloud.frames[0].T
    assert x.min() > 0  # the mask's half
    assert sorted(set(z.round(4).tolist())) == pytest.approx([0.25, 0.35])
    assert not any("no observation of the cloth" in note for note in film.notes)


def test_where_nothing_shows_the_cloth_it_says_so(rich):
    film = film_from_recording(replace(rich, points=None, markers=None, cameras={}))
    assert any("no observation of the cloth" in note for note in film.notes)


def test_a_single_knot_of_motion_is_a_picture(example):
    """Its one time was doubled, and refused."""
    one = {name: replace(j, t=j.t[:1], q=j.q[:1], closed=None, width=None, force=None, torque=None)
           for name, j in example.joints.items()}  # fmt: skip
    still = replace(example, points=None, markers=None, cameras={}, truth=None, joints=one, grippers={})
    assert film_from_recording(still).times.tolist() == [example.joints["left"].t[0]]


def test_arms_stand_where_the_kinematics_say(example):
    film = film_from_recording(example)
    arm, joints = robots.arm_from_recording(example, "left"), example.joints["left"]
    at = 7
    q = np.array([np.interp(film.times[at], joints.t, column) for column in joints.q.T])
    shapes = arm.geometry(arm.home.new_tensor(q))
    solids = [solid for name, solid in film.solids.items() if name.startswith("arms/left/")]
    assert len(solids) == len(shapes) > 10
    for solid, shape in zip(solids, shapes, strict=True):
        np.testing.assert_allclose(posed_vertices(solid, at).mean(0), shape.pose[:3, 3].numpy(), atol=1e-6)


def test_grippers_follow_the_replayed_motion(example):
    film = film_from_recording(example)
    path = robots.replay(example)["right"]
    knots = np.searchsorted(path.t.numpy(), film.times)
    np.testing.assert_allclose(film.traces["grippers/right"].poses, path.pose[knots].numpy(), atol=1e-6)
    assert len(film.traces["grippers/right"].points) == len(path.t)


def test_a_robot_that_is_not_known_is_left_out_and_named(rich):
    film = film_from_recording(rich)
    assert not [name for name in film.solids if name.startswith("arms/spare")]
    assert any("'spare' is not drawn" in note for note in film.notes)
    assert "grippers/left" in film.traces


def test_a_collider_is_a_square_of_its_plane(rich):
    table = rec.Collider(np.array([0.0, 0, 0.3]), np.array([0.0, 0.6, 0.8]))
    corners = film_from_recording(replace(rich, colliders={"wedge": table})).planes["colliders/wedge"].corners
    assert (corners - table.point) @ table.normal == pytest.approx(0)
    a, b, c, d = corners
    assert np.linalg.norm(b - a) == pytest.approx(np.linalg.norm(d - a))
    assert np.cross(b - a, c - a) @ table.normal > 0  # counterclockwise seen from outside


def test_depth_images_come_at_their_time(rich):
    film = film_from_recording(rich)
    view = film.views["cameras/cam0"]
    assert view.index.tolist() == [0, 1, -1]
    np.testing.assert_array_equal(view.depth_image(1), rich.cameras["cam0"].depth.load(1))
    assert view.depth_image(2) is None
    assert film.views["cameras/cam1"].depth_image(0) is None


def test_forces_are_curves(rich):
    curve = film_from_recording(rich).curves["force/left"]
    assert curve.unit == "N"
    assert curve.values == pytest.approx(np.linalg.norm(rich.grippers["left"].force, axis=1))


def test_truth_only_on_request(rich):
    assert "truth" not in film_from_recording(rich).sheets
    drawn = film_from_recording(rich, truth=True).sheets["truth"]
    t = rich.truth.t
    share = (film_from_recording(rich).times[0] - t[0]) / (t[1] - t[0])
    expected = (1 - share) * rich.truth.vertices[0] + share * rich.truth.vertices[1]
    np.testing.assert_allclose(drawn.vertices[0], expected, atol=1e-6)
    with pytest.raises(RecordingError, match="has no truth, which --truth needs"):
        film_from_recording(replace(rich, truth=None), truth=True)


def test_streams_that_are_missing_are_not_shown(rich):
    motion = replace(rich, points=None, markers=None, cameras={}, truth=None, joints={}, robots={}, colliders={})
    film = film_from_recording(motion)
    assert (film.clouds, film.solids, film.planes, film.views) == ({}, {}, {}, {})
    assert film.times[[0, -1]] == pytest.approx([0, 1])
    assert len(film) == 26  # 25 a second
    with pytest.raises(RecordingError, match="nothing to view"):
        film_from_recording(replace(motion, grippers={}))


def test_frames_of_an_episode_without_points(rich):
    """Markers, else images, else truth give the times."""
    assert film_from_recording(replace(rich, points=None)).times == pytest.approx(rich.markers.t + 0.01)
    images = replace(rich, points=None, markers=None)
    assert film_from_recording(images).times == pytest.approx(rich.cameras["cam0"].depth.t + 0.01)
    alone = replace(images, cameras={})
    assert film_from_recording(alone, truth=True).times == pytest.approx(rich.truth.t)


def test_a_mask_is_that_of_its_own_image(rich, tmp_path):
    """Of every other image there is none: those are shown whole, and not within what was cut out earlier."""
    seldom = depth_only(tmp_path, rich)
    camera = seldom.cameras["cam0"]
    second = replace(camera.mask, frames=np.array([1]), t=np.array([0.2]), paths=camera.mask.paths[:1])
    film = film_from_recording(replace(seldom, cameras={"cam0": replace(camera, mask=second)}))
    (cloud,) = film.clouds.values()
    assert [bool((frame[:, 0] < 0).any()) for frame in cloud.frames] == [True, False]


def test_links_that_cannot_be_drawn_are_named(example, monkeypatch):
    monkeypatch.setattr(robots.Arm, "unread_meshes", {"link3": "mesh 'a.stl' is not there"})
    assert "arm 'left': link3 is not drawn: mesh 'a.stl' is not there" in film_from_recording(example).notes
