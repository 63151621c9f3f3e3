"""Motion against closed forms and conservation."""

import math

import pytest
import torch

import torchcloth as tc
from torchcloth.boundaries.motion import interpolate_poses, sample_trajectory


def sheet(size=0.3, n=8, *, effects=None, boundaries=None, contact=tc.Contact(), Y=300.0, density=0.15):  # noqa: B008
    mesh = tc.meshes.rectangle(size, size, resolution=(n, n))
    material = tc.materials.AEP(Y * 1e3, 0.3, contact_stiffness=1e6, shear_stiffness=2e5)
    return tc.Cloth(mesh, material, density, effects=effects, boundaries=boundaries, contact=contact)


def momenta(cloth, state):
    mass = cloth.build_model().mass
    linear = (mass * state.v).sum(-2)
    angular = torch.linalg.cross(state.x, mass * state.v).sum(-2)
    return linear, angular


def test_free_fall_is_exact():
    cloth = sheet(effects={"gravity": tc.effects.Gravity()})
    out = cloth(cloth.rest_state(), times=[0.0, 0.2])
    n = math.ceil(0.2 / cloth.stable_step() - 1e-9)
    dt = 0.2 / n
    expected = -9.81 * dt * dt * n * (n + 1) / 2  # symplectic Euler's own sum; 9.81 t^2 / 2 + O(dt)
    torch.testing.assert_close(out.x[-1, :, 2], torch.full((64,), expected), rtol=1e-9, atol=0)
    assert abs(expected + 9.81 * 0.02) < 9.81 * 0.2 * dt


def test_momentum_is_conserved_in_vacuum():
    cloth = sheet(contact=tc.Contact(everywhere=True))
    torch.manual_seed(0)
    state = cloth.state(cloth.rest_state().x, 0.5 * torch.randn(64, 3))
    before = momenta(cloth, state)
    after = momenta(cloth, cloth(state, times=[0.0, 0.05]).state)
    torch.testing.assert_close(after[0], before[0], rtol=0, atol=1e-12)


def test_angular_momentum_is_conserved_by_the_membrane():
    cloth = sheet(contact=None)
    torch.manual_seed(0)
    state = cloth.state(cloth.rest_state().x, 0.5 * torch.randn(64, 3))
    before = momenta(cloth, state)[1]
    after = momenta(cloth, cloth(state, times=[0.0, 0.05]).state)[1]
    torch.testing.assert_close(after, before, rtol=0, atol=1e-12)


@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.6, 0.0, 0.8)])
def test_a_spinning_sheet_is_not_braked_by_its_director(axis):
    cloth = sheet(n=6, contact=tc.Contact(everywhere=True))
    omega = 6.0 * torch.tensor(axis)
    x = cloth.rest_state().x
    centre = (cloth.build_model().mass * x).sum(0) / cloth.build_model().mass.sum()
    state = cloth.state(x, torch.linalg.cross(omega.expand_as(x), x - centre))
    before = cloth.energy(state)["kinetic"], momenta(cloth, state)[1]
    out = cloth(state, times=[0.0, 0.25]).state
    after = cloth.energy(out)["kinetic"], momenta(cloth, out)[1]
    torch.testing.assert_close(after[1], before[1], rtol=1e-9, atol=1e-12)
    assert abs(after[0] / before[0] - 1) < 1e-3  # the sheet stretches a little under the centrifugal load
    normals = cloth.state(out.x).d3
    torch.testing.assert_close(out.d3, normals, rtol=0, atol=1e-9)


def test_drag_reaches_terminal_velocity():
    air = tc.effects.AirDrag(normal=1.2, density=1.2)
    cloth = sheet(effects={"gravity": tc.effects.Gravity(), "air": air}, contact=None, density=0.15)
    terminal = math.sqrt(2 * 0.15 * 9.81 / (1.2 * 1.2))
    t = 0.6
    out = cloth(cloth.rest_state(), times=[0.0, t])
    expected = terminal * math.tanh(9.81 * t / terminal)
    torch.testing.assert_close(-out.v[-1, :, 2].mean(), torch.tensor(expected), rtol=2e-3, atol=0)


