"""Air that moves along, against closed forms."""

import math

import pytest
import torch

import torchcloth as tc
from torchcloth._utils.linalg import apply_added_mass
from torchcloth.dynamics import substep
from torchcloth.dynamics.forces import compute_added_mass_ratio

DENSITY = 0.18
DEPTH = 0.1  # m of air
EXTRA = 1.204 * DEPTH  # kg/m^2


@pytest.fixture(autouse=True)
def _values_only():
    with torch.no_grad():
        yield


def air(depth=DEPTH):
    return {"added": tc.effects.AddedMass(depth)}


def sheet(effects, boundaries=None, density=DENSITY):
    mesh = tc.meshes.rectangle(0.3, 0.2, resolution=(4, 4))
    return tc.Cloth(mesh, tc.materials.AEP(1e5, 0.3), density, effects, boundaries, contact=None)


def test_falls_slower_across_and_as_ever_along():
    cloth = sheet({"gravity": tc.effects.Gravity((3.0, 0.0, -4.0)), **air()})
    t = 0.1
    out = cloth(cloth.rest_state(), times=[0.0, t]).v[-1]
    expected = torch.tensor([3.0 * t, 0.0, -4.0 * t * DENSITY / (DENSITY + EXTRA)])
    torch.testing.assert_close(out, expected.expand_as(out), rtol=1e-11, atol=1e-12)


def normals(cloth, x):
    """Unit normals [E, 1, 3]."""
    a, b, c = x[torch.as_tensor(cloth.mesh.faces)].unbind(1)
    return torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1)[:, None]


def test_what_the_cloth_gains_the_air_loses_along_its_normals():
    """One step from a bent, stretched and moving state: m dv + m_air n d(n . v) = 0, a third of it at each corner."""
    cloth = sheet(air())
    torch.manual_seed(0)
    x, v = cloth.rest_state().x + 0.02 * torch.randn(16, 3), torch.randn(16, 3)
    dt, faces = cloth.stable_step(), torch.as_tensor(cloth.mesh.faces)
    after, _ = substep.step(cloth.build_model(), cloth.state(x, v), dt, {}, 0)
    n, turn = torch.func.jvp(lambda x: normals(cloth, x), (x,), (v,))
    change = (n * (after.v - v)[faces] + dt * turn * v[faces]).sum(-1, keepdim=True)
    impulse = (EXTRA / 3 * torch.as_tensor(cloth.mesh.area)[:, None, None] * change * n).sum((0, 1))
    parameter = (cloth.build_model().mass * (after.v - v)).sum(0)
    assert parameter.norm() > 1e3 * (parameter + impulse).norm()
    assert (parameter + impulse).norm() < 1e-12


@pytest.mark.parametrize("engine", ["reference", "fused"])
def test_cloth_and_air_keep_their_energy(engine):
    """A sheet that flies along itself, turns and flutters."""
    mesh = tc.meshes.rectangle(0.3, 0.3, resolution=(9, 9))
    cloth = tc.Cloth(mesh, tc.materials.AEP(1e5, 0.3), DENSITY, air(), None, contact=None, engine=engine)
    faces, share = torch.as_tensor(mesh.faces), EXTRA / 3 * torch.as_tensor(mesh.area)[:, None, None]

    def energy(state):
        across = (normals(cloth, state.x) * state.v[faces]).sum(-1, keepdim=True)
        return float(sum(cloth.energy(state).values()) + 0.5 * (share * across**2).sum())

    x = cloth.rest_state().x
    along = x[:, 0] - 0.15
    across = 6 * along + 200 * (along**2 - 0.0075)
    begin = cloth.state(x, torch.stack([torch.full_like(along, 2.0), 0 * along, across], -1))
    for shorter in (1, 2):
        out = cloth(begin, times=[0.0, 0.1, 0.25], dt=cloth.stable_step() / shorter)
        for x, v in zip(out.x, out.v, strict=True):  # within what the step does; 16 % at 0.1 s without what turns
            assert energy(cloth.state(x, v)) == pytest.approx(energy(begin), rel=0.05 / shorter)


def hanging(effects):
    mesh = tc.meshes.rectangle(0.04, 0.3, resolution=(2, 13))
    top = [k for k, uv in enumerate(mesh.uv) if uv[1] > 0.3 - 1e-9]
    effects = {"gravity": tc.effects.Gravity((0.0, -9.81, 0.0)), **effects}
    grasp = {"rod": tc.boundaries.Grasp(top)}
    return tc.Cloth(mesh, tc.materials.AEP(1e5, 0.02), EXTRA, effects, grasp, contact=None)


