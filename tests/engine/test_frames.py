"""Frames that one call of the engine gives together are those that it gives one by one."""

import pytest
import torch
from helpers.engine_cloths import make_opening_motion, make_perturbed_state, make_sheet

import torchcloth as tc
from torchcloth.engine import execution
from torchcloth.errors import SimulationDiverged
from torchcloth.simulation import rollout

END = 0.02
UNEVEN = (0.0, 0.003, 0.0035, 0.011, END)  # substeps of another length in each interval


def one_by_one(monkeypatch):
    monkeypatch.setattr("torchcloth.engine.fused.FusedEngine.is_plain", lambda *_: False)


def slipping():
    """A cloth that remembers, whose grip yields."""
    effects = {
        "gravity": tc.effects.Gravity(),
        "slip": tc.effects.GripSlip("right", 0.5, 0.0),
        "friction": tc.effects.ShearFriction(1.0),
        "bending": tc.effects.Bending(1e-4, damping_time=1e-3),
    }
    return make_sheet("fused", effects=effects)


@pytest.mark.parametrize("make", [lambda: make_sheet("fused"), slipping], ids=["plain", "slipping"])
@pytest.mark.parametrize("batch", [(), (3,), (2, 2)], ids=str)
def test_frames_together_are_frames_one_by_one(make, batch, monkeypatch):
    cloth = make()
    with torch.no_grad():
        together = cloth(make_perturbed_state(cloth, batch), make_opening_motion(END), UNEVEN)
        one_by_one(monkeypatch)
        apart = cloth(make_perturbed_state(cloth, batch), make_opening_motion(END), UNEVEN)
    assert torch.equal(together.x, apart.x)
    assert torch.equal(together.v, apart.v)
    assert together.wrench.keys() == apart.wrench.keys() == {"left", "right"}
    assert all(torch.equal(together.wrench[name], apart.wrench[name]) for name in apart.wrench)
    assert together.state.memory.keys() == apart.state.memory.keys()
    assert all(torch.equal(together.state.memory[key], apart.state.memory[key]) for key in apart.state.memory)


def test_long_simulations_are_cut_into_calls(monkeypatch):
    cloth, calls = make_sheet("fused"), []
    forward = execution.forward
    monkeypatch.setattr(
        execution,
        "forward",
        lambda job, record_interval=0: calls.append(job.frame_ends) or forward(job, record_interval),
    )
    with torch.no_grad():
        whole = cloth(make_perturbed_state(cloth), make_opening_motion(END), UNEVEN)
        assert len(calls) == 1
        monkeypatch.setattr(rollout, "MAX_VERTEX_SUBSTEPS_PER_CALL", 2 * calls[0][0] * rollout.MIN_COUNTED_VERTICES)
        cut = cloth(make_perturbed_state(cloth), make_opening_motion(END), UNEVEN)
    assert 1 < len(calls[1:]) < len(UNEVEN)
    assert torch.equal(whole.x, cut.x)
    assert all(torch.equal(whole.wrench[name], cut.wrench[name]) for name in whole.wrench)


@pytest.mark.parametrize("wanted", ["cloth", "t", "pose"])
def test_who_wants_gradients_gets_them_and_the_same_frames(wanted):
    cloth, motion = make_sheet("fused"), make_opening_motion(END)
    with torch.no_grad():
        together = cloth(make_perturbed_state(cloth), motion, UNEVEN)
    if wanted != "cloth":
        cloth.requires_grad_(False)
        leaf = getattr(motion["left"], wanted).clone().requires_grad_()
        motion["left"] = motion["left"]._replace(**{wanted: leaf})
    apart = cloth(make_perturbed_state(cloth), motion, UNEVEN)
    assert apart.x.requires_grad
    assert torch.equal(together.x, apart.x)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_nobody_prescribed_it(dtype, monkeypatch):
    cloth = make_sheet("fused", boundaries={}).to(dtype)
    with torch.no_grad():
        together = cloth(make_perturbed_state(cloth), times=UNEVEN)
        one_by_one(monkeypatch)
        apart = cloth(make_perturbed_state(cloth), times=UNEVEN)
    assert together.x.dtype == dtype
    assert torch.equal(together.x, apart.x)


def test_who_keeps_the_last_state_keeps_no_other_frames():
    cloth = make_sheet("fused")
    with torch.no_grad():
        last = cloth(make_perturbed_state(cloth), make_opening_motion(END), UNEVEN).state
    assert last.x.untyped_storage().nbytes() == last.x.numel() * last.x.element_size()


def test_a_cloth_that_is_lost_is_told_alike(monkeypatch):
    cloth = make_sheet("fused", material=tc.materials.AEP(1e5, 0.3))
    torn, messages = make_perturbed_state(cloth), []
    torn = torn._replace(v=torn.v * 1e155)  # its square overflows
    for apart in (False, True):
        if apart:
            one_by_one(monkeypatch)
        with torch.no_grad(), pytest.raises(SimulationDiverged) as error:
            cloth(torn, make_opening_motion(END), UNEVEN)
        messages.append(str(error.value))
    assert messages[0] == messages[1]
