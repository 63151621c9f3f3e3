"""Derivatives along many directions at once: against the reference's copies, against reverse mode, and their memory."""

import math

import pytest
import torch
from helpers.engine_cloths import check_close, make_opening_motion, make_perturbed_state, make_sheet

import torchcloth as tc
from torchcloth.engine import tangents
from torchcloth.errors import InvalidInput
from torchcloth.simulation.sensitivities import Directions

END = 0.012


def directions(cloth, state, motion, count=3):
    generator = torch.Generator().manual_seed(1)

    def random(like):
        return torch.randn(count, *like.shape, generator=generator, dtype=like.dtype)

    only_in_contact = ("contact_stiffness", "shear_stiffness", "cone")
    named = {n: p for n, p in cloth.named_parameters() if not any(key in n for key in only_in_contact)}
    moves = {}
    for name, trajectory in motion.items():
        moves[name] = torch.zeros(count, *trajectory.pose.shape)
        moves[name][..., :3, 3] = 1e-2 * random(trajectory.pose[..., :3, 3])
    memory = {name: random(value) for name, value in state.memory.items()}
    changed = tc.ClothState(1e-3 * random(state.x), random(state.v), random(state.d3), memory)
    return Directions({n: 0.1 * random(p.detach()) for n, p in named.items()}, changed, moves)


def parts(out):
    return {"x": out.x, "v": out.v, **out.wrench, "last": out.state.x}


def both(settle=0.0, batch=(), times=(0.0, 0.4 * END, END), count=3):
    results = []
    for engine in ("fused", "reference"):
        cloth = make_sheet(engine)
        state, motion = make_perturbed_state(cloth, batch), make_opening_motion(END)
        along = directions(cloth, state, motion, count)
        results.append(cloth.sensitivities(state, motion, times, along=along, settle=settle))
    return results


@pytest.mark.parametrize("case", [{}, {"settle": 0.01}, {"batch": (2,)}, {"count": 11, "times": (0.0, 0.003)}], ids=str)
def test_equal_the_reference(case):
    (value, moved), (expected, slopes) = both(**case)
    for name in parts(value):
        check_close(parts(value)[name], parts(expected)[name], 1e-10, name)
        check_close(parts(moved)[name], parts(slopes)[name], 1e-8, f"tangent of {name}")
    count = case.get("count", 3)
    assert moved.x.shape == (count, *value.x.shape)


def test_cloth_that_sets_while_it_settles_and_hands_are_moved():
    """It settles in pieces, as what has set shortens the step."""
    results = []
    for engine in ("fused", "reference"):
        material = tc.materials.AEP(1e5, 0.3, plastic=tc.materials.NormYield(1e-3))
        cloth = make_sheet(engine, material=material)
        state, motion = make_perturbed_state(cloth), make_opening_motion(END)
        moves = directions(cloth, state, motion).motion
        results.append(cloth.sensitivities(state, motion, (0.0, END), along=Directions(motion=moves), settle=0.2))
    (value, moved), (expected, slopes) = results
    for name in parts(value):
        check_close(parts(value)[name], parts(expected)[name], 1e-10, name)
        check_close(parts(moved)[name], parts(slopes)[name], 1e-7, f"tangent of {name}")


def test_equal_reverse_mode():
    """Every direction against the same projection of a gradient."""
    cloth = make_sheet("fused").requires_grad_(True)
    state, motion, times = make_perturbed_state(cloth), make_opening_motion(END), (0.0, 0.005, END)
    along = directions(cloth, state, motion)
    _, moved = cloth.sensitivities(state, motion, times, along=along)
    leaves = {name: t.pose.clone().requires_grad_() for name, t in motion.items()}
    x, v = state.x.clone().requires_grad_(), state.v.clone().requires_grad_()
    driven = {name: t._replace(pose=leaves[name]) for name, t in motion.items()}
    out = cloth(state._replace(x=x, v=v), driven, times)
    weights = {name: torch.randn_like(value) for name, value in parts(out).items()}
    sum((weights[name] * value).sum() for name, value in parts(out).items()).backward()
    for k in range(3):
        forward = sum((weights[name] * value[k]).sum() for name, value in parts(moved).items())
        pairs = [(along.state.x[k], x.grad), (along.state.v[k], v.grad)]
        pairs += [(along.motion[name][k], leaves[name].grad) for name in motion]
        pairs += [(t[k], cloth.get_parameter(name).grad) for name, t in along.parameters.items()]
        reverse = sum((a * b).sum() for a, b in pairs)
        assert abs(float(forward - reverse)) < 1e-8 * abs(float(reverse))


