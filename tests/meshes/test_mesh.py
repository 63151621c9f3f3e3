"""Meshes: refusals, areas, rest shapes."""

import numpy as np
import pytest
import torch

import torchcloth as tc
from torchcloth.errors import InvalidInput
from torchcloth.meshes import Mesh, obj

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
        (SQUARE, FACES, SQUARE[None, :3, :2], r"uv; got shape \(1, 3, 2\); .* per corner, \[2, 3, 2\]"),
        (SQUARE, FACES, SQUARE[:, :2] * np.nan, r"uv; .* expected finite"),
        (
            SQUARE,
            [[0, 1, 2], [0, 2, 2], [0, 2, 3]],
            None,
            r"faces; got 1 with a vertex twice \(first: 1: \[0, 2, 2\]\)",
        ),
        (SQUARE, [[0, 1, 2], [0, 2, 0], [0, 2, 3]], SQUARE[[[0, 1, 2], [0, 2, 3], [0, 2, 3]], :2], "a vertex twice"),
        (SQUARE * [1, 0, 0], FACES, None, r"2 degenerate or flipped triangles \(first: 0"),
        (SQUARE, FACES, [[0, 0], [1, 0], [1, 1], [2, 0.5]], "degenerate or flipped"),
        (SQUARE, [[0, 1, 2], [0, 1, 2, 3]], None, "faces; got list .*a rectangular array"),
        ([[0, 0, 0], [1, 0]], FACES, None, "vertices; got list"),
        (torch.tensor(SQUARE, requires_grad=True), FACES, None, "vertices; got Tensor"),
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
        mesh.vertices_near_pattern_points([[0.0, 0.0]], 0.1)


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
    np.testing.assert_array_equal(mesh.vertices_near_pattern_points([[0.0, 0.0]], 0.01), [0])
    result = mesh.vertices_near_pattern_points([[0.0, 0.0], [0.4, 0.3]], 0.1)
    np.testing.assert_array_equal(result, [0, 1, 4, 15, 18, 19])
    np.testing.assert_array_equal(mesh.vertices_near_pattern_points([0.2, 0.1], 0.02), [9])
    with pytest.raises(InvalidInput, match=r"nearest: 0\.07071 m"):
        mesh.vertices_near_pattern_points([[0.05, 0.05]], 0.02)


@pytest.mark.parametrize(
    ("corner", "uv"),
    [("lower-left", (0, 0)), ("lower-right", (0.4, 0)), ("upper-left", (0, 0.3)), ("upper-right", (0.4, 0.3))],
)
def test_corners_are_named_in_pattern_coordinates(corner, uv):
    mesh = tc.meshes.rectangle(0.4, 0.3, resolution=(5, 4))
    gripped = tc.boundaries.Grasp.corner(corner).bind(mesh).index
    np.testing.assert_allclose(mesh.uv[gripped.numpy()], [uv])


def test_load_refuses_what_is_no_mesh(tmp_path):
    pytest.importorskip("trimesh")
    with pytest.raises(InvalidInput, match="existing OBJ or PLY"):
        tc.meshes.load(tmp_path / "nowhere.obj")
    broken = tmp_path / "broken.ply"
    broken.write_bytes(b"ply\nnonsense")
    with pytest.raises(InvalidInput, match="broken"):
        tc.meshes.load(broken)


def test_load_reads_an_obj_with_pattern_coordinates(tmp_path):
    mesh = tc.meshes.rectangle(0.4, 0.3, resolution=(3, 3))
    lines = [f"v {x} {y} {z}" for x, y, z in mesh.vertices] + [f"vt {u} {v}" for u, v in mesh.uv]
    lines += ["f " + " ".join(f"{k + 1}/{k + 1}" for k in face) for face in mesh.faces]
    path = tmp_path / "sheet.obj"
    path.write_text("\n".join(lines))
    loaded = tc.meshes.load(path)
    np.testing.assert_allclose(loaded.area.sum(), 0.12)
    np.testing.assert_allclose(loaded.vertices, mesh.vertices)
    np.testing.assert_allclose(loaded.uv, mesh.uv)


def sewn_pair(turn=1.0):
    """Two squares that share an edge in the world and lie apart on the pattern, the second perhaps from behind."""
    x = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0, 0], [2, 1, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3], [1, 4, 5], [1, 5, 2]])
    laid = x[faces][..., :2].copy()
    laid[2:] = laid[2:] * [turn, 1.0] + [5.0, 0.3]
    return x, faces, laid


