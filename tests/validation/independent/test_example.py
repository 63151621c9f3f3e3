"""The episode that make_example.py makes, on a small scale, and the packaged one."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco", minversion="4.0")
pytest.importorskip("pytorch_kinematics")

import torch

from torchcloth import observe, recordings, robots
from torchcloth._utils.constants import STANDARD_GRAVITY_M_PER_S2
from torchcloth.errors import InvalidInput, MissingDependency
from torchcloth.training.validation.independent import make_example
from torchcloth.training.validation.independent.flex_sheet import SheetSpec, interpolate_bilinear, sheet_mesh
from torchcloth.training.validation.independent.kinect_camera import CameraPlacement, arm_mesh_function, observe_cloth
from torchcloth.training.validation.independent.swing_motion import Swing, measure_joint_usage, solve_joint_positions

PACKAGED_EPISODE = make_example.REPOSITORY / "torchcloth" / "examples" / "bimanual_swing"


@pytest.fixture(scope="module")
def open3d():
    try:
        observe.render_depth(observe.DepthCamera(1, 1, np.eye(3), np.eye(4)), [])
    except MissingDependency as error:
        pytest.skip(str(error))


def small_settings(**changes):
    sheet = make_example.make_knit(9).evenly_spaced
    return make_example.ExampleSettings(
        sheet=sheet, step=2e-4, settling=0.5, swing=Swing(duration=0.4), knots_per_frame=10, fit_nodes=5, **changes
    )


@pytest.fixture(scope="module")
def small(open3d):
    return make_example.make_example(small_settings())


def test_a_small_episode_is_written_read_and_the_same_twice(small, open3d, tmp_path):
    folders = []
    for name, (recording, _) in {"a": small, "b": make_example.make_example(small_settings())}.items():
        folders.append(recordings.write(recording, tmp_path / name))
    for file in sorted(path.relative_to(folders[0]) for path in folders[0].rglob("*") if path.is_file()):
        if file.suffix == ".npz":  # a zip holds the time of day
            first, second = (np.load(folder / file) for folder in folders)
            assert first.files == second.files
            for key in first.files:
                np.testing.assert_array_equal(first[key], second[key])
        else:
            assert (folders[0] / file).read_bytes() == (folders[1] / file).read_bytes()
    assert_consistent(recordings.read(folders[0], with_truth=True))


def test_another_seed_gives_other_noise(small):
    other, _ = make_example.make_example(small_settings(seed=1))
    assert not np.array_equal(small[0].points.xyz, other.points.xyz)


def test_the_packaged_episode_is_sound_and_small():
    recording = recordings.read(PACKAGED_EPISODE, with_truth=True)
    assert_consistent(recording)
    assert sum(file.stat().st_size for file in PACKAGED_EPISODE.rglob("*")) < 3e6
    assert recording.licence == "CC0-1.0"
    assert recording.provenance.startswith("synthetic: MuJoCo flex 4")


def assert_consistent(recording):
    """Assert that the streams agree with each other."""
    rig = robots.bimanual_rig(model="rizon4", frame="tcp_closed")
    first = recording.cloth.initial_vertices
    for name, motion in recording.joints.items():
        tool = rig[name](torch.as_tensor(motion.q)).detach().numpy()[:, :3, 3]
        corner = np.argmin(np.linalg.norm(recording.cloth.uv - recording.grasps[name].uv, axis=1))
        assert np.linalg.norm(tool[0] - first[corner]) < 1e-3
        truth = recording.truth.vertices.reshape(len(recording.truth.t), -1, 3)
        knots = np.searchsorted(motion.t, recording.truth.t - 1e-9)
        n = round(np.sqrt(truth.shape[1]))
        corner_path = truth[:, -n if name == "left" else -1]
        # the corner is at the tool all the time
        assert np.linalg.norm(corner_path - tool[knots], axis=1).max() < 1e-3
    measure_joint_usage(rig, motion.t, {name: motion.q for name, motion in recording.joints.items()})
    half_weight = 0.5 * recording.cloth.areal_density * 0.16 * STANDARD_GRAVITY_M_PER_S2
    for motion in recording.joints.values():
        still = motion.force[1:20].mean(0)
        assert still[2] == pytest.approx(-half_weight, abs=0.05)  # 0.05 N of noise in 19 readings, and a settled cloth
    for i in range(len(recording.points)):
        cloud, truth = recording.points.frame(i), recording.truth.vertices[i]
        nearest = np.sqrt(((cloud[:, None] - truth[None]) ** 2).sum(-1).min(1))
        assert nearest.max() < 0.05  # half a truth cell of the small episode, and noise


def test_measured_first_positions_are_the_truth_s_with_a_smooth_error():
    settings = make_example.ExampleSettings()
    uv, _ = sheet_mesh(settings.sheet)
    x = np.column_stack([0.02 * np.sin(8 * uv[:, 0]), uv])
    fit_uv, faces, first = make_example.fit_mesh(settings, x, np.random.default_rng(0))
    n = settings.fit_nodes
    assert len(fit_uv) == n * n
    assert faces.shape == (2 * (n - 1) ** 2, 3)
    error = first - interpolate_bilinear(settings.sheet, x, fit_uv)[0]
    assert np.sqrt((error**2).sum(1).mean()) == pytest.approx(1e-3, rel=0.05)
    corners = [(n - 1) * n, n * n - 1]
    np.testing.assert_allclose(error[corners], 0, atol=1e-12)
    edges = np.linalg.norm(np.diff(first.reshape(n, n, 3), axis=1), axis=-1)
    clean = np.linalg.norm(
        np.diff(interpolate_bilinear(settings.sheet, x, fit_uv)[0].reshape(n, n, 3), axis=1), axis=-1
    )
    assert np.abs(edges / clean - 1).max() < 0.02


def test_bilinear_is_exact_for_linear_fields_and_at_the_nodes():
    sheet = SheetSpec(0.4, 0.2, nodes=(5, 4))
    uv, _ = sheet_mesh(sheet)
    points = np.random.default_rng(0).uniform([0, 0], [0.4, 0.2], (30, 2))
    np.testing.assert_allclose(interpolate_bilinear(sheet, 2 * uv + 1, points)[0], 2 * points + 1, atol=1e-12)
    values = np.random.default_rng(1).standard_normal((20, 3))
    np.testing.assert_allclose(interpolate_bilinear(sheet, values, uv)[0], values, atol=1e-12)


def test_the_motion_stays_inside_the_arms_limits_and_starts_still():
    rig = robots.bimanual_rig(model="rizon4", frame="tcp_closed")
    swing = Swing()
    t = swing.times()
    q = solve_joint_positions(rig, swing.poses(t))
    used = measure_joint_usage(rig, t, q)
    assert used["range"] < 0.9
    assert used["velocity"] < 0.6
    assert used["acceleration"] < 4.0
    for value in q.values():
        assert np.ptp(value[t <= 0.2], axis=0).max() < 1e-5
    with pytest.raises(InvalidInput, match="velocity"):
        measure_joint_usage(rig, t / 5, q)


def test_an_arm_in_front_hides_cloth(open3d):
    view = CameraPlacement().make_view()
    sheet = SheetSpec(nodes=(5, 5))
    uv, faces = sheet_mesh(sheet)
    x = np.column_stack([np.full(25, 0.5), 0.2 - uv[:, 0], 0.1 + uv[:, 1]])[None]
    pose = np.eye(4)
    pose[:3, 3] = 0.6, 0.05, 0.3
    blocks = {False: [], True: [observe.build_solid_mesh("box", (0.02, 0.2, 0.2), pose)]}
    seen = {
        hidden: observe_cloth(view, np.zeros(1), x, faces, lambda i, m=meshes: m, np.random.default_rng(0))
        for hidden, meshes in blocks.items()
    }
    assert seen[True][2][0] < 0.85 * seen[False][2][0]
    assert len(seen[False][0].xyz) == 250
    assert np.abs(seen[False][0].xyz[:, 0] - 0.5).max() < 0.008
    assert seen[False][1] == pytest.approx(0.0012, rel=0.1)


def test_arm_meshes_reach_the_tool():
    rig = robots.bimanual_rig(model="rizon4", frame="tcp_closed")
    q = {name: rig[name].home[None].numpy() for name in ("left", "right")}
    vertices = np.concatenate([v for v, _ in arm_mesh_function(rig, q)(0)])
    tool = rig["left"](rig["left"].home).detach().numpy()[:3, 3]
    assert np.linalg.norm(vertices - tool, axis=1).min() < 0.03
    assert vertices[:, 2].min() > -0.01


@pytest.mark.slow
def test_the_whole_episode_converges_in_time_step_and_mesh():
    settings = make_example.ExampleSettings()
    rig = robots.bimanual_rig(model="rizon4", frame="tcp_closed")
    t = settings.swing.times()
    poses = make_example.tool_poses(rig, solve_joint_positions(rig, settings.swing.poses(t)))

    def run(changed):
        return make_example.simulate(changed, t, poses, np.random.default_rng(0))[0].x

    def rms(a, b):
        return np.sqrt(((a - b) ** 2).sum(-1).mean())

    base = run(settings)
    assert rms(base, run(replace(settings, step=settings.step / 2))) < 1e-5
    finer = make_example.make_knit(37)
    fine = run(replace(settings, sheet=finer, step=2e-5))
    uv, _ = sheet_mesh(settings.sheet)
    assert rms(base, np.stack([interpolate_bilinear(finer, x, uv)[0] for x in fine])) < 5e-3


def test_examples_path_is_in_this_repository():
    assert (make_example.REPOSITORY / "pyproject.toml").is_file()
    assert Path(make_example.__file__).is_relative_to(make_example.REPOSITORY)
