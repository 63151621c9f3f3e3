"""Motions, sensor, effects and the command line, without long simulations."""

import json
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("mujoco", minversion="4.0")

from torchcloth import recordings
from torchcloth._utils.constants import STANDARD_GRAVITY_M_PER_S2
from torchcloth.errors import InvalidInput
from torchcloth.training.validation.independent import generate
from torchcloth.training.validation.independent.effect_displacements import measure_displacement
from torchcloth.training.validation.independent.effects import CATALOGUE, add_effect, parse_effect
from torchcloth.training.validation.independent.flex_sheet import SheetSpec, rest_positions, sheet_mesh
from torchcloth.training.validation.independent.motions import GRIPPER_SIDES, MOTION_NAMES, make_motion, minimum_jerk
from torchcloth.training.validation.independent.scene import (
    GripSpec,
    Scene,
    _make_grip,
    apply_backlash,
    make_force_terms,
    recorded_poses,
    resample_evenly,
    stable_step,
)
from torchcloth.training.validation.independent.sensor import (
    EYE_M,
    ROTATION_CENTRE_M,
    TARGET_M,
    SensorSpec,
    sample_points,
)

SHEET = Scene().sheet


@pytest.mark.parametrize("name", CATALOGUE)
def test_amplitude_zero_leaves_the_scene_alone_and_a_typical_one_does_not(name):
    assert add_effect(Scene(), name, 0.0) == Scene()
    table = CATALOGUE[name].part == "table"
    base = add_effect(Scene(), "air.drag_n", 1.2)  # what a wind needs
    hidden = add_effect(base, name, CATALOGUE[name].typical)
    assert hidden != base
    assert len(make_force_terms(hidden, table)) >= len(make_force_terms(base, table))
    assert 0 < stable_step(hidden) <= 1.2 * stable_step(base)


@pytest.mark.slow
@pytest.mark.parametrize("name", CATALOGUE)
def test_a_typical_amplitude_shows(name):
    cloth, points, _ = measure_displacement(name)
    barely = {"air.drag_t": 1e-6}  # known to be too weak to be seen
    assert max(cloth, points) > barely.get(name, 1e-4)


def test_effects_are_parsed_and_wrong_ones_refused():
    assert parse_effect("air.wind=0.3,heading=90") == ("air.wind", 0.3, {"heading": 90.0})
    for text in ("air.wind", "air.wind=a", "air.wind=1=2"):
        with pytest.raises(InvalidInput, match="NAME=VALUE"):
            parse_effect(text)
    with pytest.raises(InvalidInput, match="effect"):
        add_effect(Scene(), "air.magic", 1.0)
    with pytest.raises(InvalidInput, match="option"):
        add_effect(Scene(), "air.wind", 1.0, {"threshold": 1.0})
    with pytest.raises(InvalidInput, match="drag coefficient"):
        make_force_terms(add_effect(Scene(), "air.wind", 1.0), on_table=False)


def test_shrinking_and_skewing_change_lengths_and_angle():
    spec = replace(SHEET, shrink_u=0.02, shrink_v=0.03, skew=0.1)
    uv, _ = sheet_mesh(spec)
    rest = rest_positions(spec)
    u, v = rest[spec.nodes[0] - 1] - rest[0], rest[-spec.nodes[0]] - rest[0]
    assert np.linalg.norm(u) == pytest.approx(0.98 * 0.3)
    assert np.linalg.norm(v) == pytest.approx(0.97 * 0.3)
    assert np.arccos(u @ v / np.linalg.norm(u) / np.linalg.norm(v)) == pytest.approx(np.pi / 2 - 0.1)
    np.testing.assert_array_equal(rest_positions(SHEET), uv)


