"""Motion of MuJoCo's sheet: gravity, air, grippers, pendulum, time step."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("mujoco", minversion="4.0")

from scipy.spatial.transform import Rotation

from torchcloth.errors import SimulationDiverged
from torchcloth.training.validation.independent.flex_sheet import SheetSpec, max_stable_step, sheet_mesh
from torchcloth.training.validation.independent.mujoco_cloth import Grip, MujocoCloth, settle

SMALL_SHEET = SheetSpec(0.2, 0.2, nodes=(7, 7))


def vertical_positions(spec):
    uv, _ = sheet_mesh(spec)
    return np.column_stack([np.zeros(len(uv)), uv])


def flat_positions(spec):
    uv, _ = sheet_mesh(spec)
    return np.column_stack([uv, np.zeros(len(uv))])


def test_free_fall():
    cloth = MujocoCloth(SMALL_SHEET, dt=1e-4)
    result = cloth.run(flat_positions(SMALL_SHEET), np.array([0.0, 0.3]), {})
    # semi-implicit Euler falls g t dt / 2 further than g t^2 / 2
    np.testing.assert_allclose(
        result.x[-1] - flat_positions(SMALL_SHEET),
        np.broadcast_to([0, 0, -9.81 * 0.3 * (0.3 + 1e-4) / 2], (49, 3)),
        atol=1e-10,
    )


def test_a_flat_sheet_falls_through_air_as_the_closed_form():
    spec = replace(SMALL_SHEET, drag_normal=1.2)
    result = MujocoCloth(spec, dt=1e-4).run(flat_positions(spec), np.array([0.0, 0.5]), {})
    terminal = np.sqrt(2 * 0.20 * 9.81 / (1.204 * 1.2))
    mean = result.v[-1][:, 2] @ MujocoCloth(spec).mass / (0.20 * 0.04)
    # a corner's share of the air is its share of the mass: the sheet stays flat, the step's error is 1e-4
    assert -mean == pytest.approx(terminal * np.tanh(9.81 * 0.5 / terminal), rel=1e-3)


def test_sheet_that_moves_in_its_plane_feels_no_normal_drag():
    spec = replace(SMALL_SHEET, drag_normal=1.2, gravity=0.0)
    v0 = np.tile([1.0, 0.5, 0.0], (49, 1))
    result = MujocoCloth(spec, dt=1e-4).run(flat_positions(spec), np.array([0.0, 0.1]), {}, v0=v0)
    np.testing.assert_allclose(result.v[-1], v0, atol=1e-12)


def moving_grips(spec, seconds=0.3):
    """Two corners that turn, part and swing."""
    t = np.linspace(0, seconds, 31)
    uv, _ = sheet_mesh(spec)
    grips = {}
    for name, u, sign in (("left", 0.0, 1), ("right", spec.width, -1)):
        pose = np.tile(np.eye(4), (len(t), 1, 1))
        pose[:, :3, :3] = Rotation.from_euler("zy", np.stack([sign * 2 * t, t], 1)).as_matrix()
        pose[:, :3, 3] = np.stack([0.3 * t**2 * 9, u - sign * 0.01 * t / seconds, spec.height + 0 * t], 1)
        grasped = np.flatnonzero(np.linalg.norm(uv - [u, spec.height], axis=1) < 0.04)
        grips[name] = Grip(grasped, t, pose)
    return t, grips


def test_grasped_vertices_follow_their_gripper():
    t, grips = moving_grips(SMALL_SHEET)
    x0 = vertical_positions(SMALL_SHEET)
    result = MujocoCloth(SMALL_SHEET, dt=1e-4).run(x0, t, grips)
    assert result.grasp_error < 1e-9
    for grip in grips.values():
        assert len(grip.vertices) == 3
        pose = grip.pose
        local = (x0[grip.vertices] - pose[0, :3, 3]) @ pose[0, :3, :3]
        expected = np.einsum("kab,nb->kna", pose[:, :3, :3], local) + pose[:, None, :3, 3]
        np.testing.assert_allclose(result.x[:, grip.vertices], expected, atol=1e-9)


def test_the_grippers_forces_balance_momentum_and_its_moment():
    t, grips = moving_grips(SMALL_SHEET)
    cloth = MujocoCloth(SMALL_SHEET, dt=1e-4)
    result = cloth.run(vertical_positions(SMALL_SHEET), t, grips)
    momentum = np.einsum("v,tvc->tc", cloth.mass, result.v)
    weight = np.array([0, 0, -9.81 * cloth.mass.sum()])
    force = result.force["left"] + result.force["right"]
    # exact in the discrete sense: what the cloth gained is what it weighs less what it pulled
    np.testing.assert_allclose(np.diff(momentum, axis=0), 0.01 * (weight - force[1:]), atol=1e-9)
    spin = np.einsum("v,tvc->tc", cloth.mass, np.cross(result.x, result.v))
    moment = sum(
        result.torque[n] + np.cross(0.5 * (g.pose[:, :3, 3] + np.roll(g.pose[:, :3, 3], 1, 0)), result.force[n])
        for n, g in grips.items()
    )
    gravity = np.cross(np.einsum("v,tvc->tc", cloth.mass, result.x), [0, 0, -9.81])
    expected = 0.01 * (0.5 * (gravity[1:] + gravity[:-1]) - moment[1:])
    # means over a frame instead of integrals
    np.testing.assert_allclose(np.diff(spin, axis=0), expected, atol=0.03 * np.abs(expected).max())


def test_a_hanging_strip_swings_at_the_chain_s_frequency():
    length = 0.30
    spec = SheetSpec(0.04, length, nodes=(3, 16))
    t = np.array([0.0, 1.0])
    x0 = vertical_positions(spec)
    grasped = np.flatnonzero(x0[:, 2] > length - 1e-9)
    grip = {"top": Grip(grasped, t, np.tile(np.eye(4), (2, 1, 1)))}
    rest = settle(spec, x0, grip, 0.5, damping_rate=30.0)
    depth = length - rest[:, 2]
    start = rest + np.outer(0.004 * depth / length, [1, 0, 0])
    times = np.arange(0, 3.0, 0.01)
    result = MujocoCloth(spec).run(start, times, grip)
    tip = result.x[:, 0, 0]
    # the first mode from a fit of its frequency to the mean displacement, which higher modes hardly move
    mean = result.x[:, :, 0].mean(1)
    trial = np.linspace(0.9, 1.3, 401)
    misfit = []
    for f in trial:
        basis = np.stack([np.cos(2 * np.pi * f * times), np.sin(2 * np.pi * f * times)], 1)
        misfit.append(np.linalg.norm(mean - basis @ np.linalg.lstsq(basis, mean, rcond=None)[0]))
    expected = 2.404826 / (4 * np.pi) * np.sqrt(9.81 / (length + 0.2 * 9.81 * length**2 / (2 * 113)))
    assert trial[np.argmin(misfit)] == pytest.approx(expected, rel=0.01)
    assert np.abs(tip[200:]).max() > 0.8 * np.abs(tip[:100]).max()  # no numerical damping to speak of


def test_a_run_is_reproducible_bit_by_bit():
    spec = replace(SMALL_SHEET, drag_normal=1.2, bending_stiffness=1e-5, damping_time=1e-3)
    t, grips = moving_grips(spec)
    first, second = (MujocoCloth(spec, 1e-4).run(vertical_positions(spec), t, grips) for _ in range(2))
    np.testing.assert_array_equal(first.x, second.x)
    np.testing.assert_array_equal(first.force["left"], second.force["left"])


def test_the_step_bound_is_safe_and_beyond_it_a_blow_up_is_reported():
    spec = replace(SMALL_SHEET, gravity=0.0, damping_time=1e-3)
    start = vertical_positions(spec) + 1e-4 * np.random.default_rng(0).standard_normal((49, 3))
    t = np.array([0.0, 0.2])
    safe = MujocoCloth(spec).run(start, t, {})
    assert np.abs(safe.v[-1]).max() < 0.5
    with pytest.raises(SimulationDiverged, match="dt <"):
        MujocoCloth(spec, dt=20 * max_stable_step(spec)).run(start, np.linspace(0, 1, 3), {})


def test_halving_the_step_changes_microns():
    spec = replace(SMALL_SHEET, drag_normal=1.2, bending_stiffness=1e-5, damping_time=1e-3)
    t, grips = moving_grips(spec)
    coarse, fine = (MujocoCloth(spec, dt).run(vertical_positions(spec), t, grips).x for dt in (1e-4, 5e-5))
    assert np.sqrt(((coarse - fine) ** 2).sum(-1).mean()) < 5e-5
