"""Contact points on triangles keep small bodies out."""

import pytest
import torch
from helpers.collider_scenes import make_sheet, simulate_sliding, translate_along_z

import torchcloth as tc
from torchcloth.boundaries import (
    Box,
    Capsule,
    Sphere,
)
from torchcloth.boundaries.points import TrianglePoints


def test_points_on_triangles_do_not_make_a_landing_bounce():
    """Impulses of many points per vertex: of the energy at 1 m/s less than a hundredth comes back (0.1 % measured)."""
    cloth = make_sheet({"block": Box((1.0, 1.0, 0.2), translate_along_z(-0.1), sampling=0.01)}, n=6)
    x = cloth.rest_state().x + torch.tensor([-0.05, -0.05, 0.002])
    with torch.no_grad():
        out = cloth(cloth.state(x, torch.tensor([0.0, 0.0, -1.0]).expand_as(x)), times=torch.linspace(0, 0.03, 16))
    energy = (out.v**2).sum((-2, -1))
    assert float(energy[2:].max()) < 0.01 * float(energy[0])
    assert float(out.x[..., 2].min()) > -1e-9


@pytest.mark.parametrize(
    ("body", "vertices_alone", "sampled"),
    [
        (lambda **o: Sphere(0.08, (0, 0, -0.08), **o), 1.0, 0.2),
        (lambda **o: Capsule((-0.1, 0, -0.02), (0.1, 0, -0.02), 0.02, **o), 2.5, 0.5),
        (lambda **o: Box((0.1, 0.1, 0.1), translate_along_z(-0.05), **o), 4.0, 2.0),
    ],
    ids=["sphere", "capsule", "box"],
)
def test_points_on_triangles_keep_small_bodies_out(body, vertices_alone, sampled):
    """A sheet of 2 cm edges draped over the body: deepest place of any triangle [mm], without points and with."""
    fine = TrianglePoints(tc.meshes.rectangle(0.2, 0.2, resolution=(11, 11)), 0.002)
    depths = []
    for sampling in (None, 0.005):
        solid = body(sampling=sampling, friction=0.3)
        damping = {"air": tc.effects.AirDrag(1.2)}
        cloth = make_sheet({"body": solid}, size=0.2, n=11, effects=damping, E=5e4)
        x = cloth.rest_state().x - torch.tensor([0.103, 0.102, -0.002])
        with torch.no_grad():
            out = cloth(cloth.state(x), times=torch.linspace(0, 0.25, 6))
            depths.append(-1e3 * float(solid.clearance(fine.interpolate(out.x))[0].min()))
    assert depths[0] > vertices_alone
    assert depths[1] < sampled


def test_an_offset_is_a_thicker_body():
    thick, large = (
        simulate_sliding(Sphere(r, (0, 0, -0.3), friction=0.3, offset=o), 0.4) for r, o in ((0.29, 0.01), (0.3, 0.0))
    )
    torch.testing.assert_close(thick, large, rtol=0, atol=1e-8)


def test_points_share_impulses_without_losing_momentum():
    mesh = tc.meshes.rectangle(0.1, 0.1, resolution=(5, 4))
    points = TrianglePoints(mesh, 0.008)
    torch.manual_seed(0)
    x = torch.as_tensor(mesh.vertices)
    mass = 0.1 + torch.rand(len(x), 1)  # of hems, pockets, wet places
    some = torch.randn_like(points.interpolate(x)) * (torch.rand(len(points.interpolate(x)), 1) < 0.3)
    alone = torch.zeros_like(some)
    alone[37] = some.abs().amax(0) + 1
    torch.testing.assert_close(
        points.interpolate(points.distribute(alone, mass))[37], alone[37]
    )  # one point: exactly as wanted
    same = torch.ones_like(some)
    even = torch.as_tensor(mesh.vertex_area)[:, None]
    torch.testing.assert_close(
        points.distribute(same, even), torch.ones_like(x), rtol=0, atol=0.15
    )  # all alike: nearly
    change = points.distribute(alone, mass)
    linear, angular = (mass * change).sum(0), torch.linalg.cross(x, mass * change).sum(0)
    torch.testing.assert_close(angular, torch.linalg.cross(points.interpolate(x)[37], linear))  # it acts at the point
    batch = points.distribute(torch.stack([some, alone]), mass)
    torch.testing.assert_close(batch[1], change)


@pytest.mark.parametrize("engine", ["fused", "reference"])
@pytest.mark.parametrize("hem", [4.5e-3, 2e-2])  # kg/m
def test_a_heavy_hem_at_rest_is_not_thrown_up(engine, hem):
    """Cloth beside it lands: what is stopped there takes the hem along by its mass, not as if it were light cloth."""
    table, effects = tc.boundaries.Plane(friction=0.0, sampling=0.003), {"hem": tc.effects.LineMass(hem)}
    cloth = make_sheet({"table": table}, None, n=11, effects=effects, E=1.0, density=0.1)
    cloth.engine = engine
    x = cloth.rest_state().x
    inwards = torch.minimum(x[:, :2], 0.1 - x[:, :2]).amin(-1)
    x[:, 2] = torch.where(inwards < 0.015, 1e-7, 0.05)
    v = torch.zeros_like(x)
    v[:, 2] = torch.where((inwards > 0.005) & (inwards < 0.015), -1.0, 0.0)
    with torch.no_grad():
        out, mass = cloth(cloth.state(x, v), times=[0.0, 1e-4]), cloth.build_model().mass
    assert float((mass * out.v[-1] ** 2).sum()) < 0.2 * float((mass * v**2).sum())
    assert float(out.v[-1][inwards < 0.005, 2].max()) < 0.2
