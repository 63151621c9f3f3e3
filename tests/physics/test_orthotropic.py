"""The orthotropic membrane against Hooke's law, the isotropic law, strips in a machine, and springs in series."""

from math import cos, radians, sin

import pytest
import torch
from helpers.tension_strips import Strip

import torchcloth as tc
from torchcloth.dynamics.stability import STABLE_STEP_OVER_LINEAR_LIMIT, StabilityLimits, bound_squared_frequency
from torchcloth.materials import AEP, OrthotropicAEP
from torchcloth.testing import samples

WARP, WEFT, SHEAR, NU, H = 2e4, 5e4, 3e3, 0.2, 1e-3  # N/m, N/m, N/m, -, m


def woven(warp=WARP, weft=WEFT, shear=SHEAR, nu=NU, **more):
    return OrthotropicAEP(warp / H, weft / H, shear / H, nu, thickness=H, **more)


def modulus(angle, warp=WARP, weft=WEFT, shear=SHEAR, nu=NU):
    """Textbook stiffness [N/m] of a strip cut at an angle to the warp."""
    c, s = cos(radians(angle)) ** 2, sin(radians(angle)) ** 2
    return 1 / (c * c / warp + s * s / weft + c * s * (1 / shear - 2 * nu / (warp * weft) ** 0.5))


def test_equal_moduli_give_the_isotropic_law():
    E, nu = 1e5, 0.3
    pair = AEP(E, nu), OrthotropicAEP(E, E, E / (2 * (1 + nu)), nu)
    surface = samples.surface(*samples.frames(200, 0.4, 0))
    coefficients = [material.coefficients() for material in pair]
    energies = [m.membrane_energy(c, surface) for m, c in zip(pair, coefficients, strict=True)]
    torch.testing.assert_close(energies[1], energies[0], rtol=1e-12, atol=1e-12 * float(energies[0].detach().max()))
    first, second = (torch.stack(m.membrane_stress(c, surface)) for m, c in zip(pair, coefficients, strict=True))
    torch.testing.assert_close(second, first, rtol=0, atol=1e-13 * float(first.detach().abs().max()))
    bounds = [torch.stack(m.stiffness(c)) for m, c in zip(pair, coefficients, strict=True)]
    torch.testing.assert_close(bounds[1], bounds[0], rtol=1e-14, atol=0)


def test_small_strain_is_hookes_law():
    material = woven()

    def energy(strain):
        e11, e22, gamma = strain
        zero = torch.zeros(())
        f1, f2 = torch.stack([1 + e11, gamma / 2, zero])[None], torch.stack([gamma / 2, 1 + e22, zero])[None]
        return material.membrane_energy(material.coefficients(), samples.surface(f1, f2)).sum()

    stiffness = torch.func.hessian(energy)(torch.zeros(3)).detach()
    coupling = -NU / (WARP * WEFT) ** 0.5
    compliance = torch.tensor([[1 / WARP, coupling, 0], [coupling, 1 / WEFT, 0], [0, 0, 1 / SHEAR]])
    torch.testing.assert_close(stiffness @ compliance, torch.eye(3), rtol=0, atol=1e-12)


@pytest.mark.parametrize("angle", [0, 15, 45, 70, 90, 135])
def test_off_axis_strips_have_the_textbook_stiffness(angle):
    strip = Strip(0.1, 0.02, angle, woven(), resolution=(6, 3))
    elongation = torch.tensor([1e-7, 1e-6])
    force, _ = strip.pull(elongation)
    torch.testing.assert_close(force, modulus(angle) * 0.02 * elongation / 0.1, rtol=1e-4, atol=0)


@pytest.mark.parametrize(("angle", "stiffness"), [(0, WARP), (90, WEFT)])
def test_tension_along_a_yarn_is_linear_in_the_strain(angle, stiffness):
    """Closed form without lateral contraction: P = E (sigma - 1), at 1 to 10 %."""
    strip = Strip(0.1, 0.02, angle, woven(nu=1e-9), resolution=(6, 3))
    elongation = torch.tensor([1e-3, 5e-3, 1e-2])
    force, _ = strip.pull(elongation)
    torch.testing.assert_close(force, stiffness * 0.02 * elongation / 0.1, rtol=1e-6, atol=0)


