"""The layer: what it refuses, what it promises about steps, time and grasps."""

import math
import warnings

import pytest
import torch
from helpers.small_sheet import make_sheet

import torchcloth as tc
from torchcloth.boundaries import sample_trajectory
from torchcloth.boundaries.motion import check_trajectory
from torchcloth.dynamics import substep
from torchcloth.errors import InvalidInput, SimulationDiverged, UnstableStep


def trajectory(end=1.0, knots=2, closed=True, pose=None):
    pose = torch.eye(4).repeat(knots, 1, 1) if pose is None else pose
    return tc.Trajectory(torch.linspace(0.0, end, knots), pose, torch.full((knots,), closed))


def turning(end, angle, knots):
    """Turns about z by ``angle`` while it travels."""
    a = torch.linspace(0.0, angle, knots)
    pose = torch.eye(4).repeat(knots, 1, 1)
    pose[:, 0, 0] = pose[:, 1, 1] = a.cos()
    pose[:, 1, 0], pose[:, 0, 1] = a.sin(), -a.sin()
    pose[:, :3, 3] = torch.stack([0.1 * a, -0.05 * a**2, 0.02 * a], dim=-1)
    return trajectory(end, knots, pose=pose)


@pytest.fixture
def gripped():
    return make_sheet(boundaries={"hand": tc.boundaries.Grasp([0, 1]), "table": tc.boundaries.Plane()})


# -- refusals ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("motion", "message"),
    [
        (None, r"motion; got trajectories for \[\]; expected one for each of \['hand'\]"),
        ({"hand": trajectory(), "foot": trajectory()}, r"motion; got .*foot"),
        ({"table": trajectory()}, r"motion; got .*table"),
        (
            {"hand": trajectory(end=0.05)},
            r"motion\['hand'\]\.t; got \[0, 0\.05\] s; expected to cover .* \[0, 0\.1\] s",
        ),
        ({"hand": trajectory()._replace(t=torch.tensor([1.0, 0.0]))}, "do not increase"),
        ({"hand": trajectory()._replace(t=torch.tensor([0.5, 1.0]))}, "to cover"),
        ({"hand": trajectory()._replace(t=torch.tensor([0, 1]))}, r"t; got int64; expected finite seconds"),
        ({"hand": trajectory()._replace(t=torch.tensor([0.0, math.inf]))}, "infinite times"),
        ({"hand": trajectory()._replace(pose=torch.eye(4))}, r"pose \[\.\.\., K, 4, 4\]"),
        ({"hand": trajectory()._replace(closed=torch.tensor(True))}, r"closed \[K\]"),
        ({"hand": trajectory(pose=torch.full((2, 4, 4), math.nan))}, "NaN"),
        (
            {"hand": trajectory(pose=(torch.eye(4) + torch.eye(4)[3, :, None] * 0.1).repeat(2, 1, 1))},
            "a last row that is not 0 0 0 1; .*transpose",
        ),
        ({"hand": turning(1.0, math.radians(95), 2)}, "over 90 degrees between knots; .*more knots"),
        ([trajectory()], "motion; got list; expected a dict"),
        ({"hand": torch.eye(4)}, r"motion\['hand'\]; got Tensor; expected a Trajectory"),
        ({"hand": trajectory()._replace(closed=torch.ones(2))}, "closed; got float32; expected bool; for example"),
        ({"hand": trajectory()._replace(closed=[True, True])}, r"motion\['hand'\]; got Tensor, Tensor, list"),
        ({"hand": trajectory(pose=torch.eye(4).long().repeat(2, 1, 1))}, r"pose; got torch\.int64"),
    ],
)
def test_refuses_motion(gripped, motion, message):
    with pytest.raises(InvalidInput, match=message):
        gripped(gripped.rest_state(), motion, times=[0.0, 0.1])


def test_accepts_turns_of_90_degrees_in_steps(gripped):
    gripped(gripped.rest_state(), {"hand": turning(1.0, math.radians(170), 3)}, times=[0.0, 0.002])


@pytest.mark.parametrize("times", [[0.0], [0.0, 0.0], [0.1, 0.0], [0.0, math.nan], [], torch.tensor([0.0, 2.0, 1.0])])
def test_refuses_times(times):
    cloth = make_sheet()
    with pytest.raises(InvalidInput, match=r"times; got .* increasing"):
        cloth(cloth.rest_state(), times=times)