@pytest.mark.parametrize("along", [8.5e-3, -8.5e-3])
def test_patches_end_where_they_are_hidden_to_end_and_not_at_the_next_vertex(along):
    plain = replace(Scene(), sheet=replace(SHEET, nodes=(19, 19)), grip=GripSpec(radius=0.0505))
    other = replace(plain, grip=replace(plain.grip, regrasp=along, extra_radius=5e-3))
    assert plain.aligned_to_patches is plain
    moved = other.aligned_to_patches
    assert moved.aligned_to_patches == moved
    uniform_lines, (u, v) = np.linspace(0, 0.3, 19), moved.sheet.grid_lines
    at = {"left": (3, along + 5e-3), "right": (-4, along - 5e-3)}  # lines at 50 and 250 mm
    for k, shift in at.values():
        assert u[k] == pytest.approx(uniform_lines[k] + shift)
    assert v[-4] == pytest.approx(0.25 - 5e-3)
    np.testing.assert_allclose(np.diff(u)[4:-4], np.diff(u)[4:-4].mean())
    hung = make_motion("hang", SHEET)
    for name in at:
        vertices = [_make_grip(scene, hung, name).vertices for scene in (plain, moved)]
        np.testing.assert_array_equal(*vertices)
    with pytest.raises(InvalidInput, match=r"grip; got patches of 0.0505 m, -0.048 m along"):
        replace(plain, grip=replace(plain.grip, regrasp=-0.048)).aligned_to_patches  # noqa: B018


def test_positions_at_even_distances_are_those_of_the_material():
    scene = replace(Scene(), sheet=replace(SHEET, nodes=(19, 19)), grip=GripSpec(radius=0.0505, regrasp=7e-3))
    uv, even = sheet_mesh(scene.aligned_to_patches.sheet)[0], sheet_mesh(scene.sheet)[0]
    assert np.abs(uv - even).max() == pytest.approx(7e-3)
    x = np.stack([np.column_stack([uv @ [1.0, 2.0], uv[:, 0] * 3, uv[:, 1]])] * 2)
    np.testing.assert_allclose(resample_evenly(scene, x)[1, :, 0], even @ [1.0, 2.0], atol=1e-12)


def test_a_minimum_jerk_leg_has_its_known_peak_speed():
    t = np.linspace(0, 2, 20001)
    x = minimum_jerk(t, np.array([0.5, 1.5]), np.array([0.0, 0.1]))
    assert np.gradient(x, t).max() == pytest.approx(1.875 * 0.1, rel=1e-6)
    assert x[0] == 0
    assert x[-1] == pytest.approx(0.1)


@pytest.mark.parametrize("name", MOTION_NAMES)
def test_motions_start_still_hold_the_sheet_s_corners_and_turn_with_the_heading(name):
    plain, turned, quick = (make_motion(name, SHEET, *options) for options in ((), (90.0,), (0.0, 2.0)))
    uv, _ = sheet_mesh(SHEET)
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    pivot = np.array([0.5, 0.0, 0.0])
    for gripper in GRIPPER_SIDES:
        path = plain.pose[gripper][:, :3, 3]
        assert np.ptp(path[plain.t <= 0.2], axis=0).max() == 0
        assert np.abs(np.linalg.det(plain.pose[gripper][:, :3, :3]) - 1).max() < 1e-12
        np.testing.assert_allclose(turned.pose[gripper][:, :3, 3], (path - pivot) @ quarter.T + pivot, atol=1e-12)
        corner = np.argmin(np.linalg.norm(uv - plain.grasp_points[gripper], axis=1))
        np.testing.assert_allclose(plain.initial_shape(uv)[corner], path[0], atol=1e-9)
        assert path[:, 2].min() >= 0
    assert quick.t[-1] < plain.t[-1]
    start = plain.initial_shape(uv)
    assert np.abs(np.linalg.norm(start[1] - start[0]) * (SHEET.nodes[0] - 1) / SHEET.width - 1) < 0.04


def moving_sheet(speed):
    """Knots, and a flat sheet that moves along x."""
    t = np.linspace(0, 1, 101)
    uv, _ = sheet_mesh(SHEET)
    still = np.column_stack([np.full(len(uv), 0.5), uv[:, 0] - 0.15, uv[:, 1] + 0.1])
    return t, still + np.multiply.outer(t * speed, [1.0, 0, 0])[:, None]


def sample_moving_sheet(speed=0.0, seed=0, **changes):
    t, x = moving_sheet(speed)
    return sample_points(SensorSpec(**{"noise": 0.0, **changes}), SHEET, t, x, np.random.default_rng(seed))


def test_without_errors_points_lie_on_the_sheet():
    clouds = sample_moving_sheet()
    assert np.abs(clouds.xyz[:, 0] - 0.5).max() < 1e-12
    assert clouds.counts.tolist() == [250] * 31
    assert np.ptp(clouds.xyz[:, 1]) > 0.29


