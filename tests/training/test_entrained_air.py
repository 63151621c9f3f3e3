"""Air that follows a sheet with a delay: contract, closed forms, and its limits as added mass and as damping."""

import numpy as np
import pytest
import torch

import torchcloth as tc
from torchcloth.testing import EffectContract
from torchcloth.training.studies.measured.entrained_air import EntrainedAir
from torchcloth.types import EffectInputs

AIR, DEPTH, TIME = 1.2, 0.2, 0.25


class TestContract(EffectContract):
    def make(self, amplitude):
        return EntrainedAir(amplitude, TIME)


def _push(steps, dt):
    """Force [N/m^2] along the normal on a flat sheet that moves with 1 m/s, after each step."""
    mesh = tc.meshes.rectangle(1.0, 1.0, resolution=(2, 2))
    cloth = tc.Cloth(mesh, tc.materials.AEP(1e4, 0.3), 0.2, {}, contact=None).double()
    effect = EntrainedAir(DEPTH, TIME, density=AIR).double().bind(mesh).double()
    x = torch.as_tensor(mesh.vertices)
    v = torch.zeros_like(x) + torch.tensor([0.0, 0.0, 1.0], dtype=x.dtype)
    surface = tc.dynamics.kinematics.surface(cloth.build_model().geometry, x, v)
    memory, c, forces = effect.initial_memory(x), effect.coefficients(), []
    for _ in range(steps):
        inputs = EffectInputs(x, v, surface, torch.ones(4, 1), memory, dt)
        memory = effect.update_memory(c, inputs)
        forces.append(effect.force(c, inputs._replace(memory=memory)).sum(0)[2].item())
    return np.array(forces)


def test_the_push_on_a_sheet_of_constant_speed_decays_exponentially():
    """T is the time of the decay, and the whole impulse is the momentum of the layer."""
    dt = 0.01
    forces, before = _push(500, dt), dt * np.arange(500)
    assert forces == pytest.approx(AIR * DEPTH / dt * np.expm1(-dt / TIME) * np.exp(-before / TIME), rel=1e-9)
    assert forces.sum() * dt == pytest.approx(-AIR * DEPTH, rel=1e-8)


@pytest.mark.parametrize(("time", "equal"), [(0.002, "added mass"), (50.0, "damping")])
def test_a_fast_layer_is_added_mass_and_a_slow_one_is_damping(time, equal):
    """A sheet falls across itself: more inertia without more weight, or a constant damping rate."""
    mesh, density, length = tc.meshes.rectangle(0.1, 0.1, resolution=(2, 2)), 0.2, 0.3
    mass_ratio = AIR * length / density
    effects = {"gravity": tc.effects.Gravity(), "air": EntrainedAir(length, time, AIR)}
    cloth = tc.Cloth(mesh, tc.materials.AEP(1e4, 0.3), density, effects, contact=None).double()
    with torch.no_grad():
        fall = cloth(cloth.rest_state(), {}, torch.linspace(0, 0.3, 31, dtype=torch.float64)).v[-1, :, 2].mean().item()
    g, rate = 9.81, mass_ratio / time
    expected = {"added mass": -g * 0.3 / (1 + mass_ratio), "damping": -g / rate * -np.expm1(-rate * 0.3)}[equal]
    assert fall == pytest.approx(expected, rel=0.03)


def test_refusals():
    with pytest.raises(tc.errors.InvalidInput, match="air density"):
        EntrainedAir(density=0.0)
    with pytest.raises(tc.errors.InvalidInput):
        EntrainedAir(-0.1)
    with pytest.raises(tc.errors.InvalidInput):
        EntrainedAir(0.1, time=0.0)
