"""A grip that slips, against the law that it should follow."""

import math

import pytest
import torch

import torchcloth as tc

STILL = {"hand": tc.Trajectory(torch.tensor([0.0, 9.0]), torch.eye(4).repeat(2, 1, 1), torch.ones(2, dtype=bool))}
DENSITY, WIDTH, LENGTH = 0.3, 0.1, 0.2
WEIGHT = DENSITY * WIDTH * LENGTH * 9.81


@pytest.fixture(autouse=True)
def _values_only():
    with torch.no_grad():
        yield


def sheet(mobility, hold, vertices=None, gravity=(0.0, -9.81, 0.0)):
    mesh = tc.meshes.rectangle(WIDTH, LENGTH, resolution=(4, 6))
    top = [k for k, uv in enumerate(mesh.uv) if uv[1] > LENGTH - 1e-9]
    effects = {"gravity": tc.effects.Gravity(gravity), "slip": tc.effects.GripSlip("hand", mobility, hold)}
    grasp = {"hand": tc.boundaries.Grasp(top if vertices is None else vertices)}
    return tc.Cloth(mesh, tc.materials.AEP(5e4, 0.02), DENSITY, effects, grasp, contact=None), torch.tensor(top)


def hung(cloth):
    return cloth.settle(cloth.rest_state(), STILL, duration=0.3, rate=100.0)


@pytest.mark.parametrize("share", [1.0, 0.5])
def test_creeps_at_the_speed_of_the_law(share):
    """A hanging sheet: b (weight - hold), whatever the step."""
    hold, mobility = 0.5 * WEIGHT, 0.02
    cloth, top = sheet(mobility, hold)
    times = torch.linspace(0.0, 0.4, 5)
    state = hung(cloth)
    out = cloth(state, STILL, times, dt=share * cloth.stable_step())
    speed = -(out.x[-1, top, 1] - out.x[1, top, 1]).mean() / 0.3
    assert float(speed) == pytest.approx(mobility * (WEIGHT - hold), rel=0.01)
    assert float(out.wrench["hand"][-1, 1]) == pytest.approx(-WEIGHT, rel=0.01)
    spread = out.x[-1, top] - state.x[top]
    assert (spread - spread[0]).abs().max() < 1e-12  # as one body


def test_holds_what_it_can_hold():
    cloth, top = sheet(0.02, 1.2 * WEIGHT)
    state = hung(cloth)
    out = cloth(state, STILL, times=[0.0, 0.1])
    torch.testing.assert_close(out.x[-1, top], state.x[top], rtol=0, atol=1e-15)


def test_the_pull_never_exceeds_what_a_slippery_grip_can_hold():
    hold = 0.3 * WEIGHT
    cloth, _ = sheet(1e9, hold)
    out = cloth(cloth.rest_state(), STILL, times=torch.linspace(0.0, 0.1, 11))
    pull = out.wrench["hand"][1:, :3].norm(dim=-1)
    assert float(pull.max()) <= hold * (1 + 1e-6)
    assert float(pull[-1]) == pytest.approx(hold, rel=1e-6)
    momentum = (cloth.build_model().mass * out.v[-1]).sum(0)[1]  # what the weight gave, less what the wrench says
    assert float(momentum) == pytest.approx(-0.1 * WEIGHT - 0.01 * float(out.wrench["hand"][1:, 1].sum()), rel=1e-9)


@pytest.mark.parametrize("mobility", [0.05, 5.0, 500.0])
def test_a_rigid_patch_follows_its_equation_of_motion(mobility):
    """M u' = M g - hold - u / b: the whole sheet in the gripper, from creep to free fall less friction."""
    hold = 0.4 * WEIGHT
    cloth, _ = sheet(mobility, hold, range(24))
    time = WEIGHT / 9.81 * mobility
    out = cloth(cloth.rest_state(), STILL, times=[0.0, 0.02, 0.1], dt=1e-4)
    for v, t in zip(out.v[1:, :, 1], out.t[1:].tolist(), strict=True):
        expected = mobility * (WEIGHT - hold) * -math.expm1(-t / time)
        torch.testing.assert_close(-v, torch.full((24,), expected), rtol=0.01, atol=0)