def test_bias_strip_shears_like_a_trellis():
    """At 45 degrees, stiff yarns keep their length: sigma_1^2 + sigma_2^2 = 2, and the sheet gives the work."""
    strip = Strip(0.1, 0.02, 45, woven(1e8, 1e8, 1e3, 1e-9), resolution=(6, 3))
    stretch = torch.tensor([1.01, 1.05, 1.10], requires_grad=True)
    across = (2 - stretch**2).sqrt()
    work = 1e3 * ((stretch - 1) ** 2 + (across - 1) ** 2)
    (expected,) = torch.autograd.grad(work.sum(), stretch)
    force, x = strip.pull(0.1 * (stretch.detach() - 1))
    torch.testing.assert_close(force / 0.02, expected, rtol=1e-3, atol=0)
    width = x[:, :, 1].amax(-1) - x[:, :, 1].amin(-1)
    torch.testing.assert_close(width / 0.02, across.detach(), rtol=1e-3, atol=0)


@pytest.mark.parametrize("shear", [10.0, 1e6])
@pytest.mark.parametrize("ratio", [1e-4, 1.0, 1e4])
def test_energy_is_positive_at_any_ratio_and_any_strain(ratio, shear):
    """The obvious law, lambda (J - 1)^2 with what is left on the diagonal, is unbounded below from a ratio of 4 on."""
    material = woven(1e4, 1e4 * ratio, shear, 0.499)
    f1, f2 = samples.frames(2000, 2.0, 5)
    energy = material.membrane_energy(material.coefficients(), samples.surface(f1, f2))
    assert bool((energy > 0).all())
    # no better state than rest for a long thin one: J = 1 however far it is pulled
    pulled = torch.logspace(0.1, 3, 30)[:, None] * torch.tensor([[1.0, 0.0, 0.0]])
    thin = 1 / pulled[:, :1] * torch.tensor([[0.0, 1.0, 0.0]])
    for columns in ((pulled, thin), (thin[:, [1, 0, 2]], pulled[:, [1, 0, 2]])):
        energy = material.membrane_energy(material.coefficients(), samples.surface(*columns))
        assert bool((energy.diff(dim=0) > 0).all())


def test_quarter_turn_of_the_pattern_swaps_warp_and_weft():
    elongation = torch.tensor([4e-3])
    turned, _ = Strip(0.1, 0.02, 90, woven(), clamped=True).pull(elongation)
    swapped, _ = Strip(0.1, 0.02, 0, woven(WEFT, WARP), clamped=True).pull(elongation)
    torch.testing.assert_close(turned, swapped, rtol=1e-9, atol=0)


def isotropic_step(cloth, E, nu, density):
    """The bound written with Lame parameters, by brute force."""
    lam, mu = E * H * nu / (1 - nu**2), E * H / (2 * (1 + nu))
    D = torch.tensor([[lam + 2 * mu, lam, 0], [lam, lam + 2 * mu, 0], [0, 0, mu]])
    g = torch.as_tensor(cloth.mesh.shape_gradient)
    zero = torch.zeros_like(g[..., 0])
    B = torch.stack([torch.cat(r, -1) for r in ((g[..., 0], zero), (zero, g[..., 1]), (g[..., 1], g[..., 0]))], -2)
    return STABLE_STEP_OVER_LINEAR_LIMIT * 2 / (3 / density * torch.linalg.eigvalsh(B.mT @ D @ B).max()).sqrt()


def test_isotropic_step_is_what_it_was():
    cloth = tc.Cloth(tc.meshes.rectangle(0.2, 0.1, resolution=(7, 5)), AEP(1e5, 0.3, thickness=H), 0.2, contact=None)
    assert cloth.stable_step() == pytest.approx(float(isotropic_step(cloth, 1e5, 0.3, 0.2)), rel=1e-12)


@pytest.mark.parametrize("moduli", [(WARP, WEFT, SHEAR, NU), (1e4, 1e6, 1e2, 0.4), (1e3, 1e3, 1e5, 0.3)])
def test_step_bounds_the_true_frequency(moduli):
    """Largest eigenvalue of the whole mesh at rest, from the energy's second derivative."""
    strip = Strip(0.1, 0.03, 25, woven(*moduli), resolution=(9, 4))
    hessian = strip.hessian(strip.rest)
    mass = strip.cloth.build_model().mass.detach().repeat_interleave(2)
    omega = torch.linalg.eigvalsh(hessian / (mass[:, None] * mass).sqrt()).max().sqrt()
    share = strip.cloth.stable_step() / (2 / float(omega))
    assert 0.6 * STABLE_STEP_OVER_LINEAR_LIMIT < share <= STABLE_STEP_OVER_LINEAR_LIMIT


