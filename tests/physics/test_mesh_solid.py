"""Closed meshes as bodies, and what is no body."""

import sys

import pytest
import torch
from helpers.collider_scenes import make_box_mesh

import torchcloth as tc
from torchcloth.boundaries import (
    Box,
    Capsule,
    Coulomb,
    Cylinder,
    Elliptic,
    MeshSolid,
    Plane,
    Sphere,
    Stribeck,
)
from torchcloth.errors import InvalidInput, MissingDependency, SimulationDiverged


def test_a_state_dict_leaves_a_solid_what_it_is():
    """Two grids of one shape: a solid and another of twice its size."""
    small = MeshSolid(*make_box_mesh((0.1, 0.08, 0.06), (0, 0, 0)), cell=0.01)
    large = MeshSolid(*make_box_mesh((0.2, 0.16, 0.12), (0, 0, 0)), cell=0.02)
    p = torch.tensor([[0.07, 0.01, 0.0], [0.0, 0.0, 0.02]])
    before = small.distance(p)[0]
    assert not torch.equal(before, large.distance(p)[0])
    small.load_state_dict(large.state_dict())
    assert torch.equal(small.distance(p)[0], before)


@pytest.mark.parametrize("cell", [0.012, 0.006])
def test_a_mesh_solid_is_the_solid_that_its_mesh_draws(cell):
    """Against closed forms: a ball's surface to cell^2 / (4 r), a box's faces exactly and its edges to half a cell."""
    trimesh = pytest.importorskip("trimesh")
    torch.manual_seed(0)
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.06)
    with torch.no_grad():
        p = 0.06 * torch.nn.functional.normalize(torch.randn(2000, 3), dim=-1)
        distance, normal = MeshSolid(ball.vertices, ball.faces, cell=cell).distance(p)
        assert float(distance.abs().max()) < 1.1 * cell**2 / (4 * 0.06) + 1e-4  # the mesh itself cuts corners
        assert float(torch.linalg.cross(normal, p / 0.06).norm(dim=-1).max()) < 1.0 * cell / 0.06
        size = (0.16, 0.12, 0.1)
        p = 0.18 * (torch.rand(20000, 3) - 0.5)
        got, _ = MeshSolid(*make_box_mesh(size, (0, 0, 0)), cell=cell).distance(p)
        exact, _ = Box(size).distance(p)
        error = (got - exact).abs()
        near = exact.abs() < 0.003
        inner = (p.abs() - torch.tensor(size) / 2).sort(-1).values[:, 1:2] < -2 * cell  # far from edges
        assert float(error[near].max()) < 0.5 * cell
        assert float(error[near & inner].max()) < 1e-7  # open3d computes in float32


@pytest.mark.parametrize("engine", ["reference", "auto"])
def test_a_cloth_that_is_lost_beside_a_mesh_is_said_to_diverge(engine):
    solid = MeshSolid(*make_box_mesh((0.1, 0.08, 0.06), (0, 0, 0)), cell=0.01)
    cloth = tc.Cloth(tc.meshes.rectangle(0.1, 0.1, resolution=(4, 4)), tc.materials.AEP(1e4), 0.2, {}, {"body": solid})
    cloth.engine = engine
    x = cloth.rest_state().x
    with pytest.raises(SimulationDiverged), torch.no_grad():
        cloth(cloth.state(x, torch.full_like(x, 1e200)), times=[0.0, 0.01])


@pytest.mark.parametrize(
    ("make", "word"),
    [
        (lambda: Sphere(0.0), "radius"),
        (lambda: Sphere(0.1, (0.0, 0.0)), "centre"),
        (lambda: Box((0.1, -0.1, 0.1)), "box size"),
        (lambda: Box((0.1, 0.1)), "box size"),
        (lambda: Box((0.1, 0.1, 0.1), 2 * torch.eye(4)), "pose"),
        (lambda: Capsule((0, 0, 0), (0, 0, 0), 0.1), "axis"),
        (lambda: Cylinder((0, 0, 0), (0, 0, 1), -0.1), "radius"),
        (lambda: Plane(normal=(0.0, 0.0, 0.0)), "plane normal"),
        (lambda: Plane(friction=-0.1), "friction"),
        (lambda: Plane(friction=Elliptic(0.3, 0.2, (0.0, 0.0, 1.0))), "friction axis"),
        (lambda: Elliptic(0.3, 0.2, (0.0, 0.0, 0.0)), "friction axis"),
        (lambda: Elliptic(0.0, 0.2), "along"),
        (lambda: Stribeck(0.4, 0.3), "static minus kinetic"),
        (lambda: Stribeck(0.3, 0.4, 0.0), "speed"),
        (lambda: Coulomb(float("nan")), "friction"),
        (lambda: Plane(offset=-1e-3), "offset"),
        (lambda: Plane(sampling=0.0), "sampling"),
        (lambda: Plane(recovery=-1.0), "recovery"),
        (lambda: MeshSolid(*_open_block()), "solid mesh"),
        (lambda: MeshSolid(*make_box_mesh((1, 1, 1), (0, 0, 0)), cell=0.0), "cell"),
        (lambda: MeshSolid(*make_box_mesh((1, 1, 1), (0, 0, 0)), cell=1e-3), "grid nodes"),
    ],
)
def test_refuses_what_is_no_body(make, word):
    with pytest.raises(InvalidInput, match=word):
        make()


def test_a_mesh_solid_without_open3d_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(MissingDependency, match="torchcloth\\[observe\\]"):
        MeshSolid(*make_box_mesh((1, 1, 1), (0, 0, 0)))


def _open_block():
    vertices, faces = make_box_mesh((1, 1, 1), (0, 0, 0))
    return vertices, faces[1:]