def test_refuses_times_that_want_gradients():
    """They would stay without, and nobody would be told."""
    cloth, times = make_sheet(), torch.tensor([0.0, 0.01], requires_grad=True)
    with pytest.raises(InvalidInput, match=r"times; got .*gradients.*Trajectory\.t"):
        cloth(cloth.rest_state(), times=times)
    with torch.no_grad():
        cloth(cloth.rest_state(), times=times)


@pytest.mark.parametrize("shape", [(15, 3), (16, 2), (16,), (2, 15, 3)])
def test_refuses_positions_of_the_wrong_shape(shape):
    with pytest.raises(InvalidInput, match=r"x; got shape .*; expected \[\.\.\., 16, 3\]"):
        make_sheet().state(torch.zeros(shape))


def test_refuses_a_step_that_is_too_large_and_names_the_one_that_works():
    cloth = make_sheet()
    limit = cloth.stable_step()
    with pytest.raises(UnstableStep, match=f"at most {limit:.4g} s") as refusal:
        cloth(cloth.rest_state(), times=[0.0, 0.1], dt=1.01 * limit)
    named = float(refusal.value.args[0].split("at most ")[1].split(" s")[0])
    cloth(cloth.rest_state(), times=[0.0, 0.01], dt=0.999 * named)  # printed with four digits
    for dt in (0.0, -1e-4, math.nan):
        with pytest.raises(InvalidInput, match="dt"):
            cloth(cloth.rest_state(), times=[0.0, 0.1], dt=dt)


def test_refuses_a_simulation_without_end():
    """1e-12 s asked for 800 GB of times; a stiffness of 1e40 Pa for more substeps than an integer holds."""
    cloth = make_sheet()
    state = cloth.rest_state()
    with pytest.raises(InvalidInput, match=r"dt; got 1e-12 s, that is 1e\+11 substeps; expected at most 1e\+07"):
        cloth(state, times=[0.0, 0.1], dt=1e-12)
    for stiffness, said in ((1e40, "stable substep"), (1e300, "stiffness; got")):
        cloth.material.youngs_modulus.set(stiffness)
        for run in (lambda: cloth(state, times=[0.0, 0.1]), lambda: cloth.settle(state)):
            with pytest.raises(UnstableStep, match=said):
                run()


def test_a_stiffness_changed_later_moves_the_limit():
    """A fit cannot cross it silently."""
    cloth = make_sheet()
    before = cloth.stable_step()
    cloth.material.youngs_modulus.set(4e5)
    assert cloth.stable_step() == pytest.approx(before / 2)
    with pytest.raises(UnstableStep):
        cloth(cloth.rest_state(), times=[0.0, 0.1], dt=before)


@pytest.mark.parametrize(
    ("boundary", "message"),
    [
        (lambda: tc.boundaries.Grasp(), "exactly one"),
        (lambda: tc.boundaries.Grasp([0], uv=[[0.0, 0.0]]), "exactly one"),
        (lambda: tc.boundaries.Grasp([16]), r"got \[16\]; expected indices in 0\.\.15"),
        (lambda: tc.boundaries.Grasp([]), "Grasp vertices"),
        (lambda: tc.boundaries.Grasp(torch.arange(16) > 11), "Grasp vertices; got bool of shape .*flatnonzero"),
        (lambda: tc.boundaries.Grasp([True, False]), "Grasp vertices; got bool"),
        (lambda: tc.boundaries.Grasp([0.7, 1.2]), "Grasp vertices; got float64"),
        (lambda: tc.boundaries.Grasp([[0, 1]]), r"Grasp vertices; got int64 of shape \(1, 2\)"),
        (lambda: tc.boundaries.Grasp("ab"), "Grasp vertices"),
        (lambda: tc.boundaries.Grasp(uv=[[5.0, 5.0]]), "no vertex within"),
        (lambda: tc.boundaries.Grasp([0]).with_vertices(torch.tensor([3, -1])), r"Grasp vertices; got \[-1, 3\]"),
        (lambda: tc.boundaries.Grasp.corner("middle"), "lower-left"),
        (lambda: tc.boundaries.Plane(normal=(0.0, 0.0, 0.0)), "not all zero"),
        (lambda: tc.boundaries.Plane(friction=-0.1), "friction"),
    ],
)
def test_refuses_boundaries(boundary, message):
    with pytest.raises(InvalidInput, match=message):
        make_sheet(boundaries={"part": boundary()})