def test_amplitude_zero_is_bitwise_the_base_model():
    base = sheet(effects={"gravity": tc.effects.Gravity()}, contact=None)
    with_air = sheet(effects={"gravity": tc.effects.Gravity(), "air": tc.effects.AirDrag(normal=0.0)}, contact=None)
    torch.manual_seed(0)
    v = torch.randn(64, 3)
    a, b = (c(c.state(c.rest_state().x, v), times=[0.0, 0.03]).x for c in (base, with_air))
    assert torch.equal(a, b)


def test_hanging_strip_stretches_by_its_own_weight():
    Y, density, length = 20.0, 0.3, 0.4
    mesh = tc.meshes.rectangle(0.1, length, resolution=(5, 17))
    top = torch.nonzero(torch.as_tensor(mesh.uv[:, 1]) > length - 1e-9).flatten().tolist()
    material = tc.materials.AEP(Y * 1e3, 0.02)
    cloth = tc.Cloth(
        mesh,
        material,
        density,
        {"gravity": tc.effects.Gravity((0.0, -9.81, 0.0))},
        {"clamp": tc.boundaries.Grasp(top)},
        contact=None,
    )
    still = tc.Trajectory(torch.tensor([0.0, 9.0]), torch.eye(4).repeat(2, 1, 1), torch.ones(2, dtype=bool))
    state, sags = cloth.rest_state(), []
    for _ in range(2):  # no damping in the model: let it oscillate and average over whole periods
        period = 4 * length * math.sqrt(density / Y)
        out = cloth(state, {"clamp": still}, times=torch.linspace(0.0, period, 33))
        sags.append(-(out.x[:-1, :, 1] - cloth.rest_state().x[:, 1])[:, mesh.uv[:, 1] == 0].mean())
        state = out.state
        weight = out.wrench["clamp"][1:, 1].mean()
    expected = density * 9.81 * length**2 / (2 * Y)
    torch.testing.assert_close(torch.stack(sags).mean(), torch.tensor(expected), rtol=0.02, atol=0)
    torch.testing.assert_close(weight, torch.tensor(-density * 9.81 * 0.1 * length), rtol=0.02, atol=0)


def test_sticks_and_slides_on_an_incline():
    for slope, slides in ((0.9, False), (1.1, True)):
        mu = 0.4
        angle = math.atan(mu * slope)
        g = (9.81 * math.sin(angle), 0.0, -9.81 * math.cos(angle))
        cloth = sheet(
            n=4,
            effects={"gravity": tc.effects.Gravity(g)},
            contact=None,
            boundaries={"table": tc.boundaries.Plane(friction=mu)},
        )
        out = cloth(cloth.rest_state(), times=[0.0, 0.3])
        moved = float((out.x[-1] - out.x[0])[:, 0].mean().detach())
        expected = 0.5 * 9.81 * (math.sin(angle) - mu * math.cos(angle)) * 0.09 if slides else 0.0
        assert moved == pytest.approx(expected, rel=0.03, abs=1e-9)
        assert float(out.x.detach()[..., 2].min()) > -1e-9