def test_directions_that_leave_the_parameters_alone():
    """Beside others that change them: each is what it would be by itself."""
    cloth = make_sheet("fused")
    state, motion, times = make_perturbed_state(cloth), make_opening_motion(END), (0.0, END)
    along = directions(cloth, state, motion)
    some = {name: tangent.clone() for name, tangent in along.parameters.items()}
    for tangent in some.values():
        tangent[1] = 0
    _, mixed = cloth.sensitivities(state, motion, times, along=along._replace(parameters=some))
    _, whole = cloth.sensitivities(state, motion, times, along=along)
    _, without = cloth.sensitivities(state, motion, times, along=along._replace(parameters={}))
    for name in parts(mixed):
        torch.testing.assert_close(parts(mixed)[name][[0, 2]], parts(whole)[name][[0, 2]], rtol=0, atol=0)
        check_close(parts(mixed)[name][1], parts(without)[name][1], 1e-12, name)


def test_fields_and_boundary_free_cloth():
    """A field per triangle; no motion at all."""
    results = []
    for engine in ("fused", "reference"):
        field = torch.linspace(0.9e5, 1.1e5, 32)
        cloth = make_sheet(engine, material=tc.materials.AEP(field, 0.3), boundaries={})
        raw = torch.randn(2, 32, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        along = Directions({"material.youngs_modulus.raw": raw})
        results.append(cloth.sensitivities(make_perturbed_state(cloth), None, (0.0, 0.01), along=along)[1].x)
    check_close(*results, 1e-8, "tangent")
    assert float(results[0][:, 1].abs().max()) > 0


def test_one_hand_of_two():
    """The other's poses stay as they are."""
    results = []
    for engine in ("fused", "reference"):
        cloth = make_sheet(engine)
        pose = directions(cloth, make_perturbed_state(cloth), make_opening_motion(END)).motion["right"]
        along = Directions(motion={"right": pose})
        results.append(
            cloth.sensitivities(make_perturbed_state(cloth), make_opening_motion(END), (0.0, END), along=along)[1].x
        )
    check_close(*results, 1e-8, "tangent")


@pytest.mark.parametrize("engine", ["auto", "reference"])
@pytest.mark.parametrize(
    ("along", "message"),
    [
        (Directions(), "along; got no direction"),
        (
            Directions({"stiffness": torch.ones(1)}),
            r"along\.parameters; got 'stiffness'; expected one of areal_density",
        ),
        (Directions({"areal_density.raw": torch.ones(1, 2)}), r"got shape \(1, 2\); expected \[K\]"),
        (Directions(motion={"foot": torch.ones(1)}), r"along\.motion; got 'foot'"),
        (Directions({"areal_density.raw": torch.ones(2), "material.cone.raw": torch.ones(3)}), "same K"),
        (None, "along; got NoneType; expected .*Directions"),
        ({"areal_density.raw": torch.ones(1)}, "along; got dict; expected .*Directions"),
        (Directions(state=torch.ones(1)), "along; got Tensor"),
        (
            Directions({"areal_density.raw": [1.0]}),
            r"\['areal_density\.raw'\]; got list; expected a tensor",
        ),
        (
            Directions({"areal_density.raw": torch.ones(1, dtype=torch.int64)}),
            "got int64; expected a tensor",
        ),
        (Directions({"areal_density.raw": torch.tensor([math.nan])}), r"\['areal_density\.raw'\]; got NaN"),
        (Directions(motion={"left": torch.full((1, 7, 4, 4), math.nan)}), r"along\.motion\['left'\]; got NaN"),
        (Directions({"areal_density.raw": torch.ones(0)}), "along; got no direction"),
    ],
)
def test_refusals(engine, along, message):
    cloth = make_sheet(engine)
    with pytest.raises(InvalidInput, match=message):
        cloth.sensitivities(cloth.rest_state(), make_opening_motion(END), (0.0, END), along=along)


def test_without_gradients_and_graph():
    cloth = make_sheet("fused")
    along = Directions({"areal_density.raw": torch.ones(1)})
    value, moved = cloth.sensitivities(make_perturbed_state(cloth), make_opening_motion(END), (0.0, 0.005), along=along)
    assert not value.x.requires_grad
    assert not moved.x.requires_grad


def test_all_directions_share_one_look_at_the_parts(monkeypatch):
    """Parts are asked once for the tangents of their coefficients, not once for each direction."""
    asked, lower = [], tangents.lower
    monkeypatch.setattr(tangents, "lower", lambda *parts: asked.append(parts) or lower(*parts))
    both(count=7)
    assert len(asked) == 1


def test_what_is_refused_is_the_simulations_business_first():
    cloth = make_sheet("fused")
    along = Directions({"areal_density.raw": torch.ones(1)}, state=make_perturbed_state(cloth))
    for state, motion, message in (
        (make_perturbed_state(cloth), [make_opening_motion(END)], "motion; got list; expected a dict"),
        (make_perturbed_state(cloth).x, make_opening_motion(END), "state; got Tensor; expected a ClothState"),
    ):
        with pytest.raises(InvalidInput, match=message):
            cloth.sensitivities(state, motion, (0.0, END), along=along)
