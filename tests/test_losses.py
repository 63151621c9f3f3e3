"""Distances against brute force, signs, edges and derivatives."""

import numpy as np
import pytest
import torch

import torchcloth as tc
from torchcloth.engine.library import library
from torchcloth.errors import InvalidInput
from torchcloth.losses import chamfer_to_surface, chamfer_to_vertices, find_closest_points, residuals
from torchcloth.losses import nearest as search
from torchcloth.losses.surface import _find_boundary
from torchcloth.testing import check_gradients

MESH = tc.meshes.rectangle(0.3, 0.2, resolution=(5, 4))
FACES = torch.as_tensor(MESH.faces)


@pytest.fixture(params=["compiled", "torch"], autouse=True)
def searched_by(request, monkeypatch):
    """Both searches answer alike."""
    if request.param == "torch":
        monkeypatch.setattr(search, "find_nearest_triangles_compiled", lambda *_: None)
        return
    try:
        library()
    except RuntimeError as miss:
        if "no C++ compiler" not in str(miss):
            raise
        pytest.skip(str(miss))


@pytest.fixture
def vertices():
    """A wavy sheet."""
    x = torch.as_tensor(MESH.vertices).clone()
    x[:, 2] = 0.03 * torch.sin(15 * x[:, 0]) * torch.cos(9 * x[:, 1])
    return x


@pytest.fixture
def points():
    torch.manual_seed(0)
    return torch.rand(300, 3) * torch.tensor([0.5, 0.4, 0.2]) - torch.tensor([0.1, 0.1, 0.1])


def test_closest_points_against_trimesh(vertices, points):
    triangles = pytest.importorskip("trimesh").triangles
    corners = vertices[FACES].numpy()
    every = [triangles.closest_point(corners, p.expand(len(corners), 3).numpy()) for p in points]
    distance = torch.stack([(torch.as_tensor(on) - p).norm(dim=-1).min() for on, p in zip(every, points, strict=True)])
    hits = find_closest_points(points, vertices, FACES)
    torch.testing.assert_close((points - hits.interpolate(vertices)).norm(dim=-1), distance, rtol=1e-10, atol=1e-12)


def test_faces_that_are_written_to_or_made_in_inference_have_their_own_rim(vertices):
    """Which edges are open is remembered by the faces."""
    faces, beyond = FACES.clone(), vertices.mean(0) + torch.tensor([1.0, 0.0, 0.0])
    assert bool(find_closest_points(beyond[None], vertices, faces).is_beyond_edge)
    with torch.inference_mode():
        assert bool(find_closest_points(beyond[None], vertices, FACES + 0).is_beyond_edge)
    alone = find_closest_points(vertices[faces[0]].mean(0)[None], vertices, faces)
    faces[1:] = faces[0]  # all edges are of many triangles: none is open
    assert not bool(find_closest_points(beyond[None], vertices, faces).is_beyond_edge)
    assert not bool(alone.is_beyond_edge)


def test_closest_points_on_triangles_of_all_sizes(points):
    """Triangles are left out by their bounding spheres, so large ones, whose centres are far away, must stay in."""
    triangles = pytest.importorskip("trimesh").triangles
    torch.manual_seed(1)
    size = 10.0 ** (-3 + 3 * torch.rand(200, 1, 1))
    corners = torch.rand(200, 1, 3) * 0.5 + size * torch.randn(200, 3, 3)
    every = [triangles.closest_point(corners.numpy(), p.expand(200, 3).numpy()) for p in points]
    distance = torch.stack([(torch.as_tensor(on) - p).norm(dim=-1).min() for on, p in zip(every, points, strict=True)])
    hits = find_closest_points(points, corners.flatten(0, 1), torch.arange(600).view(200, 3))
    torch.testing.assert_close(
        (points - hits.interpolate(corners.flatten(0, 1))).norm(dim=-1), distance, rtol=1e-9, atol=1e-12
    )


def test_closest_points_against_dense_sampling(vertices, points):
    """Upper bound by 66 samples a triangle; they miss by at most a tenth of an edge."""
    k = torch.arange(11)
    i, j = torch.meshgrid(k, k, indexing="ij")
    weights = torch.stack([i, j, 10 - i - j], dim=-1)[i + j <= 10].double() / 10
    samples = torch.einsum("sc,fcd->fsd", weights, vertices[FACES]).reshape(-1, 3)
    sampled = torch.cdist(points, samples).min(-1).values
    exact = (points - find_closest_points(points, vertices, FACES).interpolate(vertices)).norm(dim=-1)
    assert bool((exact <= sampled + 1e-12).all())
    assert float((sampled - exact).max()) < 0.1 * 0.11


