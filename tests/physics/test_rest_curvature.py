"""Sheets that are not flat at rest."""

import math

import pytest
import torch
from helpers.bent_shapes import make_effect_inputs, make_irregular_mesh, measure_momentum_drift, roll_to_cylinder

import torchcloth as tc
from torchcloth.testing import check_gradients


def relaxed(mesh, x, bending, duration=0.4):
    cloth = tc.Cloth(
        mesh,
        tc.materials.AEP(2e3, 0.02),
        0.2,
        {"bending": bending, "damping": tc.effects.MassDamping(60.0)},
        contact=None,
    )
    with torch.no_grad():
        return cloth(cloth.state(x), times=(0.0, duration)).x[-1]


def turn_of(x, columns):
    """Angle [rad] by which the strip turns from its first cells to its last, signed about +y, and the arc between."""
    line = x.unflatten(0, (columns, -1)).mean(1)
    step = line[1:] - line[:-1]
    angle = torch.atan2(step[:, 2], step[:, 0])
    turns = torch.remainder(angle[1:] - angle[:-1] + math.pi, 2 * math.pi) - math.pi
    return turns.sum().item(), (step[1:-1].norm(dim=-1).sum() + (step[0].norm() + step[-1].norm()) / 2).item()


@pytest.mark.parametrize(
    ("kind", "curl"),
    [("warp", {"curl_warp": 20.0}), ("weft", {"curl_weft": -20.0}), ("woven", {"curl_warp": 20.0, "weft_ratio": 0.3})],
)
def test_a_strip_rolls_to_its_rest_curvature(kind, curl):
    """No gravity: radius 1 / kappa0 towards the side of the normal. Reached: 0.02 %."""
    columns = 21
    mesh = tc.meshes.rectangle(0.15, 0.015, resolution=(columns, 3))
    if kind == "weft":
        uv = mesh.uv[:, ::-1] * [1, -1]  # along x now lies the weft; the normal stays
        mesh = tc.meshes.Mesh.build(mesh.vertices, mesh.faces, uv)
    x = relaxed(mesh, torch.as_tensor(mesh.vertices), tc.effects.Bending(1e-3, **curl))
    turn, arc = turn_of(x, columns)
    assert turn / arc == pytest.approx(-20.0 if kind == "weft" else 20.0, rel=0.01)


def test_the_curl_follows_the_material_side():
    """Turned over, the strip curls the other way in the world, and is the turned shape of the first."""
    columns = 11
    mesh = tc.meshes.rectangle(0.1, 0.02, resolution=(columns, 3))
    bending = tc.effects.Bending(1e-3, curl_warp=15.0)
    flat = torch.as_tensor(mesh.vertices)
    over = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
    up, down = (relaxed(mesh, start, bending, 0.05) for start in (flat, flat @ over))
    assert turn_of(up, columns)[0] > 0.5
    assert turn_of(down, columns)[0] == pytest.approx(-turn_of(up, columns)[0], rel=1e-9)
    torch.testing.assert_close(down, up @ over, rtol=0, atol=1e-9)


@pytest.mark.parametrize("degrees", [0, 90])
def test_the_rest_shape_is_free_of_force(degrees):
    """A cylinder of the rest curvature. What is left comes from the rim's fit: 2 % of the force when flat."""
    mesh = tc.meshes.rectangle(0.3, 0.3, resolution=(33, 33))
    name = "curl_weft" if degrees else "curl_warp"
    bending = tc.effects.Bending(1e-3, **{name: 4.0}).bind(mesh)
    c = bending.coefficients()
    x, flat = roll_to_cylinder(mesh, 4.0, degrees), torch.as_tensor(mesh.vertices)
    assert bending.energy(c, x).item() < 1e-4 * bending.energy(c, flat).item()
    rest, loaded = (bending.force(c, make_effect_inputs(mesh, y)).norm().item() for y in (x, flat))
    assert rest < 0.03 * loaded


OPTIONS = [
    {"curl_warp": 3.0},
    {"curl_warp": 3.0, "curl_weft": -2.0, "weft_ratio": 0.4, "twist_ratio": 0.6, "poisson": 0.3},
    {"weft_ratio": 0.4, "poisson": 0.2},
    {"stiffness": 1e-5 * torch.linspace(0.5, 2.0, 50), "curl_weft": 1.0},
]


@pytest.mark.parametrize("options", OPTIONS)
def test_force_is_minus_the_gradient_of_the_energy(options):
    mesh = make_irregular_mesh(6)
    bending = tc.effects.Bending(**{"stiffness": 2e-5, **options}).bind(mesh)
    c = bending.coefficients()
    x = torch.as_tensor(mesh.vertices) + 0.02 * torch.randn(36, 3, generator=torch.Generator().manual_seed(0))
    check_gradients(lambda x: bending.energy(c, x), {"x": x}, 1e-7)
    x.requires_grad_()
    (gradient,) = torch.autograd.grad(bending.energy(c, x).sum(), x)
    torch.testing.assert_close(bending.force(c, make_effect_inputs(mesh, x)), -gradient, rtol=1e-10, atol=1e-14)


@pytest.mark.parametrize("options", OPTIONS)
def test_momentum_and_angular_momentum_are_kept(options):
    linear, angular = measure_momentum_drift({"bending": tc.effects.Bending(**{"stiffness": 1e-3, **options})})
    assert linear < 1e-9
    assert angular < 1e-9


def test_a_garment_lying_flat_is_no_trouble():
    """Rings at its seams lie folded on themselves and have no normal: the couples there must fade, not grow."""
    mesh = tc.meshes.shirt(triangles=150)
    effects = {"gravity": tc.effects.Gravity(), "bending": tc.effects.Bending(1e-4, 0.01, curl_warp=30.0)}
    cloth = tc.Cloth(mesh, tc.materials.AEP(1e5), 0.15, effects, contact=None)
    with torch.no_grad():
        out = cloth(cloth.rest_state(), times=[0.0, 0.1])
    tangential = out.v[-1] - torch.tensor([0.0, 0.0, -0.981])
    assert float(tangential.norm(dim=-1).max()) < 0.7  # 1.0 without the fading
