"""Seen and hidden, on a flat sheet where it can be counted."""

import pytest
import torch

import torchcloth as tc
from torchcloth.episodes.streams import locate_on_pattern
from torchcloth.identification import Episode
from torchcloth.pose.visibility import edges_between_points, find_seen_vertices

SIDE, ROWS = 0.3, 7


@pytest.fixture
def mesh():
    return tc.meshes.rectangle(SIDE, SIDE, resolution=(ROWS, ROWS))


def episode(mesh, clouds, **more):
    x = torch.as_tensor(mesh.vertices)
    return Episode("flat", {}, torch.arange(len(clouds)).double(), clouds, x, False, None, **more)


def dense(below, count=2000):
    """[N, 3] m, on the part of the sheet with u below something, 1 mm off it."""
    uv = torch.rand(count, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * SIDE
    uv = uv[uv[:, 0] < below]
    return torch.cat([uv, torch.full((len(uv), 1), 1e-3, dtype=torch.float64)], dim=1)


def test_half_a_sheet(mesh):
    x = torch.as_tensor(mesh.vertices).expand(3, -1, -1)
    away = dense(SIDE) + torch.tensor([0.0, 0.0, 0.1])
    data = episode(mesh, [dense(0.149), torch.zeros(0, 3), away])
    assert edges_between_points(data, mesh) == 1
    seen = find_seen_vertices(x, data, mesh)
    u = torch.as_tensor(mesh.uv)[:, 0]
    torch.testing.assert_close(seen[0], u < 0.151)
    assert not seen[1].any()  # no points
    assert not seen[2].any()  # points that are not of this cloth


def test_few_points_tell_of_their_surroundings(mesh):
    """A point for every four vertices: none of them is hidden."""
    uv = torch.cartesian_prod(*2 * [torch.linspace(0.0375, 0.2625, 4, dtype=torch.float64)])
    cloud = torch.nn.functional.pad(uv, (0, 1))
    data = episode(mesh, [cloud])
    assert edges_between_points(data, mesh) == 2
    assert find_seen_vertices(torch.as_tensor(mesh.vertices)[None], data, mesh).all()


def test_markers(mesh):
    uv = torch.tensor([[0.01, 0.01], [0.29, 0.29]], dtype=torch.float64)
    markers = torch.tensor([[[0.01, 0.01, 0.0], [torch.nan] * 3]], dtype=torch.float64)
    data = episode(mesh, [torch.zeros(0, 3)], markers=markers, marker_places=locate_on_pattern(mesh, uv.numpy()))
    seen = find_seen_vertices(torch.as_tensor(mesh.vertices)[None], data, mesh)
    assert seen[0].sum() == 3
    assert float(torch.as_tensor(mesh.uv)[seen[0]].max()) < 0.06