def test_late_stamps_show_the_past():
    behind = sample_moving_sheet(0.5).xyz - sample_moving_sheet(0.5, delay=0.04).xyz
    after = np.repeat(sample_moving_sheet().t > 0.04, 250)
    np.testing.assert_allclose(behind[after], np.broadcast_to([0.02, 0, 0], (after.sum(), 3)), atol=1e-9)


def test_depth_errors_act_along_the_ray():
    plain, scaled, biased = (
        np.linalg.norm(c.xyz - EYE_M, axis=1)
        for c in (sample_moving_sheet(), sample_moving_sheet(scale=0.02), sample_moving_sheet(offset=5e-3))
    )
    np.testing.assert_allclose(scaled, 1.02 * plain)
    np.testing.assert_allclose(biased, plain + 5e-3)
    assert np.std(np.linalg.norm(sample_moving_sheet(noise=2e-3).xyz - EYE_M, axis=1) - plain) == pytest.approx(
        2e-3, rel=0.03
    )


def test_a_wrong_camera_moves_everything_rigidly():
    a, b = sample_moving_sheet().xyz, sample_moving_sheet(shift=4e-3, heading=90.0, rotation=0.02).xyz
    np.testing.assert_allclose(np.linalg.norm(a[1:] - a[:-1], axis=1), np.linalg.norm(b[1:] - b[:-1], axis=1))
    np.testing.assert_allclose(
        sample_moving_sheet(shift=4e-3, heading=90.0).xyz - a, np.broadcast_to([0, 4e-3, 0], a.shape), atol=1e-12
    )


@pytest.mark.parametrize("target", [TARGET_M, (0.55, 0.04, 0.26)])
def test_a_camera_that_leans_turns_the_cloth_about_its_middle(target):
    """Wherever it looks: turned about another place, it would seem to stand elsewhere as well."""
    upright, leaning = (
        sample_moving_sheet(target=target, **how).xyz - ROTATION_CENTRE_M
        for how in ({}, {"lean": 0.02, "heading": 90.0})
    )
    lean = 0.02
    along = np.array([0.0, 1.0, 0.0])
    np.testing.assert_allclose(leaning @ along, upright @ along, atol=1e-12)
    turned = upright * np.cos(lean) + np.cross(along, upright) * np.sin(lean)
    np.testing.assert_allclose(leaning[:, [0, 2]], turned[:, [0, 2]], atol=1e-12)


def test_the_slow_bias_has_about_its_size_and_lasts():
    def depth(seed, **changes):
        return np.linalg.norm(sample_moving_sheet(seed=seed, **changes).xyz - EYE_M, axis=1).reshape(31, 250)

    error = np.stack([depth(k, bias=1e-3) - depth(k) for k in range(8)])
    assert 0.4e-3 < error.std() < 1.5e-3
    mean = error.mean(2)
    assert np.corrcoef(mean[:, :-1].ravel(), mean[:, 1:].ravel())[0, 1] > 0.6


def test_occlusion_hides_a_bar_that_moves_across_and_edges_go_unseen():
    clouds = sample_moving_sheet(occlusion=0.4, points=500)
    first, last = clouds.frame(0)[:, 1], clouds.frame(30)[:, 1]
    assert first.min() > -0.10  # seen from +x, left is where y is negative
    assert last.max() < 0.10
    cropped = sample_moving_sheet(edge=0.02).xyz
    assert np.ptp(cropped[:, 1]) <= 0.26
    assert np.ptp(cropped[:, 2]) <= 0.26


def test_backlash_follows_half_its_play_behind():
    path = np.concatenate([np.linspace(0, 1, 101), np.linspace(1, 0, 101)])[:, None]
    out = apply_backlash(path, 0.1)
    assert out[100, 0] == pytest.approx(0.95)
    assert out[-1, 0] == pytest.approx(0.05)
    assert out[105, 0] == out[100, 0]
    np.testing.assert_array_equal(apply_backlash(path, 0.0), path)


