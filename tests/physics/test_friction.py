"""Friction between the yarns against the closed form of Dahl's law."""

import math

import pytest
import torch
from helpers.bent_shapes import (
    compute_work,
    make_cycles,
    make_effect_inputs,
    make_gradient_problem,
    make_irregular_mesh,
    measure_momentum_drift,
    roll_to_cylinder,
    trace_memory,
)

import torchcloth as tc
from torchcloth.testing import check_gradients

HB, KNEE, LARGEST = 2e-4, 3.0, 8.0
HYSTERESIS, ANGLE = 2.0, 0.02


def bending_friction(mesh):
    return tc.effects.BendingFriction(HB, KNEE).bind(mesh)


def sheared(mesh, angle):
    """[V, 3] m: threads keep their length, the weft leans by ``angle`` [rad]."""
    u, v = torch.as_tensor(mesh.uv).T
    return torch.stack([u + v * torch.sin(angle), v * torch.cos(angle), torch.zeros_like(u)], dim=-1)


def loss(largest, knee, sliding):
    """Per area and cycle, once the loop is closed: 4 Z (K - k tanh(K / k))."""
    return 4 * sliding * (largest - knee * math.tanh(largest / knee))


# -- the law ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("degrees", [0, 30, 90])
def test_loss_of_a_bending_cycle(degrees):
    """Reached: 0.7 % low, from the fit of the curvature and the trapezoidal rule."""
    mesh = tc.meshes.rectangle(0.3, 0.3, resolution=(17, 17))
    effect = bending_friction(mesh)
    path = [roll_to_cylinder(mesh, k, degrees) for k in make_cycles(LARGEST, 60, 3)]
    whole = compute_work(effect, mesh, path) - compute_work(effect, mesh, path[: len(path) - 120])
    assert whole == pytest.approx(0.09 * loss(LARGEST, KNEE, HB), rel=0.01)


def test_loss_of_a_shear_cycle():
    """The strain is uniform: what is left is the trapezoidal rule."""
    mesh = make_irregular_mesh(6)
    effect = tc.effects.ShearFriction(HYSTERESIS, ANGLE).bind(mesh)
    path = [sheared(mesh, g) for g in make_cycles(0.1, 200, 3)]
    whole = compute_work(effect, mesh, path) - compute_work(effect, mesh, path[: len(path) - 400])
    assert whole == pytest.approx(0.09 * loss(0.1, ANGLE, HYSTERESIS / 2), rel=2e-4)


def test_width_of_the_loop_is_what_kes_reads():
    """Sliding, the moments of loading and unloading differ by 2HB, the shear forces by 2HG."""
    mesh = make_irregular_mesh(9)
    bend, shear = bending_friction(mesh), tc.effects.ShearFriction(HYSTERESIS, ANGLE).bind(mesh)
    for effect, shape, unit in ((bend, roll_to_cylinder, 40.0), (shear, sheared, 0.3)):
        memories = trace_memory(effect, mesh, [shape(mesh, s) for s in make_cycles(torch.tensor(unit), 40, 1)])
        up, down = memories[-21], memories[40]  # both where the strain is 0
        share = (up - down).chunk(2, dim=-1)[1].norm(dim=-1)
        torch.testing.assert_close(share, torch.full_like(share, 2.0), rtol=1e-2, atol=0)


def test_first_bend_from_the_virgin_sheet():
    """z = HB (1 - exp(-k / k_t)): the share has that length in whatever direction the sheet is rolled."""
    mesh = make_irregular_mesh(9)
    effect = bending_friction(mesh)
    for degrees in (0, 30, 45, 90):
        memory = trace_memory(effect, mesh, [roll_to_cylinder(mesh, k, degrees) for k in torch.linspace(0, 2.0, 5)])[-1]
        bent, share = (part.norm(dim=-1) for part in memory.chunk(2, dim=-1))
        torch.testing.assert_close(share, 1 - torch.exp(-bent / KNEE), rtol=1e-3, atol=0)
        assert bent.median().item() == pytest.approx(2.0, rel=0.01)


def test_the_path_counts_not_its_steps_nor_its_time():
    """Twice as many substeps, or any other duration of them, give the same internal variables."""
    mesh = make_irregular_mesh(6)
    shear = tc.effects.ShearFriction(HYSTERESIS, ANGLE).bind(mesh)
    angles = 0.1 * torch.tensor([0.0, 0.3, 1.0, 0.6, -0.4, 0.2])
    finer = torch.stack([angles[:-1], (angles[:-1] + angles[1:]) / 2], -1).flatten()
    finer = torch.cat([finer, angles[-1:]])
    end = trace_memory(shear, mesh, [sheared(mesh, g) for g in angles], dt=1e-3)[-1]
    torch.testing.assert_close(trace_memory(shear, mesh, [sheared(mesh, g) for g in finer], dt=1e-3)[-1], end)
    assert torch.equal(trace_memory(shear, mesh, [sheared(mesh, g) for g in angles], dt=2e-3)[-1], end)
    bend = bending_friction(mesh)
    tent = torch.as_tensor(mesh.uv[:, 0] - 0.15).abs()
    flat = torch.as_tensor(mesh.vertices)

    def lifted(h):  # in the normals' direction, so little that the curvature is proportional to h
        return flat + torch.stack([0 * tent, 0 * tent, 1e-6 * h * tent], dim=-1)

    bend.threshold = 1e-6
    ends = [trace_memory(bend, mesh, [lifted(10 * h) for h in heights])[-1] for heights in (angles, finer)]
    torch.testing.assert_close(*ends, rtol=1e-6, atol=1e-12)