def test_where_the_pattern_parts_two_panels_are_sewn():
    x, faces, laid = sewn_pair()
    mesh = Mesh.build(x, faces, laid)
    assert mesh.seams.tolist() == [[1, 2]]
    assert mesh.panels.tolist() == [0, 0, 1, 1]
    assert mesh.uv is None
    assert len(mesh.boundary_edges) == 6
    np.testing.assert_array_equal(mesh.rest, laid)
    np.testing.assert_array_equal(mesh.vertices_near_pattern_points([[7.0, 0.3]], 1e-9), [4])
    np.testing.assert_array_equal(mesh.vertices_near_pattern_points([[6.0, 0.3]], 1e-9), [1])
    np.testing.assert_array_equal(mesh.vertices_near_pattern_points([[1.0, 0.0]], 1e-9), [1])


def test_corner_coordinates_that_agree_are_vertex_coordinates():
    flat = tc.meshes.rectangle(0.4, 0.3, resolution=(5, 4))
    mesh = Mesh.build(flat.vertices, flat.faces, flat.uv[flat.faces])
    np.testing.assert_array_equal(mesh.uv, flat.uv)
    np.testing.assert_array_equal(mesh.rest, flat.rest)
    assert mesh.seams.shape == (0, 2)
    assert mesh.panels.max() == 0
    rim = mesh.uv[mesh.boundary_edges]
    assert len(rim) == 2 * (4 + 3)
    assert (((rim == 0) | np.isclose(rim, [0.4, 0.3])).all(1).any(1)).all()  # both ends on the same side


def test_each_panel_drawn_from_behind_is_turned_over_by_itself():
    x, faces, laid = sewn_pair(turn=-1.0)
    mesh = Mesh.build(x, faces, laid)
    np.testing.assert_allclose(mesh.area, 0.5)
    np.testing.assert_array_equal(mesh.pattern, laid)
    folded = laid.copy()
    folded[3, 2] = folded[2, 1]  # the second triangle of the panel laid back on the first
    with pytest.raises(InvalidInput, match="degenerate or flipped"):
        Mesh.build(x, faces, folded)


def test_a_sewn_mesh_is_strained_by_its_own_pattern():
    """The energy of a garment made of strips does not depend on where the strips lie on the pattern."""
    flat = tc.meshes.rectangle(0.4, 0.3, resolution=(5, 4))
    strips = (flat.uv[flat.faces][..., 1].mean(1) > 0.1).astype(float)[:, None, None] * [3.0, -1.0]
    sewn = Mesh.build(flat.vertices, flat.faces, flat.uv[flat.faces] + strips)
    assert sewn.panels.max() == 1
    assert len(sewn.seams) == 4
    x = torch.as_tensor(flat.vertices * [1.1, 0.95, 1.0])
    energies = []
    for mesh in (flat, sewn):
        cloth = tc.Cloth(mesh, tc.materials.AEP(1e5), 0.2, contact=None)
        energies.append(float(cloth.energy(cloth.state(x))["membrane"].detach()))
    assert energies[0] > 0.01
    assert energies[1] == pytest.approx(energies[0], rel=1e-5)


@pytest.mark.parametrize("index", [[4], [-1], [], [0.5], [[0]]])
def test_places_are_vertices(index):
    with pytest.raises(InvalidInput, match=r"places\['tip'\]; got .* 0..3"):
        Mesh.build(SQUARE, FACES, places={"tip": index})


def test_places_and_what_lies_around_them():
    mesh = Mesh.build(SQUARE, FACES, places={"tip": [2]})
    assert mesh.vertices_at_place("tip").tolist() == [2]
    assert mesh.vertices_at_place("tip", 1.0).tolist() == [1, 2, 3]
    with pytest.raises(InvalidInput, match="place; got 'top'; expected one of tip"):
        mesh.vertices_at_place("top")


def test_extent_is_the_cloth_s_whatever_its_placement():
    flat = tc.meshes.rectangle(0.5, 0.5, resolution=(9, 9))
    rolled = np.column_stack([0.02 * np.cos(flat.uv[:, 0] / 0.02), flat.uv[:, 1], 0.02 * np.sin(flat.uv[:, 0] / 0.02)])
    mesh = Mesh.build(rolled, flat.faces, flat.uv)
    assert 0.5 * 2**0.5 <= mesh.extent + 1e-12 <= 1.09 * 0.5 * 2**0.5  # edges of a square grid zigzag by up to 8 %
    assert mesh.extent == pytest.approx(flat.extent)