@pytest.mark.parametrize(
    ("part", "message"),
    [
        (lambda: tc.effects.AirDrag(-1.0), "air drag"),
        (lambda: tc.effects.AirDrag(density=0.0), "air density"),
        (lambda: tc.effects.Gravity((0.0, 9.81)), "three finite numbers"),
        (lambda: tc.effects.Gravity((0.0, math.nan, 0.0)), "three finite numbers"),
        (lambda: tc.effects.MassDamping(-1.0), "mass damping"),
        (lambda: tc.effects.Bending(-1.0), "bending"),
        (lambda: tc.Contact(spacing=0.0).resolve(tc.meshes.rectangle(1, 1)), "contact spacing"),
        (
            lambda: tc.Contact(spacing=1e-7).resolve(tc.meshes.rectangle(1, 1)),
            "contact spacing; got 1e-07 m, for which",
        ),
        (lambda: tc.Contact(spacing=1e-300).resolve(tc.meshes.rectangle(1, 1)), "contact spacing; got 1e-300 m"),
        (
            lambda: tc.Contact(spacing=5.0).build_grid(tc.meshes.rectangle(1, 1)),
            "contact spacing; got 5 m; expected at most",
        ),
        (
            lambda: tc.Contact(subdivisions=10**9).resolve(tc.meshes.rectangle(1, 1)),
            "contact subdivisions; got 1000000000",
        ),
        (lambda: tc.Contact(spacing=0.01, subdivisions=1).resolve(tc.meshes.rectangle(1, 1)), "contact subdivisions"),
    ],
)
def test_refuses_effects_and_contact(part, message):
    with pytest.raises(InvalidInput, match=message):
        part()


def test_divergence_names_the_vertex_and_the_time():
    """A velocity whose square overflows: the triangles around it lose their normals in the second substep."""
    cloth = make_sheet()
    state = cloth.rest_state()
    v = state.v.clone()
    v[6, 2] = 1e200
    dt = 0.5 * cloth.stable_step()
    around = sorted({int(k) for face in cloth.mesh.faces if 6 in face for k in face})
    with pytest.raises(SimulationDiverged, match=rf"t = {2 * dt:.6g} s; got vertex {around[0]} .* substep 2 of 40"):
        cloth(state._replace(v=v), times=[0.0, 40 * dt], dt=dt)


@pytest.mark.parametrize("engine", ["auto", "reference"])
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s: s.x, "state; got Tensor; expected a ClothState; make states with"),
        (lambda s: s._replace(v=s.v.numpy()), r"state\.v; got ndarray; expected a tensor"),
        (lambda s: s._replace(v=s.v.long()), r"state\.v; got int64"),
        (
            lambda s: s.map(lambda t: t.float()),
            r"state\.x; got float32 on cpu; expected float64 on cpu",
        ),
        (
            lambda s: s._replace(x=s.x.expand(2, -1, -1), v=s.v.expand(3, -1, -1)),
            r"batch dimensions; .*\(2,\).*\(3,\)",
        ),
        (lambda s: s.map(lambda t: t.expand(0, -1, -1)), r"batch dimensions; got .*\(0,\).*at least one scene"),
    ],
)
def test_refuses_states(engine, change, message):
    cloth = make_sheet()
    cloth.engine = engine
    with pytest.raises(InvalidInput, match=message):
        cloth(change(cloth.rest_state()), times=(0.0, 1e-3))


def test_refuses_a_batch_of_states_beside_another_of_fabrics():
    cloth = tc.Cloth(tc.meshes.rectangle(0.2, 0.2, resolution=(3, 3)), tc.materials.AEP(1e5, 0.3), torch.ones(2, 1))
    with pytest.raises(InvalidInput, match=r"batch dimensions; got .*\(3,\).*parameters \[\(2,\)\]"):
        cloth(cloth.state(cloth.rest_state().x.expand(3, -1, -1)), times=(0.0, 1e-3))


def test_velocities_alone_may_be_batched():
    cloth = make_sheet()
    state = cloth.rest_state()
    v = torch.stack([state.v, state.v + 0.1])
    both = cloth(state._replace(v=v), times=(0.0, 0.01)).x
    for k in range(2):
        assert torch.equal(both[k], cloth(state._replace(v=v[k]), times=(0.0, 0.01)).x)


