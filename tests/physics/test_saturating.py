"""Bending whose moment saturates."""

import pytest
import torch
from helpers.bent_shapes import make_effect_inputs, make_irregular_mesh, measure_momentum_drift, roll_to_cylinder

import torchcloth as tc
from torchcloth.testing import check_gradients

MOMENT, KNEE = 0.01, 2.0


@pytest.mark.parametrize("degrees", [0, 30, 90])
@pytest.mark.parametrize("curvature", [0.5, 2.0, 8.0])
def test_energy_of_a_cylinder_in_any_direction(curvature, degrees):
    mesh = make_irregular_mesh(17)
    effect = tc.effects.SaturatingBending(MOMENT, KNEE).bind(mesh)
    energy = effect.energy(effect.coefficients(), roll_to_cylinder(mesh, curvature, degrees)).item()
    assert energy == pytest.approx(0.09 * MOMENT * ((curvature**2 + KNEE**2) ** 0.5 - KNEE), rel=0.015)


def test_force_is_minus_the_gradient_of_the_energy():
    mesh = make_irregular_mesh(6)
    effect = tc.effects.SaturatingBending(MOMENT, KNEE).bind(mesh)
    c = effect.coefficients()
    x = torch.as_tensor(mesh.vertices) + 0.02 * torch.randn(36, 3, generator=torch.Generator().manual_seed(0))
    check_gradients(lambda x: effect.energy(c, x), {"x": x}, 1e-7)
    x.requires_grad_()
    (gradient,) = torch.autograd.grad(effect.energy(c, x).sum(), x)
    torch.testing.assert_close(effect.force(c, make_effect_inputs(mesh, x)), -gradient, rtol=1e-10, atol=1e-14)


def test_small_curvatures_meet_the_initial_stiffness():
    mesh = make_irregular_mesh(9)
    effect = tc.effects.SaturatingBending(MOMENT, KNEE).bind(mesh)
    linear = tc.effects.Bending(MOMENT / KNEE).bind(mesh)
    now = make_effect_inputs(mesh, roll_to_cylinder(mesh, 1e-4, 30))
    force, expected = (e.force(e.coefficients(), now) for e in (effect, linear))
    torch.testing.assert_close(force, expected, rtol=0, atol=1e-6 * expected.abs().max().item())


def test_momentum_and_angular_momentum_are_kept():
    linear, angular = measure_momentum_drift({"bending": tc.effects.SaturatingBending(MOMENT, KNEE)})
    assert linear < 1e-9
    assert angular < 1e-9


@pytest.mark.parametrize(("moment", "curvature"), [(-1.0, 1.0), (1.0, 0.0)])
def test_refusals(moment, curvature):
    with pytest.raises(tc.errors.InvalidInput, match="moment" if moment < 0 else "curvature"):
        tc.effects.SaturatingBending(moment, curvature)