def test_slips_in_the_direction_of_the_pull():
    pull = (3.0, -4.0, 2.0)
    cloth, _ = sheet(0.05, 0.1 * WEIGHT, range(24), gravity=pull)
    moved = (cloth(cloth.rest_state(), STILL, times=[0.0, 0.1]).x[-1] - cloth.rest_state().x).mean(0)
    torch.testing.assert_close(moved / moved.norm(), torch.tensor(pull) / math.sqrt(29.0))


def test_an_open_gripper_has_no_friction():
    falls = []
    for effect in (True, False):
        cloth, _ = sheet(0.05, 0.1 * WEIGHT)
        if not effect:
            del cloth.effects["slip"]
        opened = {"hand": STILL["hand"]._replace(closed=torch.zeros(2, dtype=bool))}
        falls.append(cloth(cloth.rest_state(), opened, times=[0.0, 0.05]).x)
    assert torch.equal(*falls)


def test_gradients_at_no_pull_are_finite():
    cloth, _ = sheet(0.05, 0.0)
    effect = cloth.effects["slip"]
    with torch.enable_grad():
        v = torch.zeros(24, 3, requires_grad=True)
        index, mass = cloth.boundaries["hand"].index, cloth.build_model().mass.detach()
        out = effect.grip_velocities(effect.coefficients(), index, v, 0 * v, mass, 1e-4, None)
        gradients = torch.autograd.grad(out.sum(), [v, *effect.parameters()])
    assert all(torch.isfinite(g).all() for g in gradients)


def test_a_cloth_without_that_grasp_is_refused():
    mesh = tc.meshes.rectangle(WIDTH, LENGTH, resolution=(4, 6))
    slip = {"slip": tc.effects.GripSlip("left")}
    for boundaries in ({}, {"right": tc.boundaries.Grasp([0])}, {"left": tc.boundaries.Plane()}):
        with pytest.raises(tc.errors.InvalidInput, match="left"):
            tc.Cloth(mesh, tc.materials.AEP(1e5), 0.2, slip, boundaries)
    for options in ({"mobility": -1.0}, {"hold": -1.0}):
        with pytest.raises(tc.errors.InvalidInput):
            tc.effects.GripSlip("left", **options)


@pytest.mark.parametrize("engine", ["reference", "fused"])
@pytest.mark.parametrize(("viscosity", "mobility"), [(3.0, 0.5), (1.0, 1e3)])
def test_a_grip_that_yields_beside_viscosity_is_stable(engine, viscosity, mobility):
    """Stages hold what is held: where a grip yields much, viscous forces act in one piece."""
    cloth = tc.Cloth(
        tc.meshes.rectangle(0.2, 0.2, resolution=(6, 6)), tc.materials.AEP(1e5, 0.3), 0.15,
        {"viscous": tc.effects.KelvinVoigt(viscosity), "slip": tc.effects.GripSlip("hand", mobility, 0.1)},
        {"hand": tc.boundaries.Grasp(uv=[[0.0, 0.2]], radius=0.045)}, contact=None, engine=engine,
    )  # fmt: skip
    pose = torch.eye(4).repeat(2, 1, 1)
    pose[1, 1, 3] = 0.05
    motion = {"hand": tc.Trajectory(torch.tensor([0.0, 0.05]), pose, torch.ones(2, dtype=torch.bool))}
    with torch.no_grad():
        usual, fine = (cloth(cloth.rest_state(), motion, (0.0, 0.02, 0.03), dt=dt) for dt in (None, 1e-5))
    torch.testing.assert_close(usual.x, fine.x, rtol=0, atol=1e-4)
    assert float(usual.v.abs().max()) < 1.3 * float(fine.v.abs().max())
