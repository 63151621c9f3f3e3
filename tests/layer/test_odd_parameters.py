"""Parameters that are shared, batched, of another precision or not a number."""

import numpy as np
import pytest
import torch

import torchcloth as tc
from torchcloth.errors import InvalidInput

MESH = tc.meshes.rectangle(0.2, 0.2, resolution=(4, 4))
ENGINES = pytest.mark.parametrize("engine", ["fused", "reference"])


def cloth(effects, engine="auto", boundaries=None):
    return tc.Cloth(MESH, tc.materials.AEP(1e5, 0.3), 0.2, effects, boundaries, contact=None, engine=engine)


@ENGINES
def test_a_shared_parameter_has_all_of_its_derivative(engine):
    a, b = tc.effects.MassDamping(2.0), tc.effects.MassDamping(2.0)
    b.rate.raw = a.rate.raw
    both = cloth({"a": a, "b": b, "g": tc.effects.Gravity()}, engine)
    both(both.rest_state(), times=[0.0, 0.02]).x[-1].sum().backward()
    along = tc.Directions({"effects.a.rate.raw": torch.ones(1)})
    _, moved = both.sensitivities(both.rest_state(), {}, [0.0, 0.02], along=along)
    torch.testing.assert_close(moved.x[0, -1].sum(), a.rate.raw.grad, rtol=1e-9, atol=0)


def test_directions_of_a_force_stand_in_front_of_the_batch():
    """As many directions as scenes: one axis for the other is no error of shapes."""
    force, along = torch.randn(16, 3), tc.Directions({"effects.f.acceleration.raw": torch.randn(2, 16, 3)})
    moved = []
    for engine in ("fused", "reference"):
        pushed = cloth({"f": tc.effects.BodyForce(force)}, engine)
        x = pushed.rest_state().x
        state = pushed.state(torch.stack([x, 1.01 * x]))
        moved.append(pushed.sensitivities(state, {}, [0.0, 0.01], along=along)[1].x)
    torch.testing.assert_close(*moved, rtol=1e-8, atol=1e-14)


@ENGINES
def test_twist_may_differ_in_a_batch(engine):
    def end(ratio):
        bent = cloth({"b": tc.effects.Bending(1e-4, twist_ratio=ratio)}, engine)
        x = bent.rest_state().x
        twisted = x + torch.tensor([0.0, 0.0, 0.5]) * x[:, :1] * x[:, 1:2]
        return bent(bent.state(twisted), times=[0.0, 0.02], dt=1e-4).x[..., -1, :, :]

    both = end(torch.tensor([[1.0], [2.0]]))
    torch.testing.assert_close(both, torch.stack([end(1.0), end(2.0)]), rtol=0, atol=1e-9)


@ENGINES
@pytest.mark.parametrize(("made", "parameter"), [(torch.float64, torch.float32), (torch.float32, torch.float64)])
def test_parts_take_the_precision_of_the_cloth(engine, made, parameter):
    before = torch.get_default_dtype()
    try:
        torch.set_default_dtype(made)
        floor = tc.boundaries.Plane((0.0, 0.0, -1e-3), friction=tc.boundaries.Elliptic(0.3, 0.4))
        effects = {"g": tc.effects.Gravity(), "pull": tc.effects.Adhesion(1.0)}
        torch.set_default_dtype(parameter)
        out = cloth(effects, engine, {"floor": floor})
        rollout = out(out.rest_state(), times=[0.0, 0.02])
        assert rollout.x.dtype == rollout.state.v.dtype == parameter
    finally:
        torch.set_default_dtype(before)


def test_a_law_near_the_edge_of_a_strip_that_is_all_edge():
    strip = tc.meshes.rectangle(0.3, 0.05, resolution=(7, 2))
    law = tc.effects.ResidualForce({"across@edge": 0.1, "mass@inside": 0.1})
    out = tc.Cloth(strip, tc.materials.AEP(1e5, 0.3), 0.2, {"law": law, "g": tc.effects.Gravity()}, contact=None)
    assert bool(out(out.rest_state(), times=[0.0, 0.02]).x.isfinite().all())


def test_a_threshold_that_is_no_number_is_refused_by_name():
    slip = tc.effects.GripSlip("hand", 0.1, 0.1)
    gripped = cloth({"slip": slip}, boundaries={"hand": tc.boundaries.Grasp([0, 1])})
    with torch.no_grad():
        slip.hold.raw.fill_(torch.nan)
    hand = tc.Trajectory(torch.tensor([0.0, 1.0]), torch.eye(4).repeat(2, 1, 1), torch.ones(2, dtype=torch.bool))
    with pytest.raises(InvalidInput, match=r"effects\.slip\.hold\.raw; got NaN"):
        gripped(gripped.rest_state(), {"hand": hand}, times=[0.0, 0.01])
    with torch.no_grad():
        gripped.areal_density.raw.fill_(torch.nan)
    assert "16 vertices" in str(gripped)


@pytest.mark.parametrize("times", [None, "abc", [[0.0, 1.0]]])
def test_times_that_are_none(times):
    with pytest.raises(InvalidInput, match="times"):
        cloth({})(cloth({}).rest_state(), times=times)


def test_a_step_that_is_no_number():
    with pytest.raises(InvalidInput, match="dt"):
        cloth({})(cloth({}).rest_state(), times=[0.0, 0.1], dt="a")


def test_faces_are_not_cut_off():
    with pytest.raises(InvalidInput, match="faces"):
        tc.meshes.Mesh.build(np.eye(3), [[0, 1.2, 2.9]])
    assert len(tc.meshes.Mesh.build(np.eye(3), [[0.0, 1.0, 2.0]]).faces) == 1
