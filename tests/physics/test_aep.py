"""The A-EP law against its own energy, symmetry and the paper's QR form."""

import pytest
import torch

import torchcloth as tc
from torchcloth.dynamics import elasticity, forces, substep
from torchcloth.dynamics.contact import self_contact
from torchcloth.materials import AEP


def random_cloth(convention="plane_stress", points=2, seed=0):
    torch.manual_seed(seed)
    mesh = tc.meshes.rectangle(0.2, 0.2, resolution=(4, 3))
    material = AEP(1e5, 0.3, contact_stiffness=4e5, shear_stiffness=7e4, cone=0.4, convention=convention)
    contact = tc.Contact(spacing=mesh.mean_edge, subdivisions=points, everywhere=True)
    return tc.Cloth(mesh, material, 0.2, contact=contact)


def deformed(cloth, scale=0.25, seed=1):
    """Stretched, sheared, compressed, rotated triangles and tilted, compressed directors."""
    torch.manual_seed(seed)
    rotation = torch.linalg.qr(torch.randn(3, 3))[0]
    x = cloth.rest_state().x @ rotation.mT + scale * 0.05 * torch.randn(len(cloth.mesh.vertices), 3)
    state = cloth.state(x)
    return state._replace(d3=0.9 * state.d3 + 0.1 * torch.randn_like(state.d3))


def potential(cloth, state):
    energy = cloth.energy(state)
    return energy["membrane"] + energy["director"]


@pytest.mark.parametrize("convention", ["plane_stress", "paper"])
@pytest.mark.parametrize("seed", range(4))
def test_forces_are_minus_the_gradient_of_the_energy(convention, seed):
    cloth = random_cloth(convention)
    state = deformed(cloth, seed=seed)
    x, d3 = state.x.clone().requires_grad_(), state.d3.clone().requires_grad_()
    by_x, by_d3 = torch.autograd.grad(potential(cloth, state._replace(x=x, d3=d3)), (x, d3))
    model = cloth.build_model()
    s = substep.surface(model.geometry, state.x, state.v)
    layers = self_contact.find_contact_candidates(model, model.grid, state.x)
    director = self_contact.compute_director_forces(model, model.grid, layers, state, s, 1e-4, substep=0)
    columns = self_contact.add_director_stress(layers, elasticity.membrane_stress(model, s, {}), director)
    force = forces.vertex_forces(model, state, s, {}, columns)
    torch.testing.assert_close(force, -by_x, rtol=1e-10, atol=1e-10 * by_x.abs().max())
    torch.testing.assert_close(director.energy_by_d3, by_d3, rtol=1e-10, atol=1e-10 * by_d3.abs().max())


def test_energy_equals_the_singular_value_form_of_the_paper():
    cloth = random_cloth("paper")
    state = deformed(cloth)
    model = cloth.build_model()
    s = substep.surface(model.geometry, state.x, state.v)
    F = torch.stack([s.f1, s.f2], dim=-1)
    sigma = torch.linalg.svdvals(F)
    E, nu, h = 1e5, 0.3, 1e-3
    mu, lam = h * E / (2 * (1 + nu)), h * E * nu / ((1 + nu) * (1 - 2 * nu))
    expected = mu * ((sigma - 1) ** 2).sum(-1) + lam / 2 * (sigma.prod(-1) - 1) ** 2
    torch.testing.assert_close(model.material.membrane_energy(model.coefficients, s)[..., 0], expected)
    d = state.d3.unflatten(0, (-1, 4))[:, 0]
    R = torch.linalg.qr(torch.cat([F, d.unsqueeze(-1)], dim=-1)).R
    R = R * torch.sign(torch.diagonal(R, dim1=-2, dim2=-1))[..., None]
    r, r33 = R[:, :2, 2], R[:, 2, 2]
    k, gamma = 4e5 * h, 7e4 * h
    expected = gamma * (r**2).sum(-1) + k / 3 * (1 - r33).clamp(min=0) ** 3
    c = type(model.coefficients)(*(value.unsqueeze(-2) for value in model.coefficients))
    density = model.material.director_energy(c, s.n[:, None], d[:, None])[..., 0, 0]
    torch.testing.assert_close(density, expected)