STILL = {"rod": tc.Trajectory(torch.tensor([0.0, 9.0]), torch.eye(4).repeat(2, 1, 1), torch.ones(2, dtype=bool))}


def test_a_hanging_strip_swings_slower_by_the_root_of_its_inertia():
    """Air as heavy as the cloth: 1.09 Hz / sqrt 2, in the shape of the chain's first mode J0(j01 sqrt(s / L)).

    Reached: frequencies 0.45 % and 0.48 % low with 12 cells, 0.29 % and 0.32 % with 16.
    """
    zero = 2.404826
    frequency = zero / 2 * math.sqrt(9.81 / 0.3) / (2 * math.pi)
    assert frequency == pytest.approx(1.094, abs=1e-3)
    bare = hanging({})
    rest = bare.settle(bare.rest_state(), STILL, duration=0.1, rate=150.0).x
    mode = torch.special.bessel_j0(zero * (rest[:, 1:2] / 0.3).clamp(min=0).sqrt())
    start = rest + 0.005 * mode * torch.tensor([0.0, 0.0, 1.0])
    for cloth, expected in ((bare, frequency), (hanging(air()), frequency / math.sqrt(2))):
        times = torch.linspace(0.0, 1.0, 21) / expected
        tip = cloth(cloth.state(start), STILL, times).x[:, 0, 2]
        for off, right in ((0.0, True), (0.02, False), (-0.02, False)):
            error = (tip / 0.005 - torch.cos(2 * math.pi * expected * (1 + off) * times)).abs().max()
            assert (error < 0.03) == right, (error, off)


def test_the_static_shape_stays():
    """A strip between two hands sags into a catenary, with or without air."""
    mesh = tc.meshes.rectangle(0.3, 0.04, resolution=(10, 2))
    ends = [k for k, uv in enumerate(mesh.uv) if min(uv[0], 0.3 - uv[0]) < 1e-9]
    shapes = []
    for effects in ({}, air()):
        effects = {"gravity": tc.effects.Gravity(), **effects}
        cloth = tc.Cloth(
            mesh, tc.materials.AEP(2e4, 0.02), DENSITY, effects, {"rod": tc.boundaries.Grasp(ends)}, contact=None
        )
        x = cloth.rest_state().x
        bowed = torch.stack([0.9 * x[:, 0], x[:, 1], -1.5 * x[:, 0] * (0.3 - x[:, 0])], -1)
        shapes.append(cloth.settle(cloth.state(bowed), STILL, duration=1.5, rate=20.0).x)
    assert shapes[0][:, 2].min() < -0.03
    torch.testing.assert_close(*shapes, rtol=0, atol=1e-4)


@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.0, 0.0, 1.0)])
def test_a_spinning_sheet_is_not_braked(axis):
    cloth = sheet(air())
    omega = 6.0 * torch.tensor(axis)
    x, mass = cloth.rest_state().x, cloth.build_model().mass
    centre = (mass * x).sum(0) / mass.sum()
    state = cloth.state(x, torch.linalg.cross(omega.expand_as(x), x - centre))
    out = cloth(state, times=[0.0, 0.25]).state
    before, after = (torch.linalg.cross(s.x - centre, mass * s.v).sum(0) for s in (state, out))
    torch.testing.assert_close(after, before, rtol=1e-3, atol=1e-6)


def test_a_gripper_feels_the_air_that_it_moves():
    """A plate held everywhere and accelerated across itself by 2 m/s^2 pulls with (m + m_air) a; along itself, m a."""
    cloth = sheet(air(), {"hand": tc.boundaries.Grasp(range(16))})
    t = torch.linspace(0.0, 0.4, 41)
    for axis, inertia in ((2, DENSITY + EXTRA), (0, DENSITY)):
        pose = torch.eye(4).repeat(41, 1, 1)
        pose[:, axis, 3] = t * t
        hand = {"hand": tc.Trajectory(t, pose, torch.ones(41, dtype=bool))}
        wrench = cloth(cloth.rest_state(), hand, [0.0, 0.1, 0.3]).wrench["hand"]
        assert float(wrench[-1, axis]) == pytest.approx(-2.0 * inertia * 0.06, rel=1e-3)


