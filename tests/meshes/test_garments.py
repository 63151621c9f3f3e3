"""Garments: topology, seams that fit, triangle shapes, measures, and that a simulation holds them together."""

from collections import Counter
from itertools import pairwise

import numpy as np
import pytest
import torch

import torchcloth as tc
from torchcloth.errors import InvalidInput

OPENINGS = {
    "shirt": ("neck", "hem", "left cuff", "right cuff"),
    "trousers": ("waist", "left hem", "right hem"),
    "dress": ("neck", "hem", "left armhole", "right armhole"),
}
PANELS = {"shirt": 6, "trousers": 4, "dress": 4}


@pytest.fixture(scope="module", params=OPENINGS)
def garment(request):
    return request.param, getattr(tc.meshes, request.param)()


def loops(edges):
    """Closed ways through edges [N, 2], each as a set of vertices; every vertex has two of them."""
    near = {}
    for a, b in edges.tolist():
        near.setdefault(a, []).append(b)
        near.setdefault(b, []).append(a)
    assert {len(n) for n in near.values()} == {2}
    result = []
    while near:
        start = at = next(iter(near))
        loop, before = [], None
        while not loop or at != start:
            loop.append(at)
            before, at = at, next(n for n in near[at] if n != before)
        result.append(frozenset(loop))
        for v in loop:
            del near[v]
    return result


def angles(rest):
    out = []
    for k in range(3):
        a, b = rest[:, (k + 1) % 3] - rest[:, k], rest[:, (k + 2) % 3] - rest[:, k]
        out.append(np.arccos((a * b).sum(-1) / np.linalg.norm(a, axis=-1) / np.linalg.norm(b, axis=-1)))
    return np.degrees(np.stack(out))


def test_it_is_one_oriented_surface_with_its_openings(garment):
    """A sphere with as many holes as the garment has openings, and these are the named ones."""
    name, mesh = garment
    directed = Counter(map(tuple, mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).tolist()))
    assert set(directed.values()) == {1}  # with the next line: manifold, and neighbours agree on the side
    edges = {tuple(sorted(edge)) for edge in directed}
    assert len(mesh.vertices) - len(edges) + len(mesh.faces) == 2 - len(OPENINGS[name])
    free = {edge for edge in edges if (edge in directed) != (edge[::-1] in directed)}
    assert free == set(map(tuple, mesh.boundary_edges.tolist()))
    assert set(loops(mesh.boundary_edges)) == {frozenset(mesh.places[o].tolist()) for o in OPENINGS[name]}
    reached, label = {0}, {}
    for a, b in edges:
        label.setdefault(a, []).append(b)
        label.setdefault(b, []).append(a)
    todo = [0]
    while todo:
        fresh = set(label[todo.pop()]) - reached
        reached |= fresh
        todo += fresh
    assert len(reached) == len(mesh.vertices)


def test_front_and_back_are_the_same_panels_mirrored(garment):
    _, mesh = garment
    x = mesh.vertices
    normal = np.cross(x[mesh.faces[:, 1]] - x[mesh.faces[:, 0]], x[mesh.faces[:, 2]] - x[mesh.faces[:, 0]])[:, 2]
    middle = x[mesh.faces].mean(1)
    front, back = normal > 0, normal < 0  # outward: the front looks up
    assert front.sum() == back.sum() == len(mesh.faces) / 2
    assert (middle[front, 2] >= 0).all()
    assert (middle[back, 2] <= 0).all()
    corners = [{frozenset(map(tuple, t)) for t in x[mesh.faces[side]][..., :2].tolist()} for side in (front, back)]
    assert corners[0] == corners[1]  # as each side has its winding, one is the other's mirror image
    assert len(corners[0]) == front.sum()
    assert x[:, 2].max() == pytest.approx(0.005)
    assert x[:, 2].min() == pytest.approx(-0.005)
    np.testing.assert_allclose(x.min(0) + x.max(0), 0.0, atol=1e-12)
    mirrored = {tuple(row) for row in np.round(x * [-1e6, 1e6, 1e6]).astype(int).tolist()}
    assert mirrored == {tuple(row) for row in np.round(x * 1e6).astype(int).tolist()}  # left as right


def test_numbers_follow_the_longest_side(garment):
    _, mesh = garment
    axis = np.ptp(mesh.vertices, axis=0).argmax()
    assert (np.diff(mesh.vertices[:, axis]) >= 0).all()
    assert (np.diff(mesh.vertices[mesh.faces][..., axis].sum(1)) >= -1e-12).all()


