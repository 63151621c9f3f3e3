"""Effects in the fused engine, one by one and together."""

import pytest
import torch
from helpers.engine_agreement import (
    GRADIENT_TOLERANCE,
    check_agreement,
    compute_outcome,
    draw_noise,
    make_moving_hand,
    make_moving_state,
    relative_difference,
    sensitivity_adjoint_error,
)

import torchcloth as tc
from torchcloth.diagnosis.causes.catalogue import list_effect_classes
from torchcloth.dynamics import substep
from torchcloth.engine import fused
from torchcloth.engine.builder import UnsupportedPart
from torchcloth.engine.lowering import lower

E = tc.effects
TRIANGLES = 30


def sheet(effects, boundaries=None):
    """Its triangles all differ."""
    mesh = tc.meshes.rectangle(0.3, 0.2, triangles=TRIANGLES)
    return tc.Cloth(mesh, tc.materials.AEP(6e3, 0.3), 0.15, effects, boundaries, contact=None)


def field(low, high):
    return torch.linspace(low, high, TRIANGLES)


def remembering(state):
    """Internal variables as after a long life: all different, none in its first state."""

    def aged(seed: int, value: torch.Tensor) -> torch.Tensor:
        if value.shape[-1] == 3:  # creases
            return 5 * draw_noise(value.shape, 40 + seed)
        shift, share = draw_noise(value.shape, 40 + seed).chunk(2, dim=-1)
        return torch.cat([value.chunk(2, dim=-1)[0] * (1 + 0.1 * shift), (0.5 * share).clamp(-0.9, 0.9)], dim=-1)

    return state._replace(memory={name: aged(k, value) for k, (name, value) in enumerate(state.memory.items())})


def standard():
    """What most cloths have."""
    return {
        "gravity": E.Gravity(tilt=(0.1, -0.2)),
        "air": E.AirDrag(1.2, tangential=0.02, wind=(0.3, 0.1, 0)),
        "damping": E.MassDamping(0.4),
        "bending": E.Bending(1e-5, 0.01, poisson=0.2),
        "hem": E.LineMass(4e-3),
    }


EFFECTS = {
    "drag with fields": lambda: E.AirDrag(field(0.5, 1.5), tangential=field(0.02, 0.01)),
    "bending without damping": lambda: E.Bending(1e-5),
    "bending field": lambda: E.Bending(field(1e-5, 1e-3), 0.02),
    "woven bending": lambda: E.Bending(1e-4, poisson=0.3, weft_ratio=0.5, twist_ratio=1.3),
    "curl": lambda: E.Bending(1e-4, 0.02, curl_warp=3.0),
    "curl of a woven sheet": lambda: E.Bending(
        field(1e-5, 1e-3), poisson=0.2, weft_ratio=0.4, curl_warp=3.0, curl_weft=-2.0
    ),
    "saturating": lambda: E.SaturatingBending(1e-3, 3.0),
    "bending friction": lambda: E.BendingFriction(1e-3, threshold=3.0),
    "shear friction": lambda: E.ShearFriction(5.0, threshold=0.02),
    "kelvin voigt": lambda: E.KelvinVoigt(field(0.1, 0.3)),
    "added mass": lambda: E.AddedMass(field(0.1, 0.3)),
    "residual": lambda: E.ResidualForce(
        {"across@edge": 0.5, "across2": 0.7, "along": -0.2, "along2@inside": 0.3, "mass@edge": 0.1, "bend@inside": 1e-4}
    ),
    "residual strain rate": lambda: E.ResidualForce({"strain_rate": 0.1, "strain_rate@edge": 0.2}),
    "adhesion": lambda: E.Adhesion(3.0, 0.4, point=(0.0, 0.0, -0.2), normal=(0.1, 0.2, 1.0)),
    "body force": lambda: E.BodyForce(torch.tensor([[0.5, -1.0, 2.0]])),
    "body force of vertices": lambda: E.BodyForce(torch.sin(torch.arange(72.0)).reshape(24, 3)),
}


TESTED_BELOW = (E.CreasingBending, E.GripSlip, E.RestShape)  # they need a bent state, a grip, or axes
BY_HAND = {type(effect) for effect in (*(make() for make in EFFECTS.values()), *standard().values())}
EFFECTS |= {e.__name__: e for e in list_effect_classes() if e not in (*BY_HAND, *TESTED_BELOW)}  # as constructed