@pytest.mark.parametrize("origin", [1000.0, 1.7e9])
def test_float32_has_room_for_substeps_whatever_the_clock_says(origin):
    mesh = tc.meshes.rectangle(0.1, 0.1, resolution=(4, 4))
    t = torch.linspace(0, 0.2, 9, dtype=torch.float64)
    pose = torch.eye(4).repeat(9, 1, 1)
    pose[:, 2, 3] = 0.05 * (1 - torch.cos(20 * t)).float()
    result = []
    for start in (0.0, origin):
        hand = {"hand": tc.boundaries.Grasp([0, 1])}
        cloth = tc.Cloth(mesh, tc.materials.AEP(1e5, 0.3), 0.2, boundaries=hand, contact=None).float()
        motion = {"hand": tc.Trajectory(start + t, pose, torch.ones(9, dtype=torch.bool))}
        still = cloth.settle(cloth.rest_state(), motion, start=start, duration=0.01)
        result.append(cloth(still, motion, [start, start + 0.2]))
    assert result[0].x.dtype == torch.float32
    torch.testing.assert_close(result[1].v, result[0].v, rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(result[1].wrench["hand"], result[0].wrench["hand"], rtol=1e-2, atol=1e-4)


def test_a_path_of_one_knot_stands_still():
    still = tc.Trajectory(torch.zeros(1), torch.eye(4)[None], torch.ones(1, dtype=torch.bool))
    torch.testing.assert_close(interpolate_poses(still, torch.tensor([-1.0, 0.0, 2.0])), torch.eye(4).expand(3, 4, 4))


def test_a_hand_that_closes_at_a_knot_of_single_precision_is_closed_there():
    """0.3 s is 0.30000001 in float32: cloth that settles from then was not held."""
    t = torch.linspace(0.0, 1.0, 11, dtype=torch.float32)
    motion = tc.Trajectory(t, torch.eye(4).repeat(11, 1, 1), torch.arange(11) >= 3)
    for start, closed in ((0.3, True), (0.2999, False), (0.0, False)):
        times = torch.tensor([start, start + 1e-3], dtype=torch.float64)
        assert sample_trajectory(motion, times).closed == (closed,), start


def path_along_x(t, x):
    pose = torch.eye(4, dtype=torch.float64).repeat(len(t), 1, 1)
    pose[:, 0, 3] = x
    return tc.Trajectory(t, pose, torch.ones(len(t), dtype=torch.bool))


@pytest.mark.parametrize("returns", [False, True])
def test_a_hand_whose_rest_has_two_knots_rests(returns):
    """Reported at 0.5 m/s and 100 Hz: it swung 73 mm backwards, and 124 mm forwards between a reach and a return."""
    steps = 0.01 * torch.arange(1, 101, dtype=torch.float64)
    t = torch.cat(
        [torch.zeros(1), steps if returns else torch.zeros(0), steps[-1:] * (1 + returns), 1 + returns + steps]
    )
    reached = 0.5 * torch.cat([torch.zeros(1), steps, steps[-1:]]) if returns else torch.zeros(2)
    x = torch.cat([reached, reached[-1] + (-0.5 if returns else 0.5) * steps])
    inside = torch.linspace(float(returns), 1.0 + returns, 101, dtype=torch.float64)
    between = interpolate_poses(path_along_x(t, x), inside)[:, 0, 3]
    torch.testing.assert_close(between, reached[-1].expand(101), rtol=0, atol=1e-12)


def test_a_path_through_waypoints_stays_between_them():
    torch.manual_seed(0)
    t, x = torch.rand(30).cumsum(0).double(), torch.randn(30).double()
    inside = t[:-1, None] + t.diff()[:, None] * torch.linspace(0.0, 1.0, 21)
    between = interpolate_poses(path_along_x(t, x), inside.flatten())[:, 0, 3].reshape(inside.shape)
    lower, upper = torch.minimum(x[1:], x[:-1])[:, None], torch.maximum(x[1:], x[:-1])[:, None]
    assert bool(((between >= lower - 1e-12) & (between <= upper + 1e-12)).all())


@pytest.mark.parametrize(("rate", "error"), [(30, 3.1e-5), (100, 8.1e-7)])
def test_turning_points_between_samples_are_not_cut_off(rate, error):
    """With slopes of parabolas the error is A (w h)^3 / (36 sqrt(3)); with monotone ones up to A (w h)^2 / 8."""
    t = torch.arange(rate + 1, dtype=torch.float64) / rate
    inside = torch.linspace(0.2, 0.8, 601, dtype=torch.float64)
    between = interpolate_poses(path_along_x(t, 0.2 * torch.sin(2 * math.pi * t + 0.1)), inside)[:, 0, 3]
    torch.testing.assert_close(between, 0.2 * torch.sin(2 * math.pi * inside + 0.1), rtol=0, atol=error)


def test_a_path_is_differentiable_where_it_is_monotone():
    t = torch.tensor([0.0, 1.0, 1.1, 1.2, 2.5], dtype=torch.float64)
    x = torch.tensor([0.0, 0.1, 0.3, 0.2, 0.21], dtype=torch.float64, requires_grad=True)
    times = torch.linspace(0.1, 2.4, 7, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda x: interpolate_poses(path_along_x(t, x), times)[:, 0, 3], x)