def test_seams_fit_and_only_openings_and_seams_part_panels(garment):
    """Every seam edge has two triangles, of two panels, and the same length on both."""
    name, mesh = garment
    at = {}
    for face, (corners, laid) in enumerate(zip(mesh.faces.tolist(), mesh.rest, strict=True)):
        for k in range(3):
            edge = tuple(sorted((corners[k], corners[(k + 1) % 3])))
            at.setdefault(edge, []).append((face, np.linalg.norm(laid[k] - laid[(k + 1) % 3])))
    panels = mesh.panels
    assert panels.max() + 1 == PANELS[name]
    seams = set(map(tuple, mesh.seams.tolist()))
    for edge, sides in at.items():
        if len(sides) == 2:
            (f, length), (g, other) = sides
            assert (panels[f] != panels[g]) == (edge in seams)
            assert length == pytest.approx(other, rel=1e-12)
        else:
            assert edge not in seams
    sewn = set(mesh.seams.ravel().tolist())
    named = set().union(*(i.tolist() for n, i in mesh.places.items() if "seam" in n))
    assert named == sewn


def test_the_pattern_is_the_flat_garment_cut_apart(garment):
    """Panels do not overlap on the pattern, and the placement strains them only by lifting the layers apart."""
    _, mesh = garment
    box = [mesh.rest[mesh.panels == p].reshape(-1, 2) for p in range(mesh.panels.max() + 1)]
    order = sorted(box, key=lambda points: points[:, 1].min())
    assert all(a[:, 1].max() < b[:, 1].min() for a, b in pairwise(order))
    x = mesh.vertices[mesh.faces]
    placed = np.linalg.norm(x - np.roll(x, 1, axis=1), axis=-1)
    rest = np.linalg.norm(mesh.rest - np.roll(mesh.rest, 1, axis=1), axis=-1)
    strain = placed / rest - 1
    assert strain.min() > -1e-12
    assert strain.max() < 1.05 / (2 * 12.0**2)
    assert mesh.uv is None


@pytest.mark.parametrize("triangles", [300, 800, 1500, 4000])
@pytest.mark.parametrize("name", OPENINGS)
def test_triangles_are_as_many_and_as_even_as_wanted(name, triangles):
    mesh = getattr(tc.meshes, name)(triangles=triangles)
    assert len(mesh.faces) == pytest.approx(triangles, rel=0.1)
    assert angles(mesh.rest).min() > 25.0
    length = np.linalg.norm(mesh.rest - np.roll(mesh.rest, 1, axis=1), axis=-1)
    assert length.max() < 1.6 * length.mean()
    assert length.min() > 0.6 * length.mean()


def test_the_shirt_has_its_measures():
    mesh = tc.meshes.shirt(length=0.8, chest=0.6, shoulders=0.5, sleeve=0.3, cuff=0.2, neck=0.2)
    at = {name: mesh.vertices[index].mean(0)[:2] for name, index in mesh.places.items()}
    assert at["right underarm"][0] - at["left underarm"][0] == pytest.approx(0.6)
    assert at["right shoulder"][0] - at["left shoulder"][0] == pytest.approx(0.5)
    assert at["right neck corner"][1] - at["right hem corner"][1] == pytest.approx(0.8)
    assert np.linalg.norm(at["left cuff top"] - at["left shoulder"]) == pytest.approx(0.3)
    assert np.linalg.norm(at["left cuff top"] - at["left cuff bottom"]) == pytest.approx(0.2)
    assert at["left shoulder"][0] < 0 < at["right shoulder"][0]


def test_trousers_and_dress_have_their_measures():
    mesh = tc.meshes.trousers(length=1.0, waist=0.38, rise=0.3, hem=0.2)
    at = {name: mesh.vertices[index] for name, index in mesh.places.items()}
    assert np.ptp(at["waist"][:, 0]) == pytest.approx(0.38)
    assert np.ptp(at["left hem"][:, 0]) == pytest.approx(0.2)
    assert np.ptp(mesh.vertices[:, 1]) == pytest.approx(1.0)
    assert np.ptp(at["crotch seam"][:, 1]) == pytest.approx(0.3)
    mesh = tc.meshes.dress(length=1.1, hem=0.9, waist=0.4)
    at = {name: mesh.vertices[index] for name, index in mesh.places.items()}
    assert np.ptp(mesh.vertices[:, 1]) == pytest.approx(1.1)
    assert np.ptp(at["hem"][:, 0]) == pytest.approx(0.9)
    assert np.ptp(at["waist seam"][:, 0]) == pytest.approx(0.4)


