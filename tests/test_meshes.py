"""Meshes: refusals, areas, rest shapes."""

import numpy as np
import pytest

import torchcloth as tc
from torchcloth.errors import InvalidInput
from torchcloth.meshes import Mesh

SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
FACES = np.array([[0, 1, 2], [0, 2, 3]])


@pytest.mark.parametrize(
    ("vertices", "faces", "uv", "message"),
    [
        (SQUARE[:, :2], FACES, None, r"vertices; got shape \(4, 2\)"),
        (SQUARE.ravel(), FACES, None, "vertices"),
        (SQUARE * np.nan, FACES, None, "vertices"),
        (SQUARE, FACES[:, :2], None, "faces; got shape"),
        (SQUARE, np.zeros((0, 3)), None, "F > 0"),
        (SQUARE, FACES + 1, None, r"faces; got indices 1\.\.4; expected 0\.\.3"),
        (SQUARE, FACES - 1, None, "faces; got indices -1"),
        (SQUARE, FACES[:1], None, r"1 in no triangle \(first: 3\)"),
        (SQUARE, FACES, SQUARE, r"uv; got shape \(4, 3\)"),
        (SQUARE, [[0, 1, 2], [0, 2, 2], [0, 2, 3]], None, r"1 degenerate or flipped triangles \(first: 1"),
        (SQUARE, FACES, [[0, 0], [1, 0], [1, 1], [2, 0.5]], "degenerate or flipped"),
    ],
)
def test_refusals_name_the_argument(vertices, faces, uv, message):
    with pytest.raises(InvalidInput, match=message):
        Mesh.build(vertices, faces, uv)


@pytest.mark.parametrize("triangles", [2, 50, 800, 1500])
@pytest.mark.parametrize("size", [(0.5, 0.5), (0.3, 0.9), (0.7, 0.2)])
def test_rectangle_has_about_the_wanted_triangles_and_its_area(size, triangles):
    mesh = tc.meshes.rectangle(*size, triangles=triangles)
    assert len(mesh.faces) == pytest.approx(triangles, rel=0.15, abs=2)
    assert (mesh.area > 0).all()
    assert mesh.area.sum() == pytest.approx(size[0] * size[1], rel=1e-12)
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), [*size, 0.0])
    np.testing.assert_array_equal(mesh.uv, mesh.vertices[:, :2])


def test_rectangle_of_an_exact_resolution():
    mesh = tc.meshes.rectangle(0.4, 0.3, resolution=(5, 4))
    assert (len(mesh.vertices), len(mesh.faces)) == (20, 24)
    edges = np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    unique, count = np.unique(edges, axis=0, return_counts=True)
    assert set(count) == {1, 2}
    assert (count == 1).sum() == 2 * (4 + 3)
    assert len(mesh.vertices) - len(unique) + len(mesh.faces) == 1  # Euler: a disc
    lengths = np.linalg.norm(mesh.vertices[unique[:, 0]] - mesh.vertices[unique[:, 1]], axis=1)
    assert lengths.max() == pytest.approx(np.hypot(0.1, 0.1))


@pytest.mark.parametrize("arguments", [(0.0, 1.0), (1.0, -1.0), (float("nan"), 1.0)])
def test_rectangle_refuses_sizes(arguments):
    with pytest.raises(InvalidInput, match="rectangle size"):
        tc.meshes.rectangle(*arguments)
    with pytest.raises(InvalidInput, match="resolution"):
        tc.meshes.rectangle(1.0, 1.0, resolution=(1, 5))


def test_shape_gradient_reproduces_linear_fields():
    rng = np.random.default_rng(0)
    mesh = tc.meshes.rectangle(0.4, 0.3, resolution=(5, 4))
    F, c = rng.normal(size=(3, 2)), rng.normal(size=3)
    x = mesh.uv @ F.T + c
    got = np.einsum("fai,faj->fij", x[mesh.faces], mesh.shape_gradient)
    np.testing.assert_allclose(got, np.broadcast_to(F, got.shape), atol=1e-12)
    np.testing.assert_allclose(mesh.shape_gradient.sum(1), 0.0, atol=1e-12)


def test_the_pattern_decides_the_rest_shape_not_the_placement():
    """A pattern draped on a curved world placement: its lengths are those of the pattern."""
    flat = tc.meshes.rectangle(0.4, 0.3, resolution=(9, 4))
    bent = np.column_stack([0.2 * np.sin(flat.uv[:, 0] / 0.2), flat.uv[:, 1], 0.2 * np.cos(flat.uv[:, 0] / 0.2)])
    mesh = Mesh.build(bent, flat.faces, flat.uv)
    np.testing.assert_allclose(mesh.area, flat.area)
    without = Mesh.build(bent, flat.faces)
    assert without.area.sum() < flat.area.sum()  # chords instead of arcs