def test_load_keeps_an_obj_with_texture_seams_sewn(tmp_path):
    x, faces, laid = sewn_pair()
    path = tmp_path / "pair.OBJ"
    path.write_text(obj.dump(x, faces, laid))
    mesh = tc.meshes.load(path)
    assert len(mesh.vertices) == 6  # not split
    assert mesh.seams.tolist() == [[1, 2]]
    np.testing.assert_array_equal(mesh.rest, laid)


def saved(folder, mesh, uv):
    path = folder / "sheet.obj"
    path.write_text(obj.dump(mesh.vertices, mesh.faces, uv))
    return path


@pytest.mark.parametrize("scale", [1 / 0.3, 100.0, 0.001])
def test_load_refuses_texture_coordinates_for_a_pattern(tmp_path, scale):
    mesh = tc.meshes.rectangle(0.3, 0.3, resolution=(3, 3))
    path = saved(tmp_path, mesh, scale * mesh.uv)
    with pytest.raises(InvalidInput, match=rf"sheet.obj: vt; got edges .* {scale:.3g} times .*vt must be in metres"):
        tc.meshes.load(path)


@pytest.mark.parametrize("size", [(1.0, 0.5), (1.5, 1.0), (1.0, 0.7), (0.7, 0.7), (0.9, 0.9), (1.0, 0.8)])
def test_load_refuses_textures_of_cloth_of_about_a_metre(tmp_path, size):
    """Areas alone would not tell them: a towel of half its weight sprang to twice its width."""
    mesh = tc.meshes.rectangle(*size, resolution=(5, 4))
    with pytest.raises(InvalidInput, match="vt must be in metres"):
        tc.meshes.load(saved(tmp_path, mesh, mesh.uv / np.array(size)))
    np.testing.assert_allclose(tc.meshes.load(saved(tmp_path, mesh, mesh.uv)).area.sum(), np.prod(size))


def test_load_refuses_millimetres(tmp_path):
    mesh = tc.meshes.rectangle(300.0, 300.0, resolution=(3, 3))
    for uv in (mesh.uv, None):
        with pytest.raises(InvalidInput, match=r"sheet.obj looks like millimetres; got a span of 300"):
            tc.meshes.load(saved(tmp_path, mesh, uv))


def test_load_refuses_a_pattern_with_holes(tmp_path):
    mesh = tc.meshes.rectangle(0.4, 0.3, resolution=(4, 4))
    lines = obj.dump(mesh.vertices, mesh.faces, mesh.uv).splitlines()
    *words, last = lines[-1].split()
    lines[-1] = " ".join(word.split("/")[0] for word in (*words, last))
    path = tmp_path / "holes.obj"
    path.write_text("\n".join(lines))
    with pytest.raises(InvalidInput, match=r"vt; got 1 of 18 triangles without; .* or nowhere"):
        tc.meshes.load(path)


def test_load_refuses_such_polygons_of_a_ply(tmp_path):
    path = tmp_path / "dart.ply"
    head = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    head += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    path.write_text(head + "0 0 0\n1 0 0\n0.2 0.2 0\n0 1 0\n4 1 2 3 0\n")
    with pytest.raises(InvalidInput, match=r"a polygon is not convex.*triangulate"):
        tc.meshes.load(path)
    path.write_text(head + "0 0 0\n1 0 0\n1 1 0\n0 1 0\n4 1 2 3 0\n")
    np.testing.assert_allclose(tc.meshes.load(path).area.sum(), 1.0)
    path.write_text(head + "0 0 0\n1 0 0\n1 1 0\n0 1 0\n4 0 1 2 9\n")
    with pytest.raises(InvalidInput, match=r"a face with vertex 9; expected vertices 0 to 3"):
        tc.meshes.load(path)


@pytest.mark.parametrize("ring", ["1 2 3 4", "2 3 4 1"])
def test_load_refuses_polygons_that_a_fan_does_not_cover_once(tmp_path, ring):
    """Of four times the area, by where it began."""
    path = tmp_path / "dart.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0.2 0.2 0\nv 0 1 0\nf " + ring + "\n")
    if ring == "1 2 3 4":
        np.testing.assert_allclose(tc.meshes.load(path).area.sum(), 0.2)
    else:
        with pytest.raises(InvalidInput, match=r"line 5: a polygon is not convex.*triangulate"):
            tc.meshes.load(path)