@pytest.mark.parametrize("engine", ["reference", "fused"])
def test_the_friction_of_a_table_alone_may_be_batched(engine):
    """Sliding down it from one state."""
    table = lambda mu: {"table": tc.boundaries.Plane(friction=mu)}  # noqa: E731
    effects = {"gravity": tc.effects.Gravity((3.0, 0.0, -9.0))}
    coefficients, result = torch.tensor([[0.1], [0.5]]), []
    for mu in (coefficients, *coefficients.flatten().tolist()):
        cloth = make_sheet(effects=effects, boundaries=table(mu))
        cloth.engine = engine
        result.append(cloth(cloth.rest_state(), times=(0.0, 0.05)).x)
    assert float((result[1] - result[2]).detach().norm()) > 1e-3
    torch.testing.assert_close(result[0], torch.stack(result[1:]), rtol=0, atol=1e-6)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_is_refused(dtype):
    for contact in (None, tc.Contact()):
        cloth = make_sheet(contact=contact).to(dtype)
        with pytest.raises(InvalidInput, match=r"precision of the cloth; got .*float16; expected float32 or float64"):
            cloth(cloth.rest_state(), times=(0.0, 1e-3))


def test_inputs_in_half_precision_are_refused():
    cloth, half = make_sheet(), torch.bfloat16
    x = cloth.rest_state().x
    times = torch.tensor([0.0, 1.0])
    pose, closed = torch.eye(4).repeat(2, 1, 1), torch.ones(2, dtype=torch.bool)
    raw = {"areal_density.raw": cloth.areal_density.raw.detach().to(half)}
    for name, call in {
        "x": lambda: cloth.state(x.to(half)),
        "v": lambda: cloth.state(x, x.to(half)),
        "times": lambda: cloth(cloth.rest_state(), times=times.to(half)),
        "areal_density.raw": lambda: torch.func.functional_call(cloth, raw, (cloth.rest_state(),)),
        "areal_density": lambda: tc.Cloth(cloth.mesh, cloth.material, torch.tensor(0.2, dtype=half)),
        r"motion\['hand'\].t": lambda: check_trajectory(tc.Trajectory(times.to(half), pose, closed), "hand"),
        r"motion\['hand'\].pose": lambda: check_trajectory(tc.Trajectory(times, pose.to(half), closed), "hand"),
    }.items():
        with pytest.raises(InvalidInput, match=f"precision of {name}; got bfloat16; expected float32 or float64"):
            call()


@pytest.mark.parametrize("duration", [0.0, -1.0, math.nan])
def test_refuses_to_settle_for_no_time(duration):
    cloth = make_sheet()
    with pytest.raises(InvalidInput, match=r"duration of settling; got .* s; expected a time > 0"):
        cloth.settle(cloth.rest_state(), duration=duration)


def test_a_state_with_nan_is_refused():
    cloth = make_sheet()
    state = cloth.rest_state()
    x = state.x.clone()
    x[3, 0] = math.nan
    with pytest.raises(InvalidInput, match="finite"):
        cloth(state._replace(x=x), times=[0.0, 0.01])
    with pytest.raises(InvalidInput, match="finite positions"):
        cloth.state(x)


def test_a_runaway_extent_is_refused():
    cloth = make_sheet(contact=tc.Contact())
    with pytest.raises(SimulationDiverged, match="extent"):
        cloth(cloth.state(5 * cloth.rest_state().x), times=[0.0, 0.01])


# -- steps ------------------------------------------------------------------------------------------------------------


def shaken(cloth, seed=0):
    torch.manual_seed(seed)
    state = cloth.rest_state()
    return cloth.state(state.x + 1e-7 * torch.randn_like(state.x))


@pytest.mark.parametrize("contact", [None, tc.Contact()], ids=["membrane", "contact"])
def test_the_stable_step_is_stable(contact):
    cloth = make_sheet(contact=contact)
    state = shaken(cloth)
    with torch.no_grad():
        out = cloth(state, times=[0.0, 600 * cloth.stable_step()])
    # noise in the plane only oscillates; out of the plane it drifts freely with the velocities that it got
    assert float((out.x[-1] - cloth.rest_state().x)[:, :2].abs().max()) < 1e-5


