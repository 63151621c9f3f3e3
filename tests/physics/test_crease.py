"""Creases that stay, against the closed form of Bingham's law."""

import math

import pytest
import torch
from helpers.bent_shapes import (
    make_effect_inputs,
    make_gradient_problem,
    make_irregular_mesh,
    measure_momentum_drift,
    roll_to_cylinder,
    trace_memory,
)

import torchcloth as tc
from torchcloth.testing import check_gradients

YIELD, MOBILITY = 5.0, 20.0


def sheet(mesh, **options):
    return tc.effects.CreasingBending(1e-3, mobility=MOBILITY, yield_curvature=YIELD, **options).bind(mesh)


@pytest.mark.parametrize("degrees", [0, 30, 90])
@pytest.mark.parametrize("steps", [1, 7])
def test_crease_of_a_sheet_held_bent(steps, degrees):
    """k0 = (k - k_y) (1 - exp(-mobility t)), of the curvature that each vertex sees, however the time is cut."""
    mesh = make_irregular_mesh(17)
    effect = sheet(mesh)
    x = roll_to_cylinder(mesh, 12.0, degrees)
    time = 0.04
    crease = trace_memory(effect, mesh, [torch.as_tensor(mesh.vertices), *[x] * steps], dt=time / steps)[-1]
    seen = effect.stencil.fit_surface(x).curvature
    size = seen.norm(dim=-1, keepdim=True)
    expected = (size - YIELD) * (1 - math.exp(-MOBILITY * time)) * seen / size
    torch.testing.assert_close(crease, expected, rtol=1e-9, atol=1e-12)
    assert crease.norm(dim=-1).median().item() == pytest.approx(7 * (1 - math.exp(-0.8)), rel=0.02)


def test_below_the_yield_curvature_nothing_stays():
    mesh = make_irregular_mesh(9)
    memories = trace_memory(sheet(mesh), mesh, [roll_to_cylinder(mesh, k) for k in torch.linspace(0, 4.8, 9)], dt=10.0)
    assert all(torch.equal(memory, torch.zeros_like(memory)) for memory in memories)


@pytest.mark.parametrize("curl", [0.0, 3.0])
def test_a_strip_that_was_folded_and_let_go_keeps_its_angle(curl):
    """Held rolled to k for a time, then free: it comes to rest at curl + k0, so turns by (curl + k0) L in all."""
    bent, hold, mobility = 20.0, 0.05, 80.0  # little is left to flow while the strip springs back
    columns, length = 13, 0.12
    mesh = tc.meshes.rectangle(length, 0.02, resolution=(columns, 3))
    effects = {
        "bending": tc.effects.CreasingBending(1e-3, mobility=mobility, yield_curvature=YIELD, curl_warp=curl),
        "damping": tc.effects.MassDamping(150.0),
    }
    everywhere = tc.boundaries.Grasp(range(len(mesh.vertices)))
    cloth = tc.Cloth(mesh, tc.materials.AEP(2e3, 0.02), 0.2, effects, {"hands": everywhere}, contact=None)
    t = torch.tensor([0.0, hold, 9.0])
    motion = {"hands": tc.Trajectory(t, torch.eye(4).repeat(3, 1, 1), torch.tensor([True, False, False]))}
    with torch.no_grad():
        out = cloth(cloth.state(roll_to_cylinder(mesh, bent)), motion, times=(0.0, hold, 0.5))
    crease = (bent - curl - YIELD) * (1 - math.exp(-mobility * hold))
    line = out.x[-1].unflatten(0, (columns, -1)).mean(1)
    step = line[1:] - line[:-1]
    turn = torch.atan2(step[-1, 2], step[-1, 0]) - torch.atan2(step[0, 2], step[0, 0])
    across = length * (columns - 2) / (columns - 1)  # from the middle of the first cell to that of the last
    assert turn.item() == pytest.approx((curl + crease) * across, rel=0.02)
    assert 1.0 < turn.item() < 3.0


def test_force_is_that_of_the_energy_from_the_creased_shape():
    mesh = make_irregular_mesh(6)
    effect = sheet(mesh, weft_ratio=0.5, curl_warp=1.0)
    c = effect.coefficients()
    crease = torch.randn(36, 3, generator=torch.Generator().manual_seed(0))
    x = torch.as_tensor(mesh.vertices) + 0.01 * torch.randn(36, 3, generator=torch.Generator().manual_seed(1))
    x.requires_grad_()
    (gradient,) = torch.autograd.grad(effect.energy(c, x, crease), x)
    torch.testing.assert_close(effect.force(c, make_effect_inputs(mesh, x, crease)), -gradient, rtol=1e-9, atol=1e-13)


def test_momentum_and_angular_momentum_are_kept():
    linear, angular = measure_momentum_drift(
        {"bending": tc.effects.CreasingBending(1e-3, mobility=100.0, yield_curvature=0.5)}
    )
    assert linear < 1e-9
    assert angular < 1e-9


def test_gradients_through_the_crease():
    """Of the shape after flow, in the start, the mobility and the stiffness."""
    mesh = tc.meshes.rectangle(0.08, 0.04, resolution=(5, 3))
    effects = {"bending": tc.effects.CreasingBending(1e-3, mobility=50.0, yield_curvature=1.0, curl_warp=1.0)}
    cloth = tc.Cloth(mesh, tc.materials.AEP(200.0, 0.2), 0.2, effects, contact=None)
    state = cloth.state(roll_to_cylinder(mesh, 8.0, 20))
    times = (0.0, 14 * cloth.stable_step())
    with torch.no_grad():
        assert cloth(state, times=times).state.memory["effects.bending"].norm(dim=-1).max() > 0.05
    check_gradients(
        *make_gradient_problem(cloth, state, times, ("mobility", "stiffness", "curl_warp"), "bending"), 1e-6, acts=True
    )


@pytest.mark.parametrize("options", [{"mobility": -1.0}, {"yield_curvature": 0.0}, {"poisson": 1.0}])
def test_refusals(options):
    with pytest.raises(tc.errors.InvalidInput, match="|".join(options)):
        tc.effects.CreasingBending(**options)
