"""Contact between layers in the fused engine: agreement with the reference where layers press, slide, part and meet."""

import math
from itertools import pairwise

import numpy as np
import pytest
import torch
import torch.autograd.forward_ad as forward_ad
from helpers.engine_agreement import check_agreement, compute_outcome, draw_noise, make_moving_hand, relative_difference

import torchcloth as tc
from torchcloth.dynamics import substep
from torchcloth.dynamics.contact import self_contact
from torchcloth.engine import execution, fused
from torchcloth.simulation.sensitivities import SETTLING_DAMPING_RATE_PER_S, Directions

SPACING, PLAY = 0.012, tc.Contact().free_compression


def layers(contact: tc.Contact, *, effects=None, boundaries=None, woven=False):
    """(a sheet above another as one cloth, its lower vertices): parameters differ from triangle to triangle."""
    below, above = (tc.meshes.rectangle(a, a, resolution=(n, n)) for a, n in ((0.1, 8), (0.08, 7)))
    count, angle = len(below.vertices), 0.3
    c, s = math.cos(angle), math.sin(angle)
    upper = above.vertices @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T + np.array([0.03, 0.01, 1.7 * SPACING])
    mesh = tc.meshes.Mesh.build(
        np.concatenate([below.vertices, upper]),
        np.concatenate([below.faces, above.faces + count]),
        np.concatenate([below.uv, above.uv + np.array([1.0, 0.0])]),
    )
    around = 1 + 0.2 * draw_noise((len(mesh.faces),), 5).clamp(-2, 2).to(torch.get_default_dtype())
    law = {"contact_stiffness": 5e4 * around, "shear_stiffness": 3e3, "cone": 0.6 * around.flip(0)}
    material = tc.materials.OrthotropicAEP(6e4, 4e4, 2e4, **law) if woven else tc.materials.AEP(6e4, **law)
    effects = effects or {"gravity": tc.effects.Gravity()}
    return tc.Cloth(mesh, material, 0.15 * around.roll(9), effects, boundaries or {}, contact), count


def pressed(cloth, count, scenes=(), sideways=1.0, down=-1.0, steps=60):
    """A state of layers that have come together, some points slipping on each other and some not."""
    rest = cloth.rest_state().x
    x = rest + 2e-4 * draw_noise((*scenes, *rest.shape), 1).to(rest)
    v = 0.2 * draw_noise((*scenes, *rest.shape), 2).to(rest)
    v[..., count:, 2] += down
    v[..., count:, 0] += sideways * (rest[count:, 1] > 0.05)
    with torch.no_grad():
        state, _ = substep.rollout(cloth.build_model(), cloth.state(x, v), 1e-4, {}, steps)
    memory = {"contact": state.memory["contact"] + draw_noise(state.memory["contact"].shape, 3).to(rest)}
    return state._replace(d3=state.d3 * (1 + 0.05 * draw_noise((*state.d3.shape[:-1], 1), 6).to(rest)), memory=memory)


def branches(cloth, state) -> dict[str, int]:
    """How many points are in which branch of the law."""
    model = cloth.build_model()
    n = substep.surface(model.geometry, state.x, state.v).n.repeat_interleave(len(model.grid.points), -2)
    c = cloth.material.coefficients()
    each, faces = len(model.grid.points), len(model.geometry.area)
    k, shear, cone = (f.expand(faces, 1).repeat_interleave(each, 0) for f in (c.contact, c.shear, c.cone))
    height = (n * state.d3).sum(-1, keepdim=True)
    slip = shear * (state.d3 - height * n).norm(dim=-1, keepdim=True)
    limit = cone * k * (1 - height - PLAY).clamp(min=0) ** 2
    press = height < 1 - PLAY - 1e-9
    at_limit = press & (slip > (1 - 1e-9) * limit)
    return {
        "slip": int(at_limit.sum()),
        "stick": int((press & ~at_limit).sum()),
        "free": int((~press & (height < 1)).sum()),
        "parted": int((height >= 1).sum()),
    }