def test_beyond_the_limit_a_membrane_blows_up():
    """The bound is no more than 1.6 times too careful on this mesh: 2 / omega x 1.6 diverges."""
    from torchcloth.dynamics.stability import STABLE_STEP_OVER_LINEAR_LIMIT

    cloth = make_sheet()
    state, dt = shaken(cloth), 1.6 * cloth.stable_step() / STABLE_STEP_OVER_LINEAR_LIMIT
    with torch.no_grad():
        grown, _ = substep.rollout(cloth.build_model(), state, dt, {}, 100)
    moved = (grown.x - cloth.rest_state().x).abs().max()
    assert not bool(moved < 1e-3)  # ten thousand times the noise, or NaN


def test_frames_are_met_and_an_interval_can_be_continued():
    """Substeps coincide, so that running on from a state is the run itself, up to rounding of the times."""
    effects, boundaries = {"gravity": tc.effects.Gravity()}, {"hand": tc.boundaries.Grasp([0, 1])}
    cloth = make_sheet(effects=effects, boundaries=boundaries, contact=tc.Contact())
    motion = {"hand": turning(1.0, 1.0, 5)}
    half = 24 * cloth.stable_step()
    dt = cloth.stable_step()
    with torch.no_grad():
        whole = cloth(cloth.rest_state(), motion, [0.0, 2 * half], dt=dt)
        first = cloth(cloth.rest_state(), motion, [0.0, half], dt=dt)
        second = cloth(first.state, motion, [half, 2 * half], dt=dt)
        framed = cloth(cloth.rest_state(), motion, [0.0, half, 2 * half], dt=dt)
    assert framed.t.tolist() == [0.0, half, 2 * half]
    for out in (second, framed):
        torch.testing.assert_close(out.state.x, whole.state.x, rtol=0, atol=1e-12)
        torch.testing.assert_close(out.state.v, whole.state.v, rtol=0, atol=1e-9)
        torch.testing.assert_close(out.state.d3, whole.state.d3, rtol=0, atol=1e-9)
    mean = (framed.wrench["hand"][1] + framed.wrench["hand"][2]) / 2
    torch.testing.assert_close(mean, whole.wrench["hand"][1], rtol=1e-9, atol=1e-12)


# -- grasps -----------------------------------------------------------------------------------------------------------


def test_held_vertices_follow_a_turning_pose_exactly():
    cloth = make_sheet(boundaries={"hand": tc.boundaries.Grasp([0, 1, 5])}, effects={"gravity": tc.effects.Gravity()})
    end = 500 * cloth.stable_step()
    motion = turning(end, 2.5, 9)
    with torch.no_grad():
        out = cloth(cloth.rest_state(), {"hand": motion}, times=motion.t)
    start = cloth.rest_state().x[[0, 1, 5]]
    for k in range(9):
        expected = start @ motion.pose[k, :3, :3].mT + motion.pose[k, :3, 3]  # the first pose is the identity
        torch.testing.assert_close(out.x[k][[0, 1, 5]], expected, rtol=0, atol=1e-12)


def test_the_schedule_lets_go():
    cloth = make_sheet(boundaries={"hand": tc.boundaries.Grasp(range(16))}, effects={"gravity": tc.effects.Gravity()})
    motion = trajectory(0.2, 3)._replace(closed=torch.tensor([True, False, False]))
    with torch.no_grad():
        out = cloth(cloth.rest_state(), {"hand": motion}, times=[0.0, 0.1, 0.2])
    assert torch.equal(out.x[1], out.x[0])
    steps = math.ceil(0.1 / cloth.stable_step() - 1e-9)
    fallen = -9.81 * 0.1**2 / 2 * (1 + 1 / steps)  # symplectic Euler's free fall
    torch.testing.assert_close(out.x[2, :, 2], torch.full((16,), fallen), rtol=1e-9, atol=0)
    assert float(out.wrench["hand"][2].abs().max()) == 0.0


def test_wrench_of_a_sheet_that_is_held_everywhere_is_its_weight():
    cloth = make_sheet(boundaries={"hand": tc.boundaries.Grasp(range(16))}, effects={"gravity": tc.effects.Gravity()})
    out = cloth(cloth.rest_state(), {"hand": trajectory()}, times=[0.0, 0.01])
    weight = 0.2 * 0.04 * 9.81
    expected = torch.tensor([0.0, 0.0, -weight, -weight * 0.1, weight * 0.1, 0.0])  # moment: r x (0, 0, -W)
    torch.testing.assert_close(out.wrench["hand"][1].detach(), expected, rtol=1e-10, atol=1e-12)
    assert float(out.wrench["hand"][0].detach().abs().max()) == 0.0


