"""Reverse-mode gradients through whole rollouts against finite-difference sweeps, relative 1e-7.

The mark is the project's; sweeps reach 1e-8 to 1e-10 here, where truncation (h^2) meets rounding (1e-16 / h).
"""

import pytest
import torch
from helpers.gradient_scenes import STEP_SIZES, active_parameters, simulate, step_scales

import torchcloth as tc
from torchcloth.testing import check_gradients

MARK = 1e-7


def states(out):
    return torch.cat([out.x[..., 1:, :, :], 0.01 * out.v[..., 1:, :, :]], dim=-1)


def sweep_parameters(scene, names, mark=MARK, read=states):
    values = active_parameters(scene.cloth)
    assert set(names) <= set(values), sorted(values)

    def run(**moved):
        named = {**values, **{name: moved[name] for name in names}}
        return read(simulate(scene.cloth, named, scene.state, scene.motion, scene.times, dt=scene.dt))

    inputs = {name: values[name] for name in names}
    return check_gradients(run, inputs, mark, STEP_SIZES, sizes=step_scales(inputs))


SWING = [
    "material.youngs_modulus.raw",
    "material.poisson_ratio.raw",
    "areal_density.raw",
    "effects.gravity.acceleration",
    "effects.air.normal.raw",
    "effects.bending.stiffness.raw",
    "effects.damping.rate.raw",
]


@pytest.mark.parametrize("name", SWING)
def test_parameters_of_a_swing(swing, name, record_property):
    record_property("error", sweep_parameters(swing, [name]))


def test_reaction_wrench_of_a_swing(swing):
    sweep_parameters(swing, ["material.youngs_modulus.raw", "areal_density.raw", "effects.air.normal.raw"],
                     read=lambda out: out.wrench["hand"][1:])  # fmt: skip


def test_initial_state_and_gripper_pose(swing):
    base = swing.motion["hand"]
    x, v, *_ = swing.state
    inputs = {"dx": torch.zeros_like(x), "dv": torch.zeros_like(v), "dpose": torch.zeros_like(base.pose)}

    def run(dx, dv, dpose):
        motion = {"hand": base._replace(pose=base.pose + 0.01 * dpose)}
        state = swing.state._replace(x=x + 0.001 * dx, v=v + 0.1 * dv)
        out = swing.cloth(state, motion, swing.times, dt=swing.dt)
        return torch.cat([states(out).flatten(), out.wrench["hand"][1:].flatten()])

    check_gradients(run, inputs, MARK, STEP_SIZES)


PRESSED = ["youngs_modulus", "poisson_ratio", "contact_stiffness", "shear_stiffness", "cone"]


def directors(out):
    return torch.cat([states(out).flatten(), 0.1 * out.state.d3.flatten()])


@pytest.mark.parametrize("name", [*(f"material.{p}.raw" for p in PRESSED), "areal_density.raw"])
def test_parameters_of_a_pressed_sheet(pressed, name, record_property):
    record_property("error", sweep_parameters(pressed, [name], read=directors))


def test_a_pressed_sheet_slides_and_sticks(pressed):
    """What the sweeps above rely on: both branches of the return map are taken, and none changes."""
    slides = []
    for end in (1e-9, pressed.times[-1]):
        d3 = pressed.cloth(pressed.state, times=[0.0, end], dt=pressed.dt).state
        n = pressed.cloth.state(d3.x).d3
        height = (n * d3.d3).sum(-1)
        shear = (d3.d3 - height[:, None] * n).norm(dim=-1)
        ratio = 5e4 * shear / (0.3 * 1e5 * (1 - pressed.cloth.contact.free_compression - height) ** 2)
        slides.append(ratio > 1 - 1e-9)
        assert float(height.detach().max()) < 0.89
    assert 0 < int(slides[0].sum()) < len(slides[0])


def test_initial_state_and_directors_of_a_pressed_sheet(pressed):
    x, v, d3, _ = pressed.state
    inputs = {"dx": torch.zeros_like(x), "dv": torch.zeros_like(v), "dd": torch.zeros_like(d3)}

    def run(dx, dv, dd):
        state = pressed.state._replace(x=x + 0.001 * dx, v=v + 0.1 * dv, d3=d3 + 0.01 * dd)
        return directors(pressed.cloth(state, None, pressed.times, dt=pressed.dt))

    check_gradients(run, inputs, MARK, STEP_SIZES)


