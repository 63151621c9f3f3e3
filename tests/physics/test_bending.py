"""Bending against plate theory."""

import math

import pytest
import torch

import torchcloth as tc


@pytest.mark.parametrize("degrees", [0, 30, 45, 90])
@pytest.mark.parametrize(("n", "tolerance"), [(17, 0.12), (33, 0.06)])
def test_energy_of_a_cylinder_in_any_direction(n, tolerance, degrees):
    mesh = tc.meshes.rectangle(0.3, 0.3, resolution=(n, n))
    bending = tc.effects.Bending(2e-5).bind(mesh)
    radius = 0.2
    u, v = torch.as_tensor(mesh.uv).T
    a = math.radians(degrees)
    u, v = math.cos(a) * u + math.sin(a) * v, math.cos(a) * v - math.sin(a) * u
    x = torch.stack([radius * torch.sin(u / radius), v, radius * (1 - torch.cos(u / radius))], dim=-1)
    energy = bending.energy(bending.coefficients(), x)
    assert energy.item() == pytest.approx(0.5 * 2e-5 / radius**2 * 0.09, rel=tolerance)


def test_force_is_minus_the_gradient_of_the_energy():
    mesh = tc.meshes.rectangle(0.2, 0.3, resolution=(5, 6))
    cloth = tc.Cloth(mesh, tc.materials.AEP(1e5), 0.2, {"bending": tc.effects.Bending(2e-5)}, contact=None)
    bending = cloth.effects["bending"]
    torch.manual_seed(0)
    x = (cloth.rest_state().x + 0.02 * torch.randn(30, 3)).requires_grad_()
    c = bending.coefficients()
    (gradient,) = torch.autograd.grad(bending.energy(c, x), x)
    force = bending.force(c, tc.ClothState(x, torch.zeros_like(x), x[:0]), None, None)
    torch.testing.assert_close(force, -gradient, rtol=1e-10, atol=1e-12)


def test_rigid_motion_costs_nothing():
    mesh = tc.meshes.rectangle(0.2, 0.3, resolution=(5, 6))
    bending = tc.effects.Bending(2e-5).bind(mesh)
    rotation = torch.linalg.qr(torch.randn(3, 3))[0]
    x = torch.as_tensor(mesh.vertices) @ rotation.mT + 1.0
    assert bending.energy(bending.coefficients(), x).item() < 1e-20


def test_vibration_of_a_narrow_cantilever():
    """A strip clamped at one end: first bending frequency 3.516 / (2 pi L^2) sqrt(B / rho_A).

    The amplitude is many times sqrt(B / Y) = 1.4 mm: the form assumes that bending does not stretch.
    """
    length, B, density = 0.1, 2e-4, 0.2
    mesh = tc.meshes.rectangle(length, 0.02, resolution=(21, 5))
    clamped = torch.nonzero(torch.as_tensor(mesh.uv[:, 0]) < 0.0051).flatten().tolist()  # two columns: no rotation
    cloth = tc.Cloth(
        mesh, tc.materials.AEP(1e5, 0.02), density, {"bending": tc.effects.Bending(B)},
        {"clamp": tc.boundaries.Grasp(clamped)}, contact=None,
    )  # fmt: skip
    free = length - 0.005
    still = tc.Trajectory(torch.tensor([0.0, 9.0]), torch.eye(4).repeat(2, 1, 1), torch.ones(2, dtype=bool))
    s = ((torch.as_tensor(mesh.uv[:, 0]) - 0.005) / free).clamp(min=0)
    x = cloth.rest_state().x.clone()
    x[:, 2] = 8e-3 * (s**2) * (6 - 4 * s + s**2) / 3  # static shape under uniform load: close to the first mode
    period = 2 * math.pi * free**2 / 3.516 * math.sqrt(density / B)
    with torch.no_grad():
        out = cloth(cloth.state(x), {"clamp": still}, times=torch.linspace(0, period, 41))
    tip = out.x[:, mesh.uv[:, 0] == mesh.uv[:, 0].max(), 2].mean(-1)
    assert tip[-1].item() == pytest.approx(8e-3, rel=0.1)
    assert tip[20].item() == pytest.approx(-8e-3, rel=0.1)