def test_wrench_of_a_hanging_sheet_at_rest_is_its_weight():
    effects = {"gravity": tc.effects.Gravity((0.0, -9.81, 0.0)), "damping": tc.effects.MassDamping(60.0)}
    cloth = make_sheet(boundaries={"hand": tc.boundaries.Grasp([3, 7, 11, 15])}, effects=effects)
    with torch.no_grad():
        out = cloth(cloth.rest_state(), {"hand": trajectory()}, times=[0.0, 0.7, 0.8])
    weight = torch.tensor([0.0, -0.2 * 0.04 * 9.81, 0.0])
    torch.testing.assert_close(out.wrench["hand"][2, :3], weight, rtol=0, atol=1e-4 * 0.2 * 0.04 * 9.81)


def test_settling_brings_noise_to_rest():
    effects = {"gravity": tc.effects.Gravity((0.0, -9.81, 0.0))}
    cloth = make_sheet(boundaries={"hand": tc.boundaries.Grasp([3, 7, 11, 15])}, effects=effects)
    torch.manual_seed(0)
    noisy = cloth.state(cloth.rest_state().x + 1e-3 * torch.randn(16, 3))
    motion = {"hand": turning(1.0, 1.0, 3)}
    with torch.no_grad():
        calm = cloth.settle(noisy, motion, duration=0.5, rate=60.0)
        speeds = [cloth(state, {"hand": trajectory()}, times=[0.0, 0.02]).v.abs().max() for state in (noisy, calm)]
    assert float(calm.v.abs().max()) == 0.0
    torch.testing.assert_close(calm.x[[3, 7]], noisy.x[[3, 7]], rtol=0, atol=1e-12)  # held where the hand is at 0 s
    assert float(speeds[1]) < 0.05 * float(speeds[0])  # released, the noise would ring


def test_an_effect_of_any_name_acts_while_the_cloth_settles():
    sags = []
    for name in ("gravity", "settling"):
        hold = {"hand": tc.boundaries.Grasp([3, 7, 11, 15])}
        cloth = make_sheet(boundaries=hold, effects={name: tc.effects.Gravity((0.0, 0.0, -9.81))})
        with torch.no_grad():
            sags.append(cloth.settle(cloth.rest_state(), {"hand": trajectory()}, duration=0.05).x)
    assert torch.equal(*sags)
    assert float(sags[0][:, 2].min()) < -1e-4


@pytest.mark.parametrize("start", [0.0, 30.0])
def test_in_float32_still_bodies_stand_still_and_moving_ones_are_smooth(start):
    """What rounding does to a substep's motion must not add up, nor grow with time."""
    a, b = torch.tensor(0.3).double(), torch.tensor(0.7).double()
    turn = torch.eye(4).double()
    turn[:3, :3] = torch.linalg.matrix_exp(torch.tensor([[0, -a, b], [a, 0, -0.2], [-b, 0.2, 0]]).double())
    turn[:3, 3] = torch.tensor([0.4, -0.3, 0.5])
    t = torch.linspace(0, 32, 321).double()
    pose = turn.repeat(321, 1, 1)
    still = tc.Trajectory(t, pose.float(), torch.ones(321, dtype=torch.bool))
    pose = pose.clone()
    pose[:, 0, 3] += torch.cos(0.5 * t)
    moving = still._replace(pose=pose.float())
    times = start + torch.arange(5001).double() * 1.2e-4
    point = torch.tensor([0.1, 0.1, 0.0, 1.0])
    total = torch.eye(4).double()
    for step in sample_trajectory(still, times).increment.double():
        total = step @ total
    assert float((total @ point.double() - point.double()).norm()) < 1e-9
    speed = (sample_trajectory(moving, times).increment.double() @ point.double() - point.double())[:, 0] / 1.2e-4
    assert float((speed[1:] - speed[:-1]).abs().max()) < 3e-3  # m/s