@pytest.mark.parametrize("binary", [False, True])
@pytest.mark.parametrize("corners", [3, 4])
def test_load_keeps_a_ply_with_coordinates_of_corners_sewn(tmp_path, binary, corners):
    """As MeshLab writes them; trimesh tears such a mesh apart at its seams."""
    pytest.importorskip("trimesh")
    if corners == 3:
        mesh = tc.meshes.shirt(triangles=300)
        x, rings, laid = mesh.vertices, mesh.faces, mesh.pattern
    else:
        x = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0, 0], [2, 1, 0]])
        rings = np.array([[0, 1, 2, 3], [1, 4, 5, 2]])
        laid = x[rings][..., :2] + np.array([[[0.0, 0.0]], [[5.0, 0.3]]])
    head = ["ply", f"format {'binary_little_endian' if binary else 'ascii'} 1.0", f"element vertex {len(x)}"]
    head += [f"property double {axis}" for axis in "xyz"] + [f"element face {len(rings)}"]
    head += ["property list uchar int vertex_indices", "property list uchar double texcoord", "end_header\n"]
    body = x.astype("<f8").tobytes() if binary else "".join(f"{a!r} {b!r} {c!r}\n" for a, b, c in x.tolist()).encode()
    for ring, place in zip(rings, laid.reshape(len(rings), -1), strict=True):
        if binary:
            body += bytes([corners]) + ring.astype("<i4").tobytes() + bytes([2 * corners]) + place.tobytes()
        else:
            words = [corners, *ring.tolist(), 2 * corners, *place.tolist()]
            body += (" ".join(map(repr, words)) + "\n").encode()
    path = tmp_path / "sewn.ply"
    path.write_bytes("\n".join(head).encode() + body)
    loaded = tc.meshes.load(path)
    np.testing.assert_array_equal(loaded.vertices, x)
    assert loaded.piece_count == 1
    assert len(loaded.seams) == (len(mesh.seams) if corners == 3 else 1)
    np.testing.assert_allclose(loaded.area.sum(), mesh.area.sum() if corners == 3 else 2.0)


def test_pieces_are_counted_and_told():
    one = tc.meshes.rectangle(0.2, 0.2, resolution=(3, 3))
    two = Mesh.build(np.concatenate([one.vertices, one.vertices + 0.1]), np.concatenate([one.faces, one.faces + 9]))
    assert (one.piece_count, two.piece_count) == (1, 2)
    assert "2 pieces that nothing joins" in repr(tc.Cloth(two, tc.materials.AEP(1e5), 0.2))
    assert "pieces" not in repr(tc.Cloth(one, tc.materials.AEP(1e5), 0.2))


def test_load_takes_a_cloth_that_lies_folded_for_what_it_is(tmp_path):
    flat = tc.meshes.rectangle(0.3, 0.3, resolution=(5, 5))
    folded = flat.vertices * 1.0
    folded[:, 0] = np.abs(folded[:, 0] - 0.15)
    (tmp_path / "sheet.obj").write_text(obj.dump(folded, flat.faces, flat.uv))
    assert tc.meshes.load(tmp_path / "sheet.obj").area.sum() == pytest.approx(0.09)


def test_load_refuses_a_damaged_obj(tmp_path):
    path = tmp_path / "sheet.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 7")
    with pytest.raises(InvalidInput, match=r"sheet.obj is damaged at line 4; got 'f 1 2 7'"):
        tc.meshes.load(path)
    path.write_bytes(b"v \xff")
    with pytest.raises(InvalidInput, match="expected a readable OBJ or PLY file"):
        tc.meshes.load(path)


def test_load_reads_a_ply(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    flat = tc.meshes.rectangle(0.4, 0.3, resolution=(3, 3))
    trimesh.Trimesh(flat.vertices, flat.faces, process=False).export(tmp_path / "sheet.ply")
    mesh = tc.meshes.load(tmp_path / "sheet.ply")
    np.testing.assert_allclose(mesh.vertices, flat.vertices, atol=1e-7)
    np.testing.assert_array_equal(mesh.faces, flat.faces)
    assert mesh.pattern is None


def test_triangles_that_turn_unlike_are_refused():
    """Without a pattern nothing else tells them from the others, and bending of their edges would be lost."""
    mesh = tc.meshes.rectangle(0.2, 0.2, resolution=(5, 5))
    faces = mesh.faces.copy()
    faces[::5] = faces[::5][:, ::-1]
    with pytest.raises(InvalidInput, match="along which two triangles go the same way"):
        Mesh.build(mesh.vertices, faces)
    fin = np.concatenate([mesh.vertices, [[0.1, 0.1, 0.1]]])
    with pytest.raises(InvalidInput, match="at most two at an edge"):
        Mesh.build(fin, np.concatenate([mesh.faces, [[*mesh.faces[8][:2], 25]]]))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda folder: tc.meshes.rectangle(0.2, 0.2, triangles=0), "triangles; got 0"),
        (lambda folder: tc.meshes.rectangle(np.inf, 0.2), "rectangle size"),
        (lambda folder: tc.meshes.load(folder / "cloth.stl"), "expected an OBJ or PLY file"),
        (lambda folder: tc.meshes.load(folder / "cloth.txt"), "expected an OBJ or PLY file"),
    ],
)
def test_what_makes_no_sheet_is_refused(make, message, tmp_path):
    for name in ("cloth.stl", "cloth.txt"):
        (tmp_path / name).write_text("solid")
    with pytest.raises(InvalidInput, match=message):
        make(tmp_path)


