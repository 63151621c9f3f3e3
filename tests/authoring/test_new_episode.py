"""Episodes from the files of a bench are those that the files were made from."""

import importlib
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.bench_files import BAR_SHEET_M, HANDS, Bench, write_bar, write_two_arms
from helpers.command_line import one_line

from torchcloth import recordings, robots
from torchcloth.cli import main
from torchcloth.episodes.pattern_interpolation import interpolate_on_pattern, interpolation_weights
from torchcloth.losses import find_closest_points
from torchcloth.meshes import Mesh
from torchcloth.observe import CameraPose
from torchcloth.recordings.formats.calibration_files import read_pose

MAX_POINT_ERROR_M = 2e-3  # rms: noise of 1 mm, images in mm
MAX_CORNER_ERROR_M = 0.012  # a pixel at 1 m
MAX_CLOCK_ERROR_S = 0.01


@pytest.fixture(scope="module")
def _double():
    torch.set_default_dtype(torch.float64)


@pytest.fixture(scope="module")
def bar(tmp_path_factory, _double) -> Bench:
    """A sheet on a bar."""
    return write_bar(tmp_path_factory.mktemp("bench") / "bar")


@pytest.fixture(scope="module")
def two_arms(tmp_path_factory, _double) -> Bench:
    """A sheet in two hands."""
    return write_two_arms(tmp_path_factory.mktemp("bench") / "two")


def compute_point_errors(bench: Bench, recording: recordings.Recording) -> np.ndarray:
    """Return the rms distance [T] m of each cloud from the true surface."""
    faces, errors = torch.as_tensor(bench.faces), []
    for i, time in enumerate(recording.points.t + recording.clock_offset):
        x = torch.as_tensor(bench.x[np.abs(bench.times - time).argmin()]).double()
        points = torch.as_tensor(recording.points.frame(i)).double()
        closest = find_closest_points(points, x, faces).interpolate(x)
        errors.append(float((points - closest).square().sum(-1).mean().sqrt()))
    return np.array(errors)


def find_corners(recording: recordings.Recording, sheet: tuple[float, float]) -> np.ndarray:
    """Return the first positions [2, 3] m of the lower left and upper right corner of the sheet."""
    mesh = Mesh.build(recording.cloth.vertices, recording.cloth.faces, recording.cloth.uv)
    weights = interpolation_weights(mesh, np.array([[0.0, 0.0], sheet]))
    return interpolate_on_pattern(weights, torch.as_tensor(recording.cloth.initial_vertices)).numpy()


def check_gripper_path(bench: Bench, recording: recordings.Recording, names: dict[str, str]) -> None:
    paths, true_paths = robots.replay(recording), robots.replay(bench.source)
    for name, true_name in names.items():
        true_path = true_paths[true_name]
        np.testing.assert_allclose(paths[name].t, true_path.t, atol=1e-6)
        torch.testing.assert_close(paths[name].pose, true_path.pose, atol=1e-9, rtol=0)


def test_a_sheet_on_a_bar_becomes_an_episode(bar, tmp_path, capsys):
    """Without a header, in ms and degrees, with a table of the images' times, a quaternion and a CameraInfo."""
    assert main(["new", str(tmp_path / "episode"), *bar.options, "--motion", "carry"]) == 0
    said, recording = capsys.readouterr().out, recordings.read(tmp_path / "episode")
    for guess in ("milliseconds", "degrees", "depth_times.csv", "on one clock", "closed all", "by their order"):
        assert guess in said
    assert "holds the whole edge at" in said
    assert "from the mass on a scale of 1 g" in said
    assert "verdict: Ready for identify." in said
    assert said.splitlines()[-1] == f"next: torchcloth identify {tmp_path}/episode --out {tmp_path}/episode_fit"
    assert (tmp_path / "episode" / "new.png").stat().st_size > 20_000
    check_gripper_path(bar, recording, {"gripper": "left"})
    assert len(recording.points) == len(bar.times)
    assert compute_point_errors(bar, recording).max() < MAX_POINT_ERROR_M
    assert np.ptp(recording.grasps["gripper"].uv, axis=0).tolist() == [BAR_SHEET_M[0], 0.0]
    assert recording.cloth.areal_density == pytest.approx(0.02 / np.prod(BAR_SHEET_M))
    assert recording.split == {"motion": "carry"}
    x = find_corners(recording, BAR_SHEET_M)
    true_x = bar.x[0, [0, -1]]
    mirrored = x * [1, -1, 1] + [0, 2 * bar.x[0, :, 1].mean(), 0]  # a sheet of one colour looks the same from behind
    assert min(np.abs(one - true_x).max() for one in (x, mirrored)) < MAX_CORNER_ERROR_M