def test_a_wrong_base_moves_the_recorded_grippers_rigidly():
    pose = make_motion("swing", SHEET).pose
    wrong = {k: recorded_poses(GripSpec(base=2e-3, heading=90.0, yaw=0.01), p) for k, p in pose.items()}
    between = [np.linalg.norm(p["left"][:, :3, 3] - p["right"][:, :3, 3], axis=1) for p in (pose, wrong)]
    np.testing.assert_allclose(*between)
    for key, path in pose.items():
        np.testing.assert_array_equal(recorded_poses(GripSpec(), path), path)
        assert not np.allclose(wrong[key], path)


@pytest.fixture(scope="module")
def episodes(tmp_path_factory):
    """A null and an episode with hidden effects, made by the command, small."""
    folder = tmp_path_factory.mktemp("episodes")
    small = ["--motion", "stretch", "--nodes", "9", "--fit-nodes", "5", "--speed", "2", "--seed", "3"]
    hidden = ["--effect", "mass.hem=0.0223", "--effect", "obs.clock=0.0123"]
    for name, more in (("a", []), ("b", hidden)):
        assert generate.main([*small, *more, "--out", str(folder / name)]) == 0
    return folder


def test_episodes_can_be_read_and_show_what_was_hidden(episodes):
    a, b = (recordings.read(episodes / name, with_truth=True) for name in "ab")
    weight = {
        name: -sum(grip.force[:15, 2].mean() for grip in recording.grippers.values())
        for name, recording in (("a", a), ("b", b))
    }
    assert weight["a"] == pytest.approx(0.25 * 0.09 * STANDARD_GRAVITY_M_PER_S2, abs=0.02)
    assert weight["b"] - weight["a"] == pytest.approx(0.0223 * 1.2 * STANDARD_GRAVITY_M_PER_S2, abs=0.02)
    assert a.points.counts.tolist() == b.points.counts.tolist()


def test_nothing_in_an_episode_names_what_was_hidden(episodes):
    files = {name: sorted(p.relative_to(episodes / name) for p in (episodes / name).rglob("*")) for name in "ab"}
    assert files["a"] == files["b"]
    texts = [json.loads((episodes / name / "episode.json").read_text()) for name in "ab"]
    assert texts[0] == texts[1]
    stored = b"".join(p.read_bytes() for p in (episodes / "b").rglob("*") if p.is_file())
    assert b"hem" not in stored.replace(b"scheme", b"").replace(b"schema", b"")
    assert b"0.0223" not in stored
    with np.load(episodes / "b" / "truth.npz") as truth:
        assert set(truth.files) == {"t", "vertices", "faces", "nodes"}
    hidden = json.loads((episodes / "b.hidden.json").read_text())
    assert hidden["effects"] == [
        {"effect": "mass.hem", "amplitude": 0.0223},
        {"effect": "obs.clock", "amplitude": 0.0123},
    ]


def test_the_same_seed_makes_the_same_episode(episodes, tmp_path):
    arguments = ["--motion", "stretch", "--nodes", "9", "--fit-nodes", "5", "--speed", "2", "--seed", "3"]
    assert generate.main([*arguments, "--out", str(tmp_path / "again")]) == 0
    first, again = (recordings.read(path, with_truth=True) for path in (episodes / "a", tmp_path / "again"))
    np.testing.assert_array_equal(first.points.xyz, again.points.xyz)
    np.testing.assert_array_equal(first.truth.vertices, again.truth.vertices)


def test_bad_arguments_are_one_line_and_exit_code_2(tmp_path, capsys):
    out = tmp_path / "x"
    for arguments in (["--motion", "dance"], ["--effect", "air.magic=1"], ["--speed", "0"], ["--effect", "air.wind=1"]):
        assert generate.main([*arguments, "--out", str(out)]) == 2
        assert capsys.readouterr().err.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_a_wider_sheet_moves_as_well():
    wide = SheetSpec(0.5, 0.3, nodes=(11, 7))
    moved = make_motion("lift", wide)
    apart = moved.pose["left"][0, :3, 3] - moved.pose["right"][0, :3, 3]
    np.testing.assert_allclose(apart, [0, 0.5, 0], atol=1e-12)


def test_an_existing_episode_is_refused_before_the_simulation(tmp_path, capsys):
    assert generate.main(["--motion", MOTION_NAMES[0], "--out", str(tmp_path)]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert lines[0].endswith("which exists; expected a new name; or --overwrite")