@pytest.mark.parametrize("name", EFFECTS)
def test_alone(name):
    cloth = sheet({"it": EFFECTS[name]()})
    check_agreement(cloth, {}, remembering(make_moving_state(cloth)))


def test_standard_in_a_hand():
    cloth = sheet(standard(), {"hand": tc.boundaries.Grasp.corner("upper-left")})
    check_agreement(cloth, {"hand": make_moving_hand(0.01)}, make_moving_state(cloth))


@pytest.mark.parametrize("options", [{}, {"weft_ratio": 0.5, "curl_weft": 3.0}])
def test_creases_where_it_is_bent_far(options):
    cloth = sheet({"crease": E.CreasingBending(1e-4, mobility=30.0, yield_curvature=12.0, **options)})
    state = remembering(make_moving_state(cloth))
    with torch.no_grad():
        after, _ = substep.rollout(cloth.build_model(), state, 1e-4, {}, 1)
    flowed = (after.memory["effects.crease"] != state.memory["effects.crease"]).any(-1).float().mean()
    assert 0.2 < flowed < 0.9
    check_agreement(cloth, {}, state)


def test_bending_of_a_sheet_that_lies_folded():
    effects = {"curl": E.Bending(1e-4, curl_warp=3.0), "friction": E.BendingFriction()}
    cloth = sheet(effects)
    state = make_moving_state(cloth)
    flat = cloth.rest_state().x
    folded = flat * torch.tensor([1.0, 0.1, 1.0]) + 0.02 * flat.flip(-1)  # seen from far off its plane
    folded[:, 1] = torch.where(flat[:, 0] > flat[:, 0].mean(), flat[:, 1], folded[:, 1])
    state = cloth.state(folded + 1e-4 * draw_noise(folded.shape, 9), state.v)
    stretch = effects["curl"].stencil.fit_surface(state.x).area_ratio
    assert 0 < int((stretch == 0.5).sum()) < len(stretch)
    check_agreement(cloth, {}, state, substeps=20)


def test_all_together_in_a_batch():
    batch = torch.tensor([[1.0], [1.5]])
    effects = {
        **standard(),
        "curl": E.Bending(1e-4 * batch, 0.01, weft_ratio=0.6 * batch, curl_warp=2.0),
        "crease": E.CreasingBending(1e-4, mobility=30.0 * batch, yield_curvature=12.0),
        "friction": E.BendingFriction(1e-3 * batch, threshold=3.0),
        "saturating": E.SaturatingBending(1e-3 * batch, 3.0),
        "shear": E.ShearFriction(5.0 * batch, threshold=0.02),
        "viscous": E.KelvinVoigt(0.1 * batch),
        "air mass": E.AddedMass(0.1 * batch),
        "shrunk": E.RestShape(0.02 * batch),
    }
    cloth = sheet(effects)
    check_agreement(cloth, {}, remembering(make_moving_state(cloth, (2,))))


@pytest.mark.parametrize("air", [False, True], ids=["vacuum", "air"])
@pytest.mark.parametrize("stages", [2, pytest.param(5, marks=pytest.mark.slow)])
def test_viscous_forces_in_stages(stages, air):
    effects = {
        **standard(),
        "woven": E.Bending(field(1e-5, 1e-3), 0.02, weft_ratio=0.5),
        "elastic": E.Bending(1e-5),
        "viscous": E.KelvinVoigt(field(0.1, 0.3)),
        "rest": E.ResidualForce({"across": 0.5, "strain_rate@edge": 0.2}),
    }
    cloth = sheet(
        effects | ({"mass": E.AddedMass(0.1)} if air else {}), {"hand": tc.boundaries.Grasp.corner("upper-left")}
    )
    check_agreement(cloth, {"hand": make_moving_hand(0.01)}, make_moving_state(cloth), stages=stages)


@pytest.mark.parametrize("viscosity", [1.0, 30.0])
def test_tangents_of_a_step_that_has_stages(viscosity):
    """Coefficients of what acts in stages have other places in the program than where everything acts at once."""
    effects = {**standard(), "viscous": E.KelvinVoigt(viscosity), "elastic": E.Bending(1e-5)}
    cloth = sheet(effects, {"hand": tc.boundaries.Grasp.corner("upper-left")})
    state, dt = make_moving_state(cloth), cloth.stable_step()
    motion = {"hand": make_moving_hand(20 * dt)}
    assert cloth.schedule(state, motion, (0.0, 10 * dt), None).model.stages > 1
    assert sensitivity_adjoint_error(cloth, motion, state, 10, dt) < GRADIENT_TOLERANCE