@pytest.mark.parametrize("subdivisions", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_pressed_and_sliding(subdivisions):
    cloth, count = layers(tc.Contact(spacing=SPACING, subdivisions=subdivisions))
    state = pressed(cloth, count)
    results = branches(cloth, state)
    assert min(results.values()) > 3, results
    print(results, check_agreement(cloth, {}, state))


@pytest.mark.slow
@pytest.mark.usefixtures("team")
def test_with_air_hand_and_woven_cloth():
    """Contact between the other parts: the air resists what it does, the hand takes part of it."""
    cloth, count = layers(
        tc.Contact(spacing=SPACING),
        effects={
            "gravity": tc.effects.Gravity(),
            "air": tc.effects.AddedMass(0.02),
            "drag": tc.effects.AirDrag(),
            "bending": tc.effects.Bending(1e-5, 0.01),
        },
        boundaries={"hand": tc.boundaries.Grasp([9, 10, 30])},
        woven=True,
    )
    print(check_agreement(cloth, {"hand": make_moving_hand(0.01)}, pressed(cloth, count)))


def test_everywhere():
    cloth, count = layers(tc.Contact(spacing=SPACING, everywhere=True, free_compression=0.0, damping=0.0))
    print(check_agreement(cloth, {}, pressed(cloth, count, steps=40), substeps=60))


def folded(contact):
    """(a strip folded on itself whose upper half rolls along at a speed, its state)"""
    mesh = tc.meshes.rectangle(0.4, 0.05, resolution=(41, 6))
    cloth = tc.Cloth(
        mesh,
        tc.materials.AEP(6e4, 0.3, contact_stiffness=5e4, shear_stiffness=3e4),
        0.15,
        {"gravity": tc.effects.Gravity()},
        {},
        contact,
    )
    x = torch.as_tensor(mesh.vertices).clone()
    over = x[:, 0] > 0.2
    x[over, 0], x[over, 2] = 0.4 - x[over, 0], 1.3 * SPACING
    v = torch.zeros_like(x)
    v[over, 0] = -9.0
    v[:, 2] = 0.1 * draw_noise((len(x),), 4)
    state = cloth.state(x, v)
    return cloth, state._replace(d3=0.97 * state.d3)  # pressed, so that the closing rate counts at once


@pytest.mark.usefixtures("team")
def test_triangles_come_and_go():
    """Searches in between wake some triangles and put others to sleep, at the start of a chunk and within one."""
    cloth, state = folded(tc.Contact(spacing=SPACING))
    model, now, known, seen = cloth.build_model(), state, None, []
    with torch.no_grad():
        for _ in range(60):
            before, known = known, self_contact.find_contact_candidates(model, model.grid, now.x, known)
            if before is not known:
                seen.append(set(known.active.tolist()))
            now, _ = substep.step(model, now, 5e-5, {}, 0, known)
    assert len(seen) > 3
    assert any(b - a for a, b in pairwise(seen))
    assert any(a - b for a, b in pairwise(seen))
    print([len(s) for s in seen], check_agreement(cloth, {}, state, substeps=120, dt=5e-5))


@torch.no_grad()
def test_a_sheet_alone_is_bitwise_one_without_contact():
    mesh = tc.meshes.rectangle(0.3, 0.2, triangles=200)
    runs = []
    for contact in (None, tc.Contact(spacing=0.02)):
        cloth = tc.Cloth(mesh, tc.materials.AEP(6e4), 0.15, {"gravity": tc.effects.Gravity()}, {}, contact)
        x = torch.as_tensor(mesh.vertices).clone()
        x[:, 2] = 0.02 * torch.sin(20 * x[:, 0])
        runs.append(fused.rollout(cloth.build_model(), cloth.state(x), 1e-4, {}, 100)[0])
    assert torch.equal(runs[0].x, runs[1].x)
    assert torch.equal(runs[0].v, runs[1].v)
    normals = substep.surface(cloth.build_model().geometry, runs[1].x, runs[1].v).n
    assert relative_difference(runs[1].d3, normals.repeat_interleave(cloth.contact_grid().points.shape[0], 0)) < 1e-12


def test_batch():
    """Scenes that differ in state and stiffness do not meet."""
    cloth, count = layers(tc.Contact(spacing=SPACING))
    faces = len(cloth.mesh.faces)
    cloth.material.contact_stiffness = tc.PhysicalParameter(
        torch.tensor([[3e4], [5e4], [8e4]]).expand(3, faces).clone(), "Pa"
    )
    cloth.material.shear_stiffness = tc.PhysicalParameter(torch.tensor([[3e4], [2e4], [4e4]]), "Pa")
    print(check_agreement(cloth, {}, pressed(cloth, count, (3,)), substeps=40))


@pytest.mark.usefixtures("team")
def test_recomputed_substeps_are_bitwise_the_recorded_ones():
    cloth, state = folded(tc.Contact(spacing=SPACING))
    with torch.no_grad():
        job = fused.FusedEngine(cloth.build_model(), state, {}).job(state, torch.full((120,), 5e-5), {})
    adjoints = []
    for every in (1, 7, 120):
        results, records = execution.forward(job, every)
        seeds = {f: draw_noise(t.shape, k, t.dtype) for k, (f, t) in enumerate(results.items())}
        adjoints.append(execution.reverse(job, records, every, seeds, set(job.inputs)))
    for other in adjoints[1:]:
        assert all(torch.equal(value, other[f]) for f, value in adjoints[0].items())


@pytest.fixture
def _restored():
    before = torch.get_default_dtype()
    yield
    torch.set_default_dtype(before)


@pytest.mark.usefixtures("_restored")
def test_single_precision():
    """Gradients of 1000 substeps of layers that slide on each other, in float32 and in float64."""
    results = []
    for dtype in (torch.float64, torch.float32):
        torch.set_default_dtype(dtype)
        cloth, count = layers(tc.Contact(spacing=SPACING))
        start = (
            pressed(cloth, count, sideways=0.3, down=-0.2) if not results else results[0][1].map(lambda t: t.float())
        )
        gradients = compute_outcome(fused.rollout, cloth, {}, start, 1000, 2e-5).gradients
        results.append(({k: g.double() for k, g in gradients.items() if g is not None}, start))
    for name, exact in results[0][0].items():
        rough = results[1][0][name]
        error = float((rough - exact).norm() / exact.norm())
        cosine = float((rough * exact).sum() / rough.norm() / exact.norm())
        print(name, error, 1 - cosine)
        assert error < 1e-3, name
        assert cosine > 0.9999, name


def test_layers_that_pressed_on_each_other_while_they_settled_have_stopped():
    """The rate at which they closed damps contact; of rest there is none."""
    cloth, count = layers(tc.Contact(spacing=SPACING))
    state = pressed(cloth, count)
    along = Directions(parameters={"areal_density.raw": torch.ones(1, *cloth.areal_density.raw.shape)})
    value, _ = cloth.sensitivities(state, {}, (0.0, 0.002), along=along, settle=0.01)
    with torch.no_grad():
        settled = cloth.settle(state, duration=0.01, rate=SETTLING_DAMPING_RATE_PER_S)
        expected = cloth(settled, times=(0.0, 0.002))
    assert relative_difference(value.v, expected.v) < 1e-10


def test_first_directors_know_how_near_layers_are():
    """How far they start compressed is a function of the gap; its derivative was left out, for one of some hundreds."""
    cloth, count = layers(tc.Contact(spacing=SPACING))
    rest, up = cloth.rest_state().x, torch.zeros_like(cloth.rest_state().x)
    up[count:, 2] = 1.0
    height = lambda gap: cloth.state(rest + gap * up).d3.sum()  # noqa: E731
    gap = torch.tensor(1e-5, requires_grad=True)
    (slope,) = torch.autograd.grad(height(gap), gap)
    with forward_ad.dual_level():
        along = forward_ad.unpack_dual(height(forward_ad.make_dual(gap.detach(), torch.tensor(1.0)))).tangent
    numerical = (height(gap.detach() + 1e-7) - height(gap.detach() - 1e-7)) / 2e-7
    assert abs(float(numerical)) > 100
    assert float(slope) == pytest.approx(float(numerical), rel=1e-6)
    assert float(along) == pytest.approx(float(numerical), rel=1e-6)