def test_rest_is_stress_free():
    cloth = random_cloth()
    model = cloth.build_model()
    state = cloth.rest_state()
    s = substep.surface(model.geometry, state.x, state.v)
    for column in model.material.membrane_stress(model.coefficients, s):
        assert column.abs().max() < 1e-10
    assert sum(abs(e.item()) for e in cloth.energy(state).values()) < 1e-20


def test_energy_is_frame_indifferent():
    cloth = random_cloth()
    state = deformed(cloth)
    rotation = torch.linalg.qr(torch.randn(3, 3))[0]
    rotation = rotation * torch.det(rotation)
    turned = state._replace(x=state.x @ rotation.mT + 3.0, d3=state.d3 @ rotation.mT)
    torch.testing.assert_close(potential(cloth, turned), potential(cloth, state), rtol=1e-12, atol=0)


def test_return_map_is_idempotent_and_lands_on_the_cone():
    material = AEP(1e5, 0.3, contact_stiffness=4e5, shear_stiffness=7e4, cone=0.4)
    c = material.coefficients()
    torch.manual_seed(0)
    n = torch.nn.functional.normalize(torch.randn(500, 3), dim=-1)
    d3 = n * (1 + 0.3 * torch.randn(500, 1)) + 0.3 * torch.randn(500, 3)
    once = material.return_map(c, n, d3)
    torch.testing.assert_close(material.return_map(c, n, once), once, rtol=1e-12, atol=1e-14)
    height = (n * once).sum(-1)
    shear = (once - height[:, None] * n).norm(dim=-1)
    separated = (n * d3).sum(-1) > 1
    torch.testing.assert_close(once[separated], n[separated])
    pressed = ~separated
    assert bool((7e4 * shear[pressed] <= 0.4 * 4e5 * (1 - height[pressed]) ** 2 + 1e-9).all())
    assert int(separated.sum()) > 50
    assert int(pressed.sum()) > 50


def test_return_map_has_finite_gradients_at_rest():
    material = AEP(1e5, cone=0.0)
    n = torch.tensor([[0.0, 0.0, 1.0]])
    d3 = n.clone().requires_grad_()
    material.return_map(material.coefficients(), n, d3).sum().backward()
    assert torch.isfinite(d3.grad).all()
    assert all(p.grad is None or torch.isfinite(p.grad).all() for p in material.parameters())


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        ({"youngs_modulus": -1.0}, "youngs_modulus"),
        ({"youngs_modulus": 1e5, "poisson_ratio": 0.5}, "poisson_ratio"),
        ({"youngs_modulus": float("nan")}, "youngs_modulus"),
        ({"youngs_modulus": 1e5, "cone": -0.1}, "cone"),
        ({"youngs_modulus": 1e5, "thickness": 0.0}, "thickness"),
        ({"youngs_modulus": 1e5, "convention": "3d"}, "convention"),
    ],
)
def test_illegal_values_are_refused_by_name(arguments, name):
    with pytest.raises(tc.errors.InvalidInput, match=name):
        AEP(**arguments)


def test_preset_and_setting_a_value():
    cotton = AEP.preset("cotton")
    assert float(cotton.membrane_stiffness.detach()) == pytest.approx(609.02)
    cotton.youngs_modulus.set(2e5)
    assert float(cotton.membrane_stiffness) == pytest.approx(200.0)
    with pytest.raises(tc.errors.InvalidInput, match="youngs_modulus; got -1 Pa"):
        cotton.youngs_modulus.set(-1.0)
    assert float(cotton.membrane_stiffness) == pytest.approx(200.0)
    with pytest.raises(tc.errors.InvalidInput, match="artificial_silk"):
        AEP.preset("velvet")


@pytest.mark.parametrize("strain", [1e-2, 1e-3, 1e-4])
def test_the_energy_of_small_strains_has_its_digits_in_float32(strain):
    energies = []
    for dtype in (torch.float64, torch.float32):
        cloth = tc.Cloth(tc.meshes.rectangle(0.4, 0.4, triangles=72), AEP(5e4), 0.2, contact=None).to(dtype)
        turn = torch.tensor([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]]).to(dtype)
        x = (cloth.rest_state().x * (1 + strain)) @ turn.mT
        energies.append(float(cloth.energy(cloth.state(x))["membrane"]))
    assert energies[1] == pytest.approx(energies[0], rel=0.02 if strain < 1e-3 else 2e-3)