def test_an_effect_of_ones_own_that_is_viscous_in_stages_is_for_the_reference():
    class Thicker(E.KelvinVoigt):
        pass

    custom, known = sheet({"it": Thicker(5.0)}), sheet({"it": E.KelvinVoigt(5.0)})
    assert "'it' (Thicker), which is viscous in stages" in custom.engine_in_use
    state = make_moving_state(known)
    with torch.no_grad():
        one, other = (cloth(state, times=[0.0, 0.01]).x[-1] - state.x for cloth in (custom, known))
    assert relative_difference(one, other) < 1e-10
    assert known.engine_in_use == "fused"


def test_no_air_that_moves_along_changes_nothing_bitwise():
    state = make_moving_state(sheet({}))
    with_none, _ = fused.rollout(sheet({"air": E.AddedMass(0.0)}).build_model(), state, 1e-4, {}, 50)
    without, _ = fused.rollout(sheet({}).build_model(), state, 1e-4, {}, 50)
    assert torch.equal(with_none.x, without.x)
    assert torch.equal(with_none.v, without.v)


def test_memory_that_nobody_owns():
    cloth = sheet({"friction": E.BendingFriction()})
    with pytest.raises(UnsupportedPart, match="friction"):
        fused.rollout(sheet({}).build_model(), make_moving_state(cloth), 1e-4, {}, 1)


def test_friction_that_hardly_moves():
    """By less than 1e-4 thresholds in a step, where the law is a series."""
    cloth = sheet({"bending": E.BendingFriction(1e-3, threshold=3.0), "shear": E.ShearFriction(5.0, threshold=0.02)})
    slow = remembering(cloth.state(cloth.rest_state().x, 1e-5 * make_moving_state(cloth).v))
    for name, value in slow.memory.items():  # not where the law has its kink
        value[:, : value.shape[-1] // 2] = 1e-6 * draw_noise(value.chunk(2, dim=-1)[0].shape, 50 + len(name))
    check_agreement(cloth, {}, slow, substeps=10)


def test_still_and_flat_has_finite_gradients():
    effects = {"friction": E.BendingFriction(), "shear": E.ShearFriction(), "crease": E.CreasingBending(1e-4)}
    effects |= {"air": E.AirDrag(1.2, tangential=0.1), "saturating": E.SaturatingBending(), "mass": E.AddedMass()}
    cloth = sheet(effects)
    results = compute_outcome(fused.rollout, cloth, {}, cloth.rest_state(), 3, 1e-4)
    assert all(bool(torch.isfinite(grad).all()) for grad in results.gradients.values() if grad is not None)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["bending friction", "standard"])
def test_float32_gradients_over_a_thousand_steps(name):
    def made():
        return sheet(standard() if name == "standard" else {**standard(), "it": EFFECTS[name]()})

    cloth = made()
    state = make_moving_state(cloth, strain=0.01)
    state = state.map(lambda t: t.float().double())
    exact = compute_outcome(substep.rollout, cloth, {}, state, 1000, 5e-5)
    torch.set_default_dtype(torch.float32)
    rough = made()
    results = compute_outcome(fused.rollout, rough, {}, state.map(torch.Tensor.float), 1000, 5e-5)
    for key, want in exact.gradients.items():
        if want is not None:
            got = results.gradients[key].double()
            assert float((got - want).norm() / want.norm()) < 1e-3, key
            assert float(torch.cosine_similarity(got.flatten(), want.double().flatten(), 0)) > 0.9999, key


def test_an_effect_of_ones_own_is_not_taken_for_the_built_in():
    class Heavier(E.Gravity):
        def force(self, c, inputs):
            return 2 * super().force(c, inputs)

    cloth = sheet({"g": Heavier()})
    with pytest.raises(UnsupportedPart, match="'g' \\(Heavier\\)"):
        lower(cloth.build_model(), make_moving_state(cloth), {})


def test_settling():
    cloth = sheet(standard(), {"hand": tc.boundaries.Grasp.corner("upper-left")})
    model = cloth.build_model()
    settling = E.MassDamping(30.0)
    model = model._replace(effects={**model.effects, "settling": (settling, settling.coefficients().detach())})
    state = make_moving_state(cloth)
    one, _ = substep.rollout(model, state, 1e-4, {}, 20)
    other, _ = fused.rollout(model, state, 1e-4, {}, 20)
    assert relative_difference(other.x - state.x, one.x - state.x) < 1e-10