def test_weights_are_barycentric_and_chunks_change_nothing(vertices, points):
    hits = find_closest_points(points, vertices, FACES)
    assert float(hits.weights.min()) >= 0
    torch.testing.assert_close(hits.weights.sum(-1), torch.ones(len(points)))
    for chunk in (1, 1000):
        again = find_closest_points(points, vertices, FACES, chunk=chunk)
        assert all(torch.equal(a, b) for a, b in zip(again, hits, strict=True))


@pytest.mark.parametrize("searched_by", ["compiled"], indirect=True)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_both_searches_find_the_same_places(vertices, points, dtype):
    """Of two triangles that share the place, rounding decides."""
    points, corners = points.to(dtype), vertices.to(dtype)[FACES]
    result = search.find_nearest_triangles(points, corners, 10**6), search._search(points, corners)
    one, other = ((weights[..., None] * corners[face]).sum(1) for face, weights in result)
    torch.testing.assert_close(one, other, rtol=0, atol=20 * torch.finfo(dtype).eps)
    assert float((result[0][0] == result[1][0]).double().mean()) > 0.9


def test_no_place_is_near_to_what_is_not_finite(vertices, points):
    for number in (torch.nan, torch.inf):
        for which in (0, 1):
            given = [points.clone(), vertices.clone()]
            given[which][0, 1] = number
            with pytest.raises(InvalidInput, match="points or vertices; got NaN"):
                find_closest_points(*given, FACES)


def test_two_precisions_are_refused(vertices, points):
    with pytest.raises(InvalidInput, match="expected one precision"):
        find_closest_points(points.float(), vertices, FACES)


NOT_POINTS = {
    "two columns": lambda p: p[:, :2],  # each of the first three reached the compiled search as if it had three
    "one column": lambda p: p[:, :1],
    "one point": lambda p: p[0],
    "four columns": lambda p: torch.cat([p, p[:, :1]], 1),
    "six columns": lambda p: torch.cat([p, p], 1),
    "several frames": lambda p: p[None],
}


@pytest.mark.parametrize("shape", NOT_POINTS)
def test_what_is_not_points_is_refused(vertices, points, shape):
    wrong = NOT_POINTS[shape](points)
    for ask in (find_closest_points, chamfer_to_surface, lambda p, x, _: chamfer_to_vertices(p, x)):
        with pytest.raises(InvalidInput, match=r"points; got shape .*expected \[N, 3\] in metres"):
            ask(wrong, vertices, FACES)
        with pytest.raises(InvalidInput, match=r"vertices; got shape .*expected \[N, 3\] in metres"):
            ask(points, NOT_POINTS[shape](vertices), FACES)


@pytest.mark.parametrize("frames", [3, 40])
def test_faces_do_not_index_time(vertices, points, frames):
    with pytest.raises(InvalidInput, match="vertices; got shape"):
        chamfer_to_surface(points, vertices.expand(frames, -1, -1), FACES)


@pytest.mark.parametrize(
    "faces",
    [FACES[:0], FACES[0], FACES[:, :2], FACES.double(), FACES.bool(), FACES.byte(), FACES - 1, FACES + len(FACES)],
    ids=["none", "one", "edges", "floats", "flags", "bytes", "below", "above"],
)
def test_what_is_not_triangles_of_the_vertices_is_refused(vertices, points, faces):
    for ask in (find_closest_points, chamfer_to_surface):
        with pytest.raises(InvalidInput, match="faces; got"):
            ask(points, vertices, faces)


def test_no_points_have_no_mean_distance_and_hit_nothing(vertices, points):
    for distance in (lambda p: chamfer_to_surface(p, vertices, FACES), lambda p: chamfer_to_vertices(p, vertices)):
        with pytest.raises(InvalidInput, match=r"points; got .* N >= 1"):
            distance(points[:0])
    assert all(len(part) == 0 for part in find_closest_points(points[:0], vertices, FACES))


def test_a_triangle_without_an_edge_is_as_near_as_its_place(vertices, points):
    bare = vertices[FACES].clone()
    bare[0, 1] = bare[0, 0]
    face, weights = search.find_nearest_triangles(points, bare, 10**6)
    assert bool(weights.isfinite().all())
    place = (weights[..., None] * bare[face]).sum(1)
    assert float((points - place).norm(dim=1).max()) < 0.2