# -- in the sheet -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["bending", "shear"])
def test_it_turns_with_the_sheet(kind):
    mesh = make_irregular_mesh(6)
    effect = bending_friction(mesh) if kind == "bending" else tc.effects.ShearFriction(HYSTERESIS, ANGLE).bind(mesh)
    x = [torch.as_tensor(mesh.vertices) + 0.01 * torch.randn(3, 36, 3, generator=torch.Generator().manual_seed(0))][0]
    turns = [torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(k)))[0] for k in range(3)]
    turns = [q * torch.linalg.det(q) for q in turns]
    memory = trace_memory(effect, mesh, list(x))[-1]
    moved = [y @ q.mT + 1.0 for y, q in zip(x, turns, strict=True)]
    turned = trace_memory(effect, mesh, moved)[-1]
    torch.testing.assert_close(turned, memory, rtol=1e-9, atol=1e-11)
    c = effect.coefficients()
    force = effect.force(c, make_effect_inputs(mesh, x[-1], memory))
    torch.testing.assert_close(effect.force(c, make_effect_inputs(mesh, moved[-1], turned)), force @ turns[-1].mT)


@pytest.mark.parametrize("kind", ["bending", "shear"])
def test_momentum_and_angular_momentum_are_kept(kind):
    friction = tc.effects.BendingFriction(0.02, 1.0) if kind == "bending" else tc.effects.ShearFriction(2.0, 0.01)
    linear, angular = measure_momentum_drift({"friction": friction})
    assert linear < 1e-9
    assert angular < 1e-9


def test_a_strip_keeps_part_of_its_bend():
    """Bent to k, let go: B k + z = 0 with z = HB (-1 + (1 + z_m) exp(-(k_m - k) / k_t)), solved by bisection."""
    B, friction, knee, bent = 1e-3, 4e-3, 4.0, 12.0
    mesh = tc.meshes.rectangle(0.12, 0.02, resolution=(13, 3))
    effects = {
        "bending": tc.effects.Bending(B),
        "friction": tc.effects.BendingFriction(friction, knee),
        "damping": tc.effects.MassDamping(700.0),
    }
    cloth = tc.Cloth(mesh, tc.materials.AEP(2e3, 0.02), 0.2, effects, contact=None)
    path = [roll_to_cylinder(mesh, k) for k in torch.linspace(0, bent, 13)]
    c = cloth.effects["friction"].coefficients()
    memory = trace_memory(cloth.effects["friction"], mesh, path)[-1]
    state = cloth.state(path[-1])._replace(memory={"effects.friction": memory})
    with torch.no_grad():
        out = cloth(state, times=(0.0, 0.5))
    start = 1 - math.exp(-bent / knee)

    def left(k):
        return B * k + friction * (-1 + (1 + start) * math.exp(-(bent - k) / knee))

    low, high = 0.0, bent
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (low, middle) if left(middle) > 0 else (middle, high)
    seen = cloth.effects["friction"].stencil.fit_surface(out.x[-1]).curvature[:, 0].median().item()
    assert c.item() == friction
    assert seen == pytest.approx(low, rel=0.02)
    assert 2.0 < low < 6.0


def test_gradients_through_a_reversal():
    """A strip that swings back: the law's kink is passed inside the rollout."""
    mesh = tc.meshes.rectangle(0.08, 0.04, resolution=(5, 3))
    effects = {
        "friction": tc.effects.BendingFriction(0.01, 1.0),
        "shear": tc.effects.ShearFriction(2.0, 0.01),
        "bending": tc.effects.Bending(2e-2),
    }
    cloth = tc.Cloth(mesh, tc.materials.AEP(200.0, 0.2), 0.2, effects, contact=None)
    crumpled = cloth.rest_state().x + 2e-3 * torch.randn(15, 3, generator=torch.Generator().manual_seed(0))
    state = cloth.state(crumpled)
    times = (0.0, 12 * cloth.stable_step())
    with torch.no_grad():
        out = cloth(state, times=torch.linspace(*times, 13)).x
    bent = cloth.effects["friction"].stencil.fit_surface(out).curvature.diff(dim=0)
    assert (bent[1:] * bent[:-1] < 0).any(0).float().mean() > 0.8, "most curvatures turn round"
    names = ("friction.moment", "shear.hysteresis", "bending.stiffness")
    check_gradients(*make_gradient_problem(cloth, state, times, names), 1e-6, acts=True)


@pytest.mark.parametrize("make", [tc.effects.BendingFriction, tc.effects.ShearFriction])
@pytest.mark.parametrize("options", [{"threshold": 0.0}, {"threshold": math.nan}, {"amount": -1.0}])
def test_refusals(make, options):
    with pytest.raises(tc.errors.InvalidInput, match="moment|hysteresis" if "amount" in options else "threshold"):
        make(options.get("amount", 1.0), options.get("threshold", 1.0))