def test_friction_of_a_plane():
    """A sheet that slides and presses throughout: no vertex sticks or lifts within reach of the sweep."""
    mesh = tc.meshes.rectangle(0.2, 0.2, resolution=(4, 4))
    cloth = tc.Cloth(
        mesh, tc.materials.AEP(1e5, 0.3), 0.2, {"gravity": tc.effects.Gravity()},
        {"table": tc.boundaries.Plane(friction=0.3)}, contact=None,
    )  # fmt: skip
    dt = 0.6 * cloth.stable_step()
    torch.manual_seed(0)
    slip = torch.cat([torch.tensor([1.0, 0.3]) + 0.1 * torch.randn(16, 2), torch.zeros(16, 1)], dim=-1)
    values = active_parameters(cloth)
    names = ["boundaries.table.friction.raw", "effects.gravity.acceleration", "material.youngs_modulus.raw"]

    def run(**moved):
        dv = moved.pop("dv")
        state = cloth.state(cloth.rest_state().x, slip)._replace(v=slip + 0.01 * dv * torch.tensor([1.0, 1.0, 0.0]))
        return states(simulate(cloth, {**values, **moved}, state, {}, [0.0, 40 * dt], dt=dt))

    inputs = {**{name: values[name] for name in names}, "dv": torch.zeros(16, 3)}
    check_gradients(run, inputs, MARK, STEP_SIZES, sizes=step_scales(inputs))


def test_fields_get_a_gradient_in_every_triangle(swing):
    mesh, triangles = swing.cloth.mesh, len(swing.cloth.mesh.faces)
    field = torch.linspace(0.9, 1.1, triangles)
    material = tc.materials.AEP(1e5 * field, 0.3 * field)
    air = {"air": tc.effects.AirDrag(1.2 * field), "gravity": tc.effects.Gravity()}
    cloth = tc.Cloth(mesh, material, 0.2 * field, air, {"hand": tc.boundaries.Grasp([0, 1])}, contact=None)
    swing.cloth, swing.state = cloth, cloth.state(swing.state.x, swing.state.v)
    names = ["material.youngs_modulus.raw", "material.poisson_ratio.raw", "areal_density.raw", "effects.air.normal.raw"]
    sweep_parameters(swing, names)
    out = cloth(swing.state, swing.motion, swing.times, dt=swing.dt)
    states(out).pow(2).sum().backward()
    for name in names:
        gradient = cloth.get_parameter(name).grad
        assert gradient.shape == (triangles,)
        assert bool((gradient != 0).all()), name


def test_joint_angles_material_and_effects_in_one_graph():
    """URDF -> joint waypoints -> gripper pose -> cloth -> loss; one backward reaches everything."""
    robots = pytest.importorskip("torchcloth.robots")
    pytest.importorskip("pytorch_kinematics")
    mesh = tc.meshes.rectangle(0.2, 0.2, resolution=(4, 4))
    effects = {"gravity": tc.effects.Gravity(), "air": tc.effects.AirDrag(1.2)}
    cloth = tc.Cloth(
        mesh, tc.materials.AEP(1e5, 0.3), 0.2, effects, {"hand": tc.boundaries.Grasp([0, 1])}, contact=None
    )
    dt = 0.6 * cloth.stable_step()
    end = 60 * dt
    arm = robots.load("rizon4", frame="tcp_closed")
    flange = arm(arm.home)[:3, 3]
    state = cloth.state(cloth.rest_state().x + flange, torch.tensor([0.0, 0.0, -1.0]).expand(16, 3))
    turn = torch.tensor([0.01, 0.02, -0.01, 0.02, 0.01, 0.02, 0.03])
    waypoints = torch.stack([arm.home, arm.home + 0.4 * turn, arm.home + turn])
    target = state.x + torch.tensor([0.05, 0.0, -0.05])
    values = active_parameters(cloth)
    names = ["material.youngs_modulus.raw", "effects.air.normal.raw", "effects.gravity.acceleration"]

    def loss(dq, **moved):
        t = torch.linspace(0.0, end, 3)
        motion = {"hand": arm.motion(waypoints + 0.01 * dq, t, period=0.004)}
        out = simulate(cloth, {**values, **moved}, state, motion, [0.0, end / 2, end], dt=dt)
        return ((out.x[-1] - target) ** 2).sum() + 1e-3 * (out.wrench["hand"][1:] ** 2).sum()

    inputs = {"dq": torch.zeros_like(waypoints), **{name: values[name] for name in names}}
    check_gradients(loss, inputs, MARK, STEP_SIZES, sizes=step_scales(inputs))

    q = torch.nn.Parameter(waypoints)
    cloth.effects["gravity"].acceleration.requires_grad_()
    out = cloth(state, {"hand": arm.motion(q, torch.linspace(0.0, end, 3), period=0.004)}, [0.0, end], dt=dt)
    ((out.x[-1] - target) ** 2).sum().backward()
    assert bool((q.grad[1:] != 0).all())
    assert all(float(cloth.get_parameter(name).grad.abs().max()) > 0 for name in names)