@pytest.mark.parametrize("order", [[0, 1, 2, 3, 4, 5], [1, 0, 2, 3, 4, 5], [3, 2, 1, 5, 4, 0]])
def test_beyond_a_vertex_of_the_rim_is_beyond(order):
    """Whichever of its triangles is hit: some touch the rim with this vertex only."""
    corners = [[-0.1, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, -0.1, 0], [-0.02, 0.04, 0], [-0.02, -0.04, 0]]
    faces = torch.tensor([[1, 4, 5], [1, 2, 4], [1, 5, 3], [2, 0, 4], [0, 3, 5], [0, 5, 4]])[order]
    x, point = torch.tensor(corners, dtype=torch.float64), torch.tensor([[0.12, 0.0, 0.0]], dtype=torch.float64)
    hits = find_closest_points(point, x, faces)
    assert bool(hits.is_beyond_edge)
    assert float(residuals(point, x, hits)[1]) == pytest.approx(0.02)


def test_residuals_of_a_flat_sheet():
    flat = torch.as_tensor(MESH.vertices)
    points = torch.tensor([
        [0.11, 0.07, 0.01],  # above
        [0.11, 0.07, -0.02],  # below
        [0.34, 0.07, 0.03],  # beyond the edge x = 0.3 by 0.04
        [0.33, 0.24, 0.0],  # beyond the corner by (0.03, 0.04)
        [0.15, 0.07, 0.01],  # above an inner edge: not beyond
    ])  # fmt: skip
    hits = find_closest_points(points, flat, FACES)
    along, tangential = residuals(points, flat, hits)
    torch.testing.assert_close(along, torch.tensor([0.01, -0.02, 0.03, 0.0, 0.01]), rtol=0, atol=1e-15)
    torch.testing.assert_close(tangential, torch.tensor([0.0, 0.0, 0.04, 0.05, 0.0]), rtol=0, atol=1e-15)
    assert hits.is_beyond_edge.tolist() == [False, False, True, True, False]


def test_points_beyond_pull_the_edge_outwards_and_points_inside_do_not_pull_it_back():
    flat = torch.as_tensor(MESH.vertices).clone().requires_grad_()
    outside, inside = torch.tensor([[0.34, 0.07, 0.0]]), torch.tensor([[0.25, 0.07, 0.0]])
    _, tangential = residuals(outside, flat, find_closest_points(outside, flat, FACES))
    (gradient,) = torch.autograd.grad(tangential.sum(), flat)
    assert float(gradient[:, 0].sum()) == pytest.approx(-1.0)  # moving the edge out by 1 shortens the distance by 1
    along, tangential = residuals(inside, flat, find_closest_points(inside, flat, FACES))
    (gradient,) = torch.autograd.grad((along + tangential).sum(), flat)
    assert float(gradient[:, :2].abs().max()) == 0.0


def test_derivatives_of_residuals_with_hits_held(vertices, points):
    hits = find_closest_points(points, vertices, FACES)

    def both(vertices, points):
        return torch.cat(residuals(points, vertices, hits))

    check_gradients(both, {"vertices": vertices, "points": points}, 1e-7)


def test_holding_the_hits_is_the_envelope_theorem(vertices, points):
    """The Chamfer distance's gradient ignores how the closest points move, and is still the whole derivative."""
    check_gradients(lambda vertices: chamfer_to_surface(points, vertices, FACES), {"vertices": vertices}, 1e-7)


def test_chamfer_distances_of_points_on_the_sheet(vertices):
    """Distance zero: value 0 (1e-16 of rounding) and no NaN in the gradient."""
    x = vertices.clone().requires_grad_()
    loss = chamfer_to_surface(vertices.clone(), x, FACES)
    assert float(loss.detach()) < 1e-16
    (gradient,) = torch.autograd.grad(loss, x)
    assert bool(torch.isfinite(gradient).all())
    loss = chamfer_to_vertices(vertices.clone(), x)
    (gradient,) = torch.autograd.grad(loss, x)
    assert float(loss.detach()) == 0.0
    assert bool(torch.isfinite(gradient).all())


def test_residuals_have_finite_gradients_inside_the_sheet(vertices):
    x = vertices.clone().requires_grad_()
    points = vertices[FACES].mean(1)
    along, tangential = residuals(points, x, find_closest_points(points, vertices, FACES))
    (gradient,) = torch.autograd.grad((along + tangential).sum(), x)
    assert bool(torch.isfinite(gradient).all())


@pytest.mark.parametrize("point", [[0.0, 0.0, 0.0], [0.0, 0.0, 0.01], [0.0, 0.07, 0.0], [0.0, 0.07, 0.01]], ids=str)
def test_residuals_have_finite_gradients_on_the_edge(point):
    """Exactly on the rim or straight above it: the distance beside the sheet is zero."""
    flat = torch.as_tensor(MESH.vertices).clone().requires_grad_()
    points = torch.tensor([point])
    along, tangential = residuals(points, flat, find_closest_points(points, flat, FACES))
    (gradient,) = torch.autograd.grad((along + tangential).sum(), flat)
    assert float(tangential.detach()) == 0.0
    assert bool(torch.isfinite(gradient).all())