def test_warp_runs_along_the_body_and_along_sleeves():
    mesh = tc.meshes.shirt()
    x, panels = mesh.vertices[mesh.faces], mesh.panels
    F = np.einsum("fai,faj->fij", x, mesh.shape_gradient)
    body = np.flatnonzero(np.abs(x[..., 0]).max(1) < 0.1)
    np.testing.assert_allclose(F[body][:, :, 0], np.broadcast_to([0.0, 1.0, 0.0], (len(body), 3)), atol=0.09)
    axis = mesh.vertices[mesh.places["right cuff top"][0]] - mesh.vertices[mesh.places["right shoulder"][0]]
    sleeves = np.flatnonzero(x[..., 0].min(1) > 0.3)
    along = F[sleeves][:, :, 0] @ (axis / np.linalg.norm(axis))
    np.testing.assert_allclose(along, -1.0, atol=0.01)
    assert not set(panels[sleeves]) & set(panels[body])


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: tc.meshes.shirt(length=-1.0), "length; got -1"),
        (lambda: tc.meshes.shirt(chest=float("nan")), "chest; got nan"),
        (lambda: tc.meshes.shirt(length=0.2), "overlaps it; expected panels side by side"),
        (lambda: tc.meshes.shirt(gap=-0.01), "gap; got -0.01 m"),
        (lambda: tc.meshes.shirt(triangles=40), "expected"),
        (lambda: tc.meshes.trousers(hem=0.6), "leg; got crosses the garment's middle line"),
        (lambda: tc.meshes.dress(waist_height=1.2), "skirt; got no area"),
    ],
)
def test_measures_that_give_no_garment_are_refused(call, message):
    with pytest.raises(InvalidInput, match=message):
        call()


def test_a_named_place_is_gripped():
    mesh = tc.meshes.shirt()
    shoulder = mesh.places["left shoulder"]
    assert tc.boundaries.Grasp.at("left shoulder").bind(mesh).index.tolist() == shoulder.tolist()
    pinched = tc.boundaries.Grasp.at("left shoulder", radius=0.05).bind(mesh).index.numpy()
    away = np.linalg.norm(mesh.vertices - mesh.vertices[shoulder], axis=1)
    np.testing.assert_array_equal(pinched, np.flatnonzero(away <= 0.05))
    assert {1, -1} <= set(np.sign(mesh.vertices[pinched, 2]))  # both layers
    with pytest.raises(InvalidInput, match=r"place; got 'left ear'; expected one of left shoulder, right shoulder"):
        tc.boundaries.Grasp.at("left ear").bind(mesh)
    with pytest.raises(InvalidInput, match="expected a mesh with named places"):
        tc.boundaries.Grasp.at("hem").bind(tc.meshes.rectangle(0.2, 0.2))
    with pytest.raises(InvalidInput, match="a mesh of several panels"):
        tc.boundaries.Grasp.corner("lower-left").bind(mesh)


def test_a_pattern_point_on_any_panel_is_found():
    mesh = tc.meshes.shirt(triangles=300)
    corner = int(mesh.places["left underarm"][0])
    laid = mesh.pattern[mesh.faces == corner]
    assert len(np.unique(laid, axis=0)) == 4  # body and sleeve, front and back
    for point in laid:
        assert corner in mesh.vertices_near_pattern_points(point, 1e-6)


def test_a_hung_dress_stays_sewn_and_hangs_its_length():
    """Held at the shoulders for a second: weight on the grippers, seams closed, no triangle torn."""
    mesh = tc.meshes.dress(triangles=300)
    x = mesh.vertices[:, [0, 2, 1]] * [1.0, -1.0, 1.0]  # upright
    gripped = {side: tc.boundaries.Grasp.at(f"{side} shoulder", radius=0.03) for side in ("left", "right")}
    cloth = tc.Cloth(
        mesh, tc.materials.AEP(3e5), 0.2, {"gravity": tc.effects.Gravity()}, boundaries=gripped, contact=None
    )
    pose = torch.eye(4, dtype=torch.get_default_dtype()).expand(2, 4, 4)
    motion = {side: tc.Trajectory(torch.tensor([0.0, 2.0]), pose, torch.tensor([True, True])) for side in gripped}
    start = cloth.settle(cloth.state(torch.as_tensor(x, dtype=pose.dtype)), motion, duration=1.0, rate=10.0)
    out = cloth(start, motion, [0.0, 0.05])
    weight = 9.81 * 0.2 * mesh.area.sum()
    lifted = sum(-float(out.wrench[side][-1, 2].detach()) for side in gripped)
    assert lifted == pytest.approx(weight, rel=0.05)
    assert float(np.ptp(out.x[-1, :, 2].detach().numpy())) == pytest.approx(1.05, rel=0.03)
    edges = out.x[-1].detach().numpy()[mesh.faces]
    length = np.linalg.norm(edges - np.roll(edges, 1, axis=1), axis=-1)
    rest = np.linalg.norm(mesh.rest - np.roll(mesh.rest, 1, axis=1), axis=-1)
    assert (length / rest).max() < 1.2