@pytest.mark.parametrize("engine", ["reference", "fused"])
def test_a_grip_yields_to_what_moves_the_air_too(engine):
    """The same plate, from hands that hold 0.03 N: more than the cloth's inertia asks for, less than with its air's."""
    boundaries = {"hand": tc.boundaries.Grasp(range(16))}
    cloth = sheet({**air(), "slip": tc.effects.GripSlip("hand", 1e3, 0.03)}, boundaries)
    cloth.engine = engine
    t = torch.linspace(0.0, 0.4, 41)
    for axis, pull in ((2, 0.03), (0, 2.0 * DENSITY * 0.06)):
        pose = torch.eye(4).repeat(41, 1, 1)
        pose[:, axis, 3] = t * t
        hand = {"hand": tc.Trajectory(t, pose, torch.ones(41, dtype=bool))}
        rollout = cloth(cloth.rest_state(), hand, torch.linspace(0.0, 0.3, 31))
        torch.testing.assert_close(rollout.wrench["hand"][3:, axis], torch.full((28,), -pull), rtol=0.02, atol=0)


@pytest.mark.parametrize("engine", ["reference", "fused"])
@pytest.mark.parametrize("sampling", [None, 0.02])
def test_air_makes_no_cloth_slip(engine, sampling):
    """Friction is mu times the push, and the weight is what it was: a sheet slides down a slope as in vacuum."""
    angle = math.atan(0.6)
    gravity = tc.effects.Gravity((9.81 * math.sin(angle), 0.0, -9.81 * math.cos(angle)))
    for mu in (0.4, 0.7):
        floor = {"floor": tc.boundaries.Plane(friction=mu, sampling=sampling)}
        slid = []
        for effects in ({}, air(0.3)):
            cloth = sheet({"gravity": gravity, **effects}, floor)
            cloth.engine = engine
            slid.append(cloth(cloth.rest_state(), times=[0.0, 0.2]).x[-1, :, 0])
        start = cloth.rest_state().x[:, 0]
        expected = 0.5 * 9.81 * max(math.sin(angle) - mu * math.cos(angle), 0.0) * 0.2**2
        torch.testing.assert_close(slid[0] - start, torch.full((16,), expected), rtol=0.01, atol=2e-5)
        torch.testing.assert_close(slid[1], slid[0], rtol=0, atol=2e-5)


@pytest.mark.parametrize("turn", [0.0, 0.5])
def test_what_stops_cloth_and_air_pushes_along_the_normal(turn):
    """A sheet aslant meets a smooth floor: no impulse along the floor, and no energy comes from it."""
    pose = torch.eye(4)
    pose[0, 0], pose[0, 1], pose[1, 0], pose[1, 1] = (math.cos(turn), -math.sin(turn), math.sin(turn), math.cos(turn))
    floor = tc.boundaries.Plane(friction=0.0, moving=True, pose=pose)
    cloth = sheet(air(0.3), {"floor": floor})
    x = cloth.rest_state().x
    aslant = torch.stack([x[:, 0], 0.8 * x[:, 1], 0.6 * x[:, 1]], -1)
    speed = torch.tensor([0.1, 0.2, -0.5]).expand(16, 3)
    still = {"floor": tc.Trajectory(torch.tensor([0.0, 1.0]), torch.eye(4).repeat(2, 1, 1), torch.ones(2, dtype=bool))}
    model, state = cloth.build_model(), cloth.state(aslant, speed)
    drives = {name: tc.boundaries.sample_trajectory(t, torch.tensor([0.0, 1e-4])) for name, t in still.items()}
    after, impulses = substep.step(model, state, 1e-4, drives, 0)
    assert float(after.v[aslant[:, 2] < 1e-9, 2].abs().max()) < 1e-12
    given = impulses["floor"][:3]
    assert float(given[2]) > 1e-3
    assert float(given[:2].abs().max()) < 1e-12 * float(given[2])
    inertia = compute_added_mass_ratio(model, substep.surface(model.geometry, aslant, speed), aslant)
    energy = [0.5 * float((model.mass * v * apply_added_mass(inertia, v)).sum()) for v in (speed, after.v)]
    assert energy[1] < energy[0]


@pytest.mark.parametrize("options", [{"length": -0.1}, {"density": 0.0}, {"density": math.inf}])
def test_refusals(options):
    with pytest.raises(tc.errors.InvalidInput, match="depth" if "length" in options else "density"):
        tc.effects.AddedMass(**options)