def test_chamfer_values():
    flat = torch.as_tensor(MESH.vertices)
    points = torch.tensor([[0.11, 0.07, 0.01], [0.11, 0.07, -0.03]])
    assert float(chamfer_to_surface(points, flat, FACES)) == pytest.approx(0.02)
    assert float(chamfer_to_vertices(points, flat)) > 0.02  # to vertices: never smaller
    assert float(chamfer_to_vertices(flat[3:5] + torch.tensor([0.0, 0.0, 0.005]), flat)) == pytest.approx(0.005)


def test_the_norms_of_distances_to_vertices_by_hand():
    """The second mesh has another nearest vertex in each norm: (3, 3, 3) m away, or (0, 6, 0) m."""
    corners = torch.tensor([[0.0, 0.0, 0.0], [10.0, 3.4, 0.0]], dtype=torch.float64)
    points = torch.tensor([[3.0, 4.0, 0.0], [10.0, 3.4, 2.0]], dtype=torch.float64)
    assert float(chamfer_to_vertices(points, corners)) == pytest.approx((5 + 2) / 2)
    assert float(chamfer_to_vertices(points, corners, norm=1)) == pytest.approx((7 + 2) / 2)
    others = torch.tensor([[6.0, 7.0, 3.0], [3.0, 10.0, 0.0]], dtype=torch.float64)
    assert float(chamfer_to_vertices(points[:1], others)) == pytest.approx(27**0.5)
    assert float(chamfer_to_vertices(points[:1], others, norm=1)) == pytest.approx(6.0)
    with pytest.raises(InvalidInput, match="norm; got 3; expected 1 or 2"):
        chamfer_to_vertices(points, corners, norm=3)


def test_float32(vertices, points):
    exact = chamfer_to_surface(points, vertices, FACES)
    got = chamfer_to_surface(points.float(), vertices.float(), FACES)
    assert got.dtype == torch.float32
    torch.testing.assert_close(got.double(), exact, rtol=1e-5, atol=0)


def test_arrays_are_taken_as_recordings_and_meshes_hold_them():
    mesh = tc.meshes.rectangle(0.3, 0.2, resolution=(4, 3))
    x, cloud = torch.as_tensor(mesh.vertices), np.add(mesh.vertices, [0.01, 0.0, 0.02])
    wanted = chamfer_to_surface(torch.as_tensor(cloud), x, torch.as_tensor(mesh.faces))
    assert torch.equal(chamfer_to_surface(cloud, x, mesh.faces), wanted)
    assert torch.equal(chamfer_to_surface(cloud, mesh.vertices, mesh.faces), wanted)
    hits = find_closest_points(cloud, mesh.vertices, mesh.faces)
    result, expected = residuals(cloud, mesh.vertices, hits), residuals(torch.as_tensor(cloud), x, hits)
    assert all(map(torch.equal, result, expected))
    assert torch.equal(chamfer_to_vertices(cloud, x), chamfer_to_vertices(torch.as_tensor(cloud), x))


def test_gradients_by_torch_func_are_those_of_backward():
    mesh = tc.meshes.rectangle(0.3, 0.2, resolution=(4, 3))
    x, faces = torch.as_tensor(mesh.vertices), torch.as_tensor(mesh.faces)
    cloud, parameter = x + torch.tensor([0.01, 0.0, 0.02]), x.clone().requires_grad_()
    (wanted,) = torch.autograd.grad(chamfer_to_surface(cloud, parameter, faces), parameter)
    torch.testing.assert_close(torch.func.grad(lambda x: chamfer_to_surface(cloud, x, faces))(x), wanted)


def test_edges_of_large_meshes_have_numbers_of_their_own():
    """In 32 bits two edges got the same, and open ones passed for closed."""
    faces = torch.tensor([[28_633, 28_634, 150_000], [0, 39_971, 149_999]])  # 28633 * 150001 + 28634 is 39971 + 2^32
    for each in (faces, faces.int()):
        assert bool(_find_boundary(each)[0].all())


def test_a_triangle_without_area_gives_no_nan():
    x = torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 1, 0]], dtype=torch.float64, requires_grad=True)
    faces, point = torch.tensor([[0, 1, 2]]), torch.tensor([[0.5, 0.0, 0.2]], dtype=torch.float64)
    along, tangential = residuals(point, x, find_closest_points(point, x, faces))
    (along.sum() + tangential.sum()).backward()
    assert torch.isfinite(along).all()
    assert torch.isfinite(tangential).all()
    assert torch.isfinite(x.grad).all()