def test_vertices_that_a_file_has_split_are_counted():
    """Two squares side by side that share an edge in space and no vertex."""
    one = tc.meshes.rectangle(0.1, 0.1, resolution=(3, 3))
    other = one.vertices + np.array([0.1, 0.0, 0.0])
    vertices, faces = np.concatenate([one.vertices, other]), np.concatenate([one.faces, one.faces + len(one.vertices)])
    torn = tc.meshes.Mesh.build(vertices, faces, vertices[:, :2])
    assert (one.duplicated_vertex_count, torn.duplicated_vertex_count) == (0, 6)
    with pytest.warns(UserWarning, match="6 vertices of the mesh lie on others of another piece"):
        tc.Cloth(torn, tc.materials.AEP(1e5), 0.2, contact=None)
    apart = tc.meshes.Mesh.build(vertices + 1e-3 * (np.arange(len(vertices)) > 8)[:, None], faces, vertices[:, :2])
    assert apart.duplicated_vertex_count == 0


PLY_SHEET = "element vertex 4\nproperty float x\nproperty float y\nproperty float z\nelement face 3\n"
PLY_LIST = "property list uchar int vertex_indices\nend_header\n"
PLY_VERTICES = "0 0 0\n0.1 0 0\n0.1 0.1 0\n0 0.1 0\n"


@pytest.mark.parametrize(
    ("faces", "number"),
    [("2 0 1\n3 0 1 2\n3 0 2 3\n", 1), ("3 0 1 2\n1 3\n3 0 2 3\n", 2), ("2 0 1\n2 1 2\n2 2 3\n", 1)],
)
def test_load_names_a_face_of_fewer_than_three_corners(tmp_path, faces, number):
    """trimesh drops it, so the cloth would have a hole that the file does not say."""
    path = tmp_path / "line.ply"
    path.write_text("ply\nformat ascii 1.0\n" + PLY_SHEET + PLY_LIST + PLY_VERTICES + faces)
    with pytest.raises(InvalidInput, match=f"line.ply, damaged at face {number} of 3, which has [12] corners"):
        tc.meshes.load(path)


def test_load_reads_an_obj_with_a_byte_order_mark(tmp_path):
    """As Windows' editors write it; the first line's keyword would be unknown and its vertex lost."""
    path = tmp_path / "sheet.obj"
    path.write_text("v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nf 1 2 3\n", encoding="utf-8-sig")
    assert tc.meshes.load(path).vertices.tolist() == [[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]]


@pytest.mark.parametrize("ratio", [10, 2000])
def test_a_triangle_that_is_much_flatter_than_the_others_is_named(ratio):
    """It shortens the step by as much, so a fit of minutes takes days."""
    flat = tc.meshes.rectangle(0.3, 0.3, triangles=200)
    a, b, c = flat.faces[90]
    corner, edge, side = flat.vertices[a], *(flat.vertices[k] - flat.vertices[a] for k in (b, c))
    height = side - edge * (side @ edge) / (edge @ edge)
    x = np.vstack([flat.vertices, corner + edge / 2 + height / ratio])
    k = len(flat.vertices)
    faces = np.vstack([np.delete(flat.faces, 90, axis=0), [[a, b, k], [b, c, k], [c, a, k]]])
    if ratio == 10:
        assert len(Mesh.build(x, faces, x[:, :2]).faces) == len(faces)
        return
    with pytest.warns(UserWarning, match=r"triangle 199 is 1414 times flatter .* mm high; the stable step"):
        Mesh.build(x, faces, x[:, :2])
