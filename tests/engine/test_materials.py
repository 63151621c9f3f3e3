"""Membrane laws, plastic set and rest shapes in the fused engine."""

import pytest
import torch
from helpers.engine_agreement import check_agreement, draw_noise, make_moving_state

import torchcloth as tc
from torchcloth.engine.builder import UnsupportedPart
from torchcloth.engine.lowering import lower

REACH = 0.04  # strain beyond which the weave no longer stiffens


def sheet(material, effects=None):
    """30 triangles that all differ."""
    return tc.Cloth(tc.meshes.rectangle(0.3, 0.2, triangles=30), material, 0.15, effects, contact=None)


def field(low, high, triangles=30):
    return torch.linspace(low, high, triangles)


def orthotropic(plastic=None):
    moduli = (field(5e4, 7e4), field(4e4, 2e4), field(1e4, 2e4), field(0.2, 0.3))
    stiffening = {"warp_stiffening": field(20, 30), "weft_stiffening": 8.0, "stiffening_reach": REACH}
    return tc.materials.OrthotropicAEP(*moduli, **stiffening, plastic=plastic)


def with_set(state, strain=0.02):
    """A sheet that has set before."""
    inelastic = state.memory["material"]
    memory = {**state.memory, "material": inelastic + strain * draw_noise(inelastic.shape, 20)}
    return state._replace(memory=memory)


def growth():
    return {"shrunk": tc.effects.RestShape(field(0.01, 0.05), -0.03, field(0.1, -0.1))}


@pytest.mark.parametrize("convention", ["plane_stress", "paper"])
def test_isotropic(convention):
    cloth = sheet(tc.materials.AEP(field(5e4, 7e4), field(0.2, 0.4), convention=convention))
    check_agreement(cloth, {}, make_moving_state(cloth))


def test_stiffening():
    cloth = sheet(
        tc.materials.StiffeningAEP(field(5e4, 7e4), field(0.2, 0.4), stiffening=field(0, 30), stiffening_reach=REACH)
    )
    check_agreement(cloth, {}, make_moving_state(cloth, strain=0.03))


def test_orthotropic_in_all_its_branches():
    cloth = sheet(orthotropic())
    state = make_moving_state(cloth, strain=0.03)
    s = tc.dynamics.surface(cloth.build_model().geometry, state.x, state.v)
    strain = torch.cat([s.f1, s.f2]).norm(dim=-1) - 1
    parts = (strain < 0, (strain > 0) & (strain < REACH), strain > REACH)
    assert all(int(part.sum()) > 5 for part in parts)
    check_agreement(cloth, {}, state)


@pytest.mark.parametrize("law", ["isotropic", "orthotropic"])
@pytest.mark.parametrize("grown", [False, True])
def test_sets_and_grown(law, grown):
    plastic = tc.materials.NormYield(field(0.03, 0.3))
    material = orthotropic(plastic) if law == "orthotropic" else tc.materials.AEP(6e4, 0.3, plastic=plastic)
    cloth = sheet(material, growth() if grown else None)
    state = with_set(make_moving_state(cloth, strain=0.1))
    with torch.no_grad():
        after, _ = tc.dynamics.rollout(cloth.build_model(), state, 1e-4, {}, 1)
    flowed = (after.memory["material"] != state.memory["material"]).any(-1).float().mean()
    assert 0.2 < flowed < 0.9
    check_agreement(cloth, {}, state)


def test_grown():
    cloth = sheet(orthotropic(), growth())
    check_agreement(cloth, {}, make_moving_state(cloth))


def test_batch_of_parameters_and_states():
    plastic = tc.materials.NormYield(torch.tensor([[0.03], [0.1]]))
    material = tc.materials.AEP(torch.tensor([[5e4], [7e4]]), 0.3, plastic=plastic)
    cloth = sheet(material, {"shrunk": tc.effects.RestShape(torch.tensor([[0.01], [0.03]]))})
    check_agreement(cloth, {}, with_set(make_moving_state(cloth, (2,), strain=0.1)))


def test_a_law_of_ones_own_is_not_taken_for_the_built_in():
    class Own(tc.materials.AEP):
        def membrane_stress(self, c, surface):
            p1, p2 = super().membrane_stress(c, surface)
            return 2 * p1, p2

    class OwnYield(tc.materials.NormYield):
        pass

    for material in (Own(6e4), tc.materials.AEP(6e4, plastic=OwnYield(0.1))):
        cloth = sheet(material)
        with pytest.raises(UnsupportedPart, match="Own"):
            lower(cloth.build_model(), make_moving_state(cloth), {})