def test_without_a_pattern_the_placement_is_the_rest_shape():
    rng = np.random.default_rng(1)
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    flat = tc.meshes.rectangle(0.4, 0.3, resolution=(5, 4))
    mesh = Mesh.build(flat.vertices @ rotation.T + 1.0, flat.faces)
    np.testing.assert_allclose(mesh.area, flat.area)
    corners = mesh.vertices[mesh.faces]
    F = np.einsum("fai,faj->fij", corners, mesh.shape_gradient)
    np.testing.assert_allclose(np.einsum("fij,fik->fjk", F, F), np.broadcast_to(np.eye(2), (24, 2, 2)), atol=1e-12)
    with pytest.raises(InvalidInput, match="name the grasped vertices"):
        mesh.nearest_vertices([[0.0, 0.0]], 0.1)


def test_a_pattern_seen_from_behind_is_turned_over():
    flat = tc.meshes.rectangle(0.4, 0.3, resolution=(5, 4))
    mesh = Mesh.build(flat.vertices, flat.faces, flat.uv * [-1.0, 1.0])
    np.testing.assert_allclose(mesh.area, flat.area)


def test_a_closed_tube_without_a_pattern():
    """A seam: no global pattern coordinates exist, every triangle has its own."""
    n = 8
    angle = 2 * np.pi * np.arange(n) / n
    ring = np.column_stack([np.cos(angle), np.sin(angle)])
    x = np.concatenate([np.column_stack([ring, np.full(n, z)]) for z in (0.0, 1.0)])
    i, j = np.arange(n), (np.arange(n) + 1) % n
    faces = np.concatenate([np.column_stack([i, j, j + n]), np.column_stack([i, j + n, i + n])])
    mesh = Mesh.build(x, faces)
    assert mesh.area.sum() == pytest.approx(n * 2 * np.sin(np.pi / n))
    cloth = tc.Cloth(mesh, tc.materials.AEP(1e5), 0.2, contact=None)
    assert float(cloth.energy(cloth.rest_state())["membrane"].detach()) < 1e-20
    with pytest.raises(InvalidInput, match="without pattern coordinates"):
        tc.Cloth(mesh, tc.materials.AEP(1e5), 0.2, boundaries={"g": tc.boundaries.Grasp.corner("lower-left")})


def test_nearest_vertices():
    mesh = tc.meshes.rectangle(0.4, 0.3, resolution=(5, 4))
    np.testing.assert_array_equal(mesh.nearest_vertices([[0.0, 0.0]], 0.01), [0])
    found = mesh.nearest_vertices([[0.0, 0.0], [0.4, 0.3]], 0.1)
    np.testing.assert_array_equal(found, [0, 1, 4, 15, 18, 19])
    np.testing.assert_array_equal(mesh.nearest_vertices([0.2, 0.1], 0.02), [9])
    with pytest.raises(InvalidInput, match=r"nearest: 0\.07071 m"):
        mesh.nearest_vertices([[0.05, 0.05]], 0.02)


@pytest.mark.parametrize(
    ("corner", "uv"),
    [("lower-left", (0, 0)), ("lower-right", (0.4, 0)), ("upper-left", (0, 0.3)), ("upper-right", (0.4, 0.3))],
)
def test_corners_are_named_in_pattern_coordinates(corner, uv):
    mesh = tc.meshes.rectangle(0.4, 0.3, resolution=(5, 4))
    held = tc.boundaries.Grasp.corner(corner).bind(mesh).index
    np.testing.assert_allclose(mesh.uv[held.numpy()], [uv])


def test_load_refuses_what_is_no_mesh(tmp_path):
    pytest.importorskip("trimesh")
    with pytest.raises(InvalidInput, match="existing OBJ or PLY"):
        tc.meshes.load(tmp_path / "nowhere.obj")
    broken = tmp_path / "broken.ply"
    broken.write_bytes(b"ply\nnonsense")
    with pytest.raises(InvalidInput, match="broken"):
        tc.meshes.load(broken)


def test_load_reads_an_obj_with_pattern_coordinates(tmp_path):
    pytest.importorskip("trimesh")
    mesh = tc.meshes.rectangle(0.4, 0.3, resolution=(3, 3))
    lines = [f"v {x} {y} {z}" for x, y, z in mesh.vertices] + [f"vt {u} {v}" for u, v in mesh.uv]
    lines += ["f " + " ".join(f"{k + 1}/{k + 1}" for k in face) for face in mesh.faces]
    path = tmp_path / "sheet.obj"
    path.write_text("\n".join(lines))
    loaded = tc.meshes.load(path)
    np.testing.assert_allclose(loaded.area.sum(), 0.12)
    np.testing.assert_allclose(loaded.vertices, mesh.vertices)
    np.testing.assert_allclose(loaded.uv, mesh.uv)