def stretched(material, elongation, size=(0.2, 0.04), resolution=(11, 3), density=0.5):
    """Force [N] and positions of a strip that the layer itself pulls between two grasps and brings to rest."""
    mesh = tc.meshes.rectangle(*size, resolution=resolution)
    ends = {"left": mesh.vertices[:, 0] < 1e-9, "right": mesh.vertices[:, 0] > size[0] - 1e-9}
    grasps = {name: tc.boundaries.Grasp(mask.nonzero()[0].tolist()) for name, mask in ends.items()}
    effects = {"oil": tc.effects.MassDamping(60.0)}
    cloth = tc.Cloth(mesh, material, density, effects=effects, boundaries=grasps, contact=None)
    times = torch.tensor([0.0, 0.1, 0.9, 1.0])
    pose = torch.eye(4).repeat(4, 1, 1)
    moved = pose.clone()
    moved[1:, 0, 3] = elongation
    closed = torch.ones(4, dtype=torch.bool)
    motion = {"left": tc.Trajectory(times, pose, closed), "right": tc.Trajectory(times, moved, closed)}
    with torch.no_grad():
        out = cloth(cloth.rest_state(), motion, times)
    return -out.wrench["right"][-1, 0], out.x[-1]


def test_stiff_half_and_soft_half_are_springs_in_series():
    mesh = tc.meshes.rectangle(0.2, 0.04, resolution=(11, 3))
    stiff = torch.as_tensor(mesh.vertices[mesh.faces].mean(1)[:, 0] < 0.1)
    warp = torch.where(stiff, 300.0, 100.0)
    force, x = stretched(woven(warp, 200.0, 50.0, 1e-9), 0.01)
    compliance = 0.1 / 300.0 + 0.1 / 100.0
    assert float(force) == pytest.approx(0.04 * 0.01 / compliance, rel=1e-3)
    middle = torch.as_tensor(abs(mesh.vertices[:, 0] - 0.1) < 1e-9)
    assert float((x[middle, 0] - 0.1).mean()) == pytest.approx(0.01 * (0.1 / 300.0) / compliance, rel=1e-3)


def test_layer_pulls_as_the_equilibrium_says():
    """The simulated machine (grasps, damping, wrench) against Newton's method on the energy, ends clamped."""
    material = woven(300.0, 100.0, 30.0, 0.3)
    force, _ = stretched(material, 0.01)
    expected, _ = Strip(0.2, 0.04, 0, material, resolution=(11, 3), clamped=True).pull(torch.tensor([0.01]))
    assert float(force) == pytest.approx(float(expected), rel=1e-3)


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"weft_modulus": 0.0}, "weft_modulus"),
        ({"shear_modulus": -1.0}, "shear_modulus"),
        ({"poisson_ratio": 0.5}, "poisson_ratio"),
        ({"warp_stiffening": -1.0}, "warp_stiffening"),
        ({"stiffening_reach": 0.0}, "stiffening_reach"),
        ({"thickness": float("nan")}, "thickness"),
    ],
)
def test_illegal_values_are_refused_by_name(change, name):
    with pytest.raises(tc.errors.InvalidInput, match=name):
        OrthotropicAEP(**{"youngs_modulus": 1e5, "weft_modulus": 1e5, "shear_modulus": 1e4, **change})


def test_fields_of_another_mesh_are_refused():
    mesh = tc.meshes.rectangle(0.2, 0.04, resolution=(11, 3))
    with pytest.raises(tc.errors.InvalidInput, match="shear_modulus"):
        tc.Cloth(mesh, woven(shear=torch.full((7,), 10.0)), 0.2)
    with pytest.raises(tc.errors.InvalidInput, match="limit"):
        tc.Cloth(mesh, woven(plastic=tc.materials.NormYield(torch.full((7,), 0.02))), 0.2)


def test_step_takes_the_stiffest_triangle_of_a_field():
    gradient = torch.as_tensor(tc.meshes.rectangle(0.1, 0.1, resolution=(4, 4)).shape_gradient)
    field = torch.ones(len(gradient))
    field[3] = 100.0
    steps = []
    for warp in (WARP, WARP * field, 100 * WARP):
        material = woven(warp)
        tangents = material.stiffness(material.coefficients())
        steps.append(
            StabilityLimits(
                bound_squared_frequency(gradient, torch.tensor(0.1), tangents, None), 0.0, 0.0
            ).cheapest_step
        )
    assert steps[1] < 0.3 * steps[0]
    assert steps[1] == pytest.approx(steps[2], rel=0.3)