def test_a_sheet_in_two_hands_becomes_an_episode_on_the_clock_of_the_joints(two_arms, tmp_path, capsys):
    """Stamps of a camera that counts from its start, and its pose as world to camera."""
    assert main(["new", str(tmp_path / "episode"), *two_arms.options]) == 0
    said, recording = capsys.readouterr().out, recordings.read(tmp_path / "episode")
    for guess in ("nanoseconds", "radians", "world to camera", "no time in common", "0.2 ± 0.1 kg/m^2"):
        assert guess in said
    assert "verdict: Ready for identify." in said
    check_gripper_path(two_arms, recording, {name: name for name in HANDS})
    assert recording.clock_offset == pytest.approx(0.0, abs=MAX_CLOCK_ERROR_S)
    assert compute_point_errors(two_arms, recording).max() < MAX_POINT_ERROR_M
    x, (low, high) = find_corners(recording, (0.4, 0.4)), np.quantile(two_arms.source.cloth.uv, [0, 1], axis=0)
    k = [np.flatnonzero((two_arms.source.cloth.uv == corner).all(1))[0] for corner in (low, high)]
    assert np.abs(x - two_arms.source.cloth.initial_vertices[k]).max() < MAX_CORNER_ERROR_M


@pytest.mark.slow
def test_identify_accepts_a_new_episode(two_arms, tmp_path, capsys):
    assert main(["new", str(tmp_path / "episode"), *two_arms.options, "--mass", "0.056", "--span", "0", "0.7"]) == 0
    fit = ["--fit", "air.normal", "--iterations", "1", "--out", str(tmp_path / "fit")]
    assert main(["identify", str(tmp_path / "episode"), *fit]) == 0
    assert json.loads((tmp_path / "fit" / "identification.json").read_text())["parameters"]["air.normal"]


def replace_option(options: list[str], option: str, *values: str) -> list[str]:
    """Return the options with other values of one of them."""
    k = options.index(option)
    return [*options[: k + 1], *values, *options[k + 1 + len(values) :]]


@pytest.mark.parametrize(
    ("option", "values", "said"),
    [
        ("--held", ("0.3", "0.25"), "in a corner"),
        ("--held", ("0.1", "0.1"), "on no edge"),
        ("--held", ("0.1", "25"), "v from 0 to 0.25 m"),
        ("--sheet", ("0.3", "-1"), "width and height > 0"),
        ("--sheet", ("30", "25"), "convert mm or cm to m"),
        ("--mass", ("20",), "convert g to kg"),
        ("--tool", ("hand",), "has no link for frame"),
        ("--mass", ("0",), "--mass"),
        ("--depth", ("nowhere",), "is no folder"),
    ],
)
def test_bad_facts_are_refused_in_one_line(bar, tmp_path, capsys, option, values, said):
    assert main(["new", str(tmp_path / "episode"), *replace_option(bar.options, option, *values)]) == 2
    assert said in one_line(capsys.readouterr().err)
    assert not (tmp_path / "episode").exists()


def test_an_episode_is_replaced_only_if_asked(bar, tmp_path, capsys):
    (tmp_path / "episode").mkdir()
    assert main(["new", str(tmp_path / "episode"), *bar.options]) == 2
    assert "DIR exists" in one_line(capsys.readouterr().err)
    assert main(["new", str(tmp_path / "episode"), *bar.options, "--overwrite"]) == 2
    assert "DIR is no episode" in one_line(capsys.readouterr().err)


def test_a_camera_that_sees_nothing_at_the_gripper_is_refused(bar, tmp_path, capsys):
    (tmp_path / "pose.txt").write_text("0 0 5 0 0 0 1")
    options = replace_option(bar.options, "--camera-pose", f"{tmp_path}/pose.txt")
    assert main(["new", str(tmp_path / "episode"), *options]) == 2
    assert "camera pose; got nothing" in one_line(capsys.readouterr().err)


def test_two_arms_need_two_joint_logs_or_one_for_both(two_arms, tmp_path, capsys):
    assert main(["new", str(tmp_path / "episode"), *two_arms.options, "--tool", "flange", "--tool", "flange"]) == 2
    assert "number of --tool" in one_line(capsys.readouterr().err)


def without_option(options: list[str], option: str) -> list[str]:
    """Return the options without one of them and its value."""
    i = options.index(option)
    return [*options[:i], *options[i + 2 :]]


def test_a_camera_that_nobody_calibrated_is_found_from_the_arm(bar, tmp_path, capsys, monkeypatch):
    """Here the sheet hides half of the arm, and ``test_camera_from_arm.py`` tests the estimate in full view."""
    true_pose = read_pose(Path(bar.options[bar.options.index("--camera-pose") + 1]))
    pose = CameraPose(true_pose, 1e-6 * np.eye(6), np.zeros(0), np.zeros(0), 1.0, 1e-3, 5000, 0.9)
    module = importlib.import_module("torchcloth.authoring.new_episode")  # the package has a function of this name
    monkeypatch.setattr(module, "find_camera_pose_from_arms", lambda recording, name: pose)
    assert main(["new", str(tmp_path / "episode"), *without_option(bar.options, "--camera-pose")]) == 0
    assert "camera: pose from the arm, to 1.7 mm and 0.10 degrees (else give --camera-pose)" in capsys.readouterr().out
    np.testing.assert_array_equal(recordings.read(tmp_path / "episode").cameras["cam0"].T_world_camera, true_pose)


def test_where_images_have_another_clock_the_pose_is_asked_for(two_arms, tmp_path, capsys):
    assert main(["new", str(tmp_path / "episode"), *without_option(two_arms.options, "--camera-pose")]) == 2
    said = capsys.readouterr().err
    assert "another clock than the joints" in said
    assert "--camera-pose" in said
    assert not (tmp_path / "episode").exists()
