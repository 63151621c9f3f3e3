"""The description that all viewers share, and the geometry under it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from torchcloth import meshes
from torchcloth.errors import InvalidInput
from torchcloth.meshes.mesh import vertex_normals
from torchcloth.observe import build_solid_mesh
from torchcloth.viewing import Film
from torchcloth.viewing.film import ground_planes, posed_vertices
from torchcloth.viewing.geometry import boundary_edges, nearest_indices, smoothed_normals, to_quaternions, unique_edges


def test_parts_must_have_the_films_frames(film):
    for kind in ("sheets", "clouds", "solids", "traces"):
        with pytest.raises(InvalidInput, match=f"{next(iter(getattr(film, kind)))}.*got 6 frames"):
            replace(
                film, times=film.times[:-1], **{k: {} for k in ("sheets", "clouds", "solids", "traces") if k != kind}
            )


def test_a_sheet_that_is_somewhere_nowhere_is_refused(film):
    """As a simulation that diverged leaves it."""
    cloth = film.sheets["cloth"]
    x = cloth.vertices.copy()
    x[3:, 5, 1] = np.nan
    with pytest.raises(InvalidInput, match="vertices of 'cloth'; got a position that is not finite in frame 3"):
        replace(film, sheets={"cloth": replace(cloth, vertices=x)})


def test_times_must_increase(film):
    with pytest.raises(InvalidInput, match="increasing"):
        Film(title="", times=np.array([0.0, 0.0]))


def test_frames_are_taken_from_all_parts(film):
    part = film.select_frames(np.array([1, 4]))
    assert part.times == pytest.approx(film.times[[1, 4]])
    np.testing.assert_array_equal(part.sheets["cloth"].vertices, film.sheets["cloth"].vertices[[1, 4]])
    np.testing.assert_array_equal(part.clouds["points"].frames[1], film.clouds["points"].frames[4])
    np.testing.assert_array_equal(part.solids["arms/one/ball"].poses, film.solids["arms/one/ball"].poses[[1, 4]])
    np.testing.assert_array_equal(part.traces["grippers/one"].poses, film.traces["grippers/one"].poses[[1, 4]])


@pytest.mark.parametrize(("rate", "frames"), [(1e308, 6), (100.0, 6), (10.0, 6), (5.0, 3), (2.0, 2), (0.1, 1)])
def test_a_film_has_at_most_so_many_frames_a_second(film, rate, frames):
    assert len(film.limit_rate(rate)) == frames


def test_a_solid_is_placed(film):
    ball = film.solids["arms/one/ball"]
    assert posed_vertices(ball, 5).mean(0) == pytest.approx([0, 0, 0.3])


def test_the_box_is_about_cloth_points_and_grippers(film):
    low, high = film.bounds
    assert low == pytest.approx([-0.2, -0.2, 0.0])
    assert high == pytest.approx([0.2, 0.2, 0.3])


def test_the_ground_is_the_table_or_lies_under_everything(film):
    assert ground_planes(film) == list(film.planes.values())
    (floor,) = ground_planes(replace(film, planes={}))
    assert floor.corners[:, 2] == pytest.approx(0.0)
    assert np.ptp(floor.corners[:, :2], axis=0).min() > 0.4


@pytest.mark.parametrize("wanted", [-1.0, 0.2, 0.5, 0.51, 3.0])
def test_the_nearest_time(wanted):
    times = np.array([0.0, 0.4, 1.0, 2.0])
    (result,) = nearest_indices(times, np.array([wanted]))
    assert abs(times[result] - wanted) == np.abs(times - wanted).min()
    assert nearest_indices(np.array([0.3]), np.array([wanted])).tolist() == [0]


def test_quaternions_are_those_of_scipy_and_do_not_jump():
    start = Rotation.random(random_state=0)
    turns = start * Rotation.from_rotvec(np.linspace(0, 3 * np.pi, 200)[:, None] * [0.6, 0.0, 0.8])
    result = to_quaternions(turns.as_matrix())
    expected = turns.as_quat()[:, [3, 0, 1, 2]]
    np.testing.assert_allclose(np.abs((result * expected).sum(-1)), 1, atol=1e-12)
    assert (result[1:] * result[:-1]).sum(-1).min() > 0.99


def test_edges_and_hems_of_a_sheet():
    """Euler: V - E + F = 1 for a disc; as many hem edges as vertices around it."""
    mesh = meshes.rectangle(0.3, 0.2, resolution=(4, 3))
    assert len(mesh.vertices) - len(unique_edges(mesh.faces)) + len(mesh.faces) == 1
    assert len(boundary_edges(mesh.faces)) == 2 * (3 + 2)
    assert len(boundary_edges(build_solid_mesh("box", (1.0, 1.0, 1.0), np.eye(4))[1])) == 0


def test_normals_of_a_ball_point_outwards():
    x, faces = build_solid_mesh("cylinder", (1.0, 2.0), np.eye(4), segments=64)
    side = np.abs(x[faces][..., 2]).max(1) * np.linalg.norm(x[faces][..., :2], axis=-1).min(1) > 0.5
    middle = x[faces[side]].mean(1)
    outwards = middle * [1, 1, 0] / np.linalg.norm(middle[:, :2], axis=-1)[:, None]
    assert (smoothed_normals(x, faces)[side] * outwards).sum(-1).min() > 0.7
    assert np.linalg.norm(vertex_normals(x, faces), axis=-1) == pytest.approx(1)


def test_a_seam_keeps_its_own_normals():
    """Two layers sewn along an edge: the mean normal there vanishes and says nothing."""
    x = np.array([[0.0, 0, 0], [0, 1, 0], [1, 0.5, 1e-3], [1, 0.5, -1e-3]])
    up, down = smoothed_normals(x, np.array([[0, 2, 1], [0, 1, 3]]))
    assert up[2] * down[2] < -0.9
