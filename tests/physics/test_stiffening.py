"""Yarns that stiffen in tension: closed form, neutrality, and a step that survives it."""

import pytest
import torch
from helpers.tension_strips import Strip

import torchcloth as tc
from torchcloth.dynamics import substep
from torchcloth.materials import OrthotropicAEP, StiffeningAEP, stiffening
from torchcloth.testing import finite_difference_sweep, samples
from torchcloth.testing.contract import call_with

H, REACH = 1e-3, 0.04


def woven(c_warp=0.0, c_weft=0.0, nu=1e-9):
    return OrthotropicAEP(
        300 / H, 100 / H, 30 / H, nu, warp_stiffening=c_warp, weft_stiffening=c_weft, stiffening_reach=REACH
    )


@pytest.mark.parametrize(("angle", "stiffness", "c"), [(0, 300.0, 20.0), (90, 100.0, 50.0)])
def test_tension_along_a_yarn(angle, stiffness, c):
    """T = E e (1 + c e) up to the reach, its tangent beyond, at 0.5 to 10 %."""
    strip = Strip(0.1, 0.02, angle, woven(20.0, 50.0), resolution=(6, 3))
    strain = torch.tensor([0.005, 0.02, REACH, 0.06, 0.10])
    force, _ = strip.pull(0.1 * strain)
    inside = strain.clamp(max=REACH)
    tension = stiffness * (inside * (1 + c * inside) + (1 + 2 * c * REACH) * (strain - inside))
    torch.testing.assert_close(force / 0.02, tension, rtol=1e-6, atol=0)


def test_one_modulus_is_both_yarns():
    even, both = (
        StiffeningAEP(60 / H, 0.3, stiffening=2.0),
        OrthotropicAEP(
            60 / H,
            60 / H,
            60 / 2.6 / H,
            0.3,
            contact_stiffness=1e6,
            shear_stiffness=2.5e5,
            cone=0.3,
            warp_stiffening=2.0,
            weft_stiffening=2.0,
        ),
    )
    for one, other in zip(even.coefficients(), both.coefficients(), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-12)


def test_uniaxial_tension_with_lateral_contraction():
    """Contraction is free, so that it does not change E or c; what is left is lambda's large-strain term."""
    strain = torch.tensor([0.001, 0.01])
    force, _ = Strip(0.1, 0.02, 0, woven(20.0, 50.0, nu=0.3), resolution=(6, 3)).pull(0.1 * strain)
    torch.testing.assert_close(force / 0.02, 300 * strain * (1 + 20 * strain), rtol=0.01, atol=0)


def test_compression_is_linear():
    strain = torch.tensor([-0.05, -0.01])
    soft, _ = Strip(0.1, 0.02, 0, woven(), resolution=(6, 3)).pull(0.1 * strain)
    stiff, _ = Strip(0.1, 0.02, 0, woven(20.0, 50.0), resolution=(6, 3)).pull(0.1 * strain)
    assert torch.equal(stiff, soft)


def test_no_stiffening_is_bitwise_neutral(monkeypatch):
    material = woven(nu=0.3)
    surface = samples.surface(*samples.frames(300, 0.1, 0))

    def answers():
        c = material.coefficients()
        stress = material.membrane_stress(c, surface)
        return [material.membrane_energy(c, surface), *stress, *material.stiffness(c)]

    with_zero = answers()
    for name in ("energy", "stress"):
        monkeypatch.setattr(stiffening, name, lambda *_: 0.0)
    monkeypatch.setattr(stiffening, "tangent", lambda *_: 0.0)
    assert all(torch.equal(a, b) for a, b in zip(with_zero, answers(), strict=True))


def test_amplitude_zero_has_a_gradient():
    """An optimiser that starts from 0 sees where to go."""
    material = woven()
    surface = samples.surface(*samples.frames(50, 0.05, 2))

    def energy(c):
        return call_with(material, {"warp_stiffening.raw": c}, _total, surface)

    c = torch.zeros((), requires_grad=True)
    (slope,) = torch.autograd.grad(energy(c), c)
    assert float(slope) > 0
    finite_difference_sweep(energy, c, torch.ones(()), slope).check(1e-7)


def _total(material, surface):
    return material.membrane_energy(material.coefficients(), surface).sum()


def square(material):
    return tc.Cloth(tc.meshes.rectangle(0.1, 0.1, resolution=(5, 5)), material, 0.1, contact=None)


def growth(material, strain, dt):
    """Largest over first total energy of a free sheet let go from a biaxial ``strain``, over 1200 steps of ``dt``."""
    cloth = square(material)
    x = cloth.rest_state().x
    noise = 1e-5 * samples.normal(tuple(x.shape), 0) * torch.tensor([1.0, 1.0, 0.0])
    state, totals = cloth.state(x * (1 + strain) + noise), []
    with torch.no_grad():
        model = cloth.build_model()
        for _ in range(60):
            totals.append(sum(cloth.energy(state).values()))
            state, _ = substep.rollout(model, state, dt, {}, 20)
    return float(torch.stack(totals).max() / totals[0])


@pytest.mark.parametrize("strain", [0.02, 0.05, 0.1])
def test_stable_step_survives_the_release_of_a_stiffened_sheet(strain):
    """In vacuum. Symplectic Euler's energy swings by 1.36 at this step without any stiffening."""
    stiff = woven(50.0, 50.0, nu=0.3)
    assert growth(stiff, strain, square(stiff).stable_step()) < 1.7


def test_step_that_ignores_stiffening_fails():
    ignorant = square(woven(nu=0.3)).stable_step()
    assert not growth(woven(50.0, 50.0, nu=0.3), 0.05, ignorant) < 1e3  # NaN or huge


@pytest.mark.parametrize("strain", [0.0, 0.03, 0.1, 0.3])
@pytest.mark.parametrize("across", [0.0, 1.0])
def test_step_bounds_the_frequency_of_a_stretched_sheet(strain, across):
    """Largest eigenvalue of the whole mesh held at a strain, uniaxial and biaxial, far beyond the reach too."""
    strip = Strip(0.1, 0.03, 0, woven(50.0, 20.0, nu=0.3), resolution=(8, 4))
    x = strip.rest * torch.tensor([1 + strain, 1 + across * strain])
    hessian = strip.hessian(x)
    mass = strip.cloth.build_model().mass.detach().repeat_interleave(2)
    omega = torch.linalg.eigvalsh(hessian / (mass[:, None] * mass).sqrt()).max().sqrt()
    assert strip.cloth.stable_step() * float(omega) / 2 < 0.9


def test_step_knows_the_reach():
    """The stiffest tangent is E (1 + 2 c reach): 5 times at c = 50 and 4 %, for a step of 1 / sqrt(5)."""
    steps = [square(woven(c, c)).stable_step() for c in (0.0, 50.0)]
    assert steps[1] / steps[0] == pytest.approx((1 + 2 * 50 * REACH) ** -0.5, rel=0.05)
