"""Scenes of a batch in the lanes of packs: the same results as one by one."""

import pytest
import torch
from helpers.engine_agreement import (
    Outcome,
    compare_outcomes,
    compute_outcome,
    draw_noise,
    make_moving_hand,
    make_moving_state,
    sample_motion,
)
from torch.func import grad, jacrev

import torchcloth as tc
from torchcloth.engine import execution, fused
from torchcloth.engine.fused import FusedEngine
from torchcloth.engine.operators import Rollout

E = tc.effects
DT, SUBSTEPS = 1e-4, 60
TOLERANCES = (1e-12, 1e-11)  # of values, and of gradients, which add up many substeps
LANES = 8  # of float64


def make_cloth(**effects) -> tc.Cloth:
    mesh = tc.meshes.rectangle(0.3, 0.2, triangles=60)
    grasp = tc.boundaries.Grasp([0, 1])
    table = tc.boundaries.Plane([0.0, 0.0, -0.05], [0.1, 0.0, 1.0], 0.4, sampling=0.02)
    return tc.Cloth(mesh, tc.materials.AEP(6e3, 0.3), 0.15, effects, {"hand": grasp, "table": table}, contact=None)


def typical_effects() -> dict[str, E.AbstractEffect]:
    return {"gravity": E.Gravity(), "air": E.AirDrag(), "bending": E.Bending(1e-4, 0.02, weft_ratio=0.5)}


def check_lanes(cloth, motion, state, tolerances=TOLERANCES) -> tuple[Outcome, Outcome]:
    """Check that scenes in lanes and one by one agree, and return both outcomes."""
    outcome = compute_outcome(fused.rollout, cloth, motion, state, SUBSTEPS, DT)
    with execution.min_filled_lanes(2.0):  # more than all lanes
        reference = compute_outcome(fused.rollout, cloth, motion, state, SUBSTEPS, DT)
    compare_outcomes(outcome, reference, tolerances)
    return outcome, reference


@pytest.mark.parametrize("scenes", [6, 8, 19], ids=str)
def test_equals_scenes_one_by_one(scenes):
    cloth = make_cloth(**typical_effects())
    cloth.requires_grad_(True)
    state = make_moving_state(cloth, (scenes,))
    motion = {"hand": make_moving_hand(SUBSTEPS * DT, scenes=(scenes,))}
    outcome, reference = check_lanes(cloth, motion, state)
    assert any(not torch.equal(value, reference.values[name]) for name, value in outcome.values.items()), (
        "the scenes did not share lanes"
    )


def test_every_scene_has_parameters_of_its_own():
    cloth = make_cloth(**typical_effects())
    spread = 1 + 0.3 * draw_noise((LANES,), 5).abs()
    cloth.material.youngs_modulus = tc.PhysicalParameter(6e3 * spread.unsqueeze(-1), "Pa")
    cloth.requires_grad_(True)
    state = make_moving_state(cloth, (LANES,))
    motion = {"hand": make_moving_hand(SUBSTEPS * DT)}
    check_lanes(cloth, motion, state)


@pytest.mark.parametrize("budget", [0, 2**40], ids=["recomputed", "recorded"])
def test_records_of_any_interval(budget, monkeypatch):
    """The adjoint recomputes what exceeds its budget of memory."""
    monkeypatch.setattr(execution, "RECORD_BUDGET_BYTES", budget)
    monkeypatch.setattr(execution, "RECOMPUTE_BUDGET_BYTES", budget)
    cloth = make_cloth(**typical_effects())
    state, motion = make_moving_state(cloth, (LANES,)), {"hand": make_moving_hand(SUBSTEPS * DT)}
    check_lanes(cloth, motion, state)


@pytest.mark.parametrize("interval", [0, 1, 7])
def test_a_jacobian_reads_the_records_of_a_scene_that_ran_alone(interval):
    cloth = make_cloth(**typical_effects())
    state, motion = make_moving_state(cloth), {"hand": make_moving_hand(SUBSTEPS * DT)}
    prescribed = sample_motion(motion, SUBSTEPS, DT, {"hand": motion["hand"].pose})
    job = FusedEngine(cloth.build_model(), state, prescribed).job(state, torch.full((SUBSTEPS,), DT), prescribed)
    inputs = [tensor.detach() for tensor in job.inputs.values()]

    def heights(x: torch.Tensor) -> torch.Tensor:
        return Rollout.apply(job.program.number, SUBSTEPS, interval, x, *inputs[1:])[0][0, :LANES, 2]

    together = jacrev(heights)(inputs[0])
    one_by_one = torch.stack([grad(lambda x, k=k: heights(x)[k])(inputs[0]) for k in range(LANES)])
    torch.testing.assert_close(together, one_by_one, rtol=1e-11, atol=1e-14)


@pytest.mark.usefixtures("team")
def test_a_team_of_threads_shares_the_work():
    cloth = make_cloth(**typical_effects())
    state, motion = make_moving_state(cloth, (LANES,)), {"hand": make_moving_hand(SUBSTEPS * DT)}
    check_lanes(cloth, motion, state)


def test_float32():
    cloth = make_cloth(**typical_effects())
    state, motion = make_moving_state(cloth, (16,)), {"hand": make_moving_hand(SUBSTEPS * DT)}
    cloth, state = cloth.float(), state.map(lambda t: t.float())
    check_lanes(cloth, motion, state, (1e-4, 1e-3))