def test_the_motion_is_an_input_and_nothing_is_remembered():
    cloth = make_sheet(boundaries={"hand": tc.boundaries.Grasp([0])}, contact=tc.Contact())

    def still():
        with torch.no_grad():
            return cloth(cloth.rest_state(), {"hand": trajectory()}, times=[0.0, 0.01]).x

    first = still()
    with torch.no_grad():
        cloth(cloth.rest_state(), {"hand": turning(1.0, 1.0, 4)}, times=[0.0, 0.01])
    assert torch.equal(still(), first)
    assert "contact: none" in repr(make_sheet())


@pytest.mark.parametrize("rate", [math.nan, math.inf, -1.0])
def test_settling_needs_a_finite_rate(gripped, rate):
    with pytest.raises(InvalidInput, match="rate"):
        gripped.settle(gripped.rest_state(), {"hand": trajectory()}, rate=rate)


def test_trajectories_cover_the_times_also_far_from_zero(gripped):
    begin = 1.7e9
    motion = {"hand": tc.Trajectory(begin + torch.tensor([0.0, 1.0]), torch.eye(4).repeat(2, 1, 1), torch.ones(2) > 0)}
    gripped(gripped.rest_state(), motion, (begin + 0.5, begin + 0.51))
    with pytest.raises(InvalidInput, match="to cover"):
        gripped(gripped.rest_state(), motion, (begin + 999.0, begin + 999.1))
    with pytest.raises(InvalidInput, match="to cover"):
        gripped.settle(gripped.rest_state(), motion, start=begin + 50.0, duration=0.1)


@pytest.mark.parametrize("engine", ["reference", "fused"])
def test_a_cloth_may_be_made_and_run_in_inference_mode(engine):
    def run():
        cloth = make_sheet(contact=tc.Contact(), boundaries={"table": tc.boundaries.Plane()})
        cloth.engine = engine
        return cloth(cloth.rest_state(), {}, times=[0.0, 0.01])

    with torch.inference_mode():
        inferred = run()
    assert torch.equal(inferred.x, run().x)


def test_cloth_that_has_far_to_go_is_not_settled_and_told():
    mesh = tc.meshes.rectangle(0.4, 0.4, resolution=(6, 6))
    pins = {"pins": tc.boundaries.Grasp([0, 30])}
    cloth = tc.Cloth(mesh, tc.materials.AEP(1e5), 0.2, {"g": tc.effects.Gravity()}, pins, contact=None)
    still = {"pins": trajectory()}
    with torch.no_grad(), pytest.warns(UserWarning, match=r"settle: after 0.3 s .* still moves at 0\.\d+ m/s"):
        cloth.settle(cloth.rest_state(), still)
    along = tc.Directions(state=cloth.rest_state().map(lambda field: field[None]))
    with pytest.warns(UserWarning, match=r"settle: after 0.3 s .* still moves") as reported:
        cloth.sensitivities(cloth.rest_state(), still, (0.0, 1e-3), along=along, settle=0.3)
    assert {warning.filename for warning in reported} == {__file__}
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("error")
        cloth.settle(cloth.rest_state(), still, duration=4.0, rate=5.0)


@pytest.mark.parametrize("engine", ["fused", "reference"])
def test_parts_that_were_put_in_a_places_are_looked_at_again(engine):
    """Of a field of another mesh the engine would read, and write, other memory."""
    cloth = make_sheet(contact=tc.Contact())
    cloth.engine = engine
    cloth.material.cone = tc.PhysicalParameter(torch.tensor([0.3, 0.6]), "-", "nonnegative")
    with pytest.raises(InvalidInput, match=r"material\.cone; got shape \(2,\); expected a scalar, \[18\]"):
        cloth(cloth.rest_state(), times=[0.0, 0.001])


def test_other_units_are_doubted():
    """They may be meant, so nothing is refused."""
    mesh, law = tc.meshes.rectangle(0.2, 0.2, resolution=(3, 3)), tc.materials.AEP(1e4)
    with pytest.warns(UserWarning, match=r"areal_density is 150 kg/m\^2: is it in g/m\^2"):
        tc.Cloth(mesh, law, 150.0, contact=None)
    with pytest.warns(UserWarning, match="the mesh spans 500 m: is it in millimetres"):
        tc.Cloth(tc.meshes.rectangle(500.0, 300.0, resolution=(3, 3)), law, 0.15, contact=None)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        tc.Cloth(mesh, law, 2.0, contact=None)
