"""``torchcloth simulate``: one small episode from command to recording, and what it refuses."""

import json
import sys

import numpy as np
import pytest
import torch

from torchcloth import cli, recordings, robots
from torchcloth.boundaries.motion import interpolate_poses
from torchcloth.identification import build_cloth, build_episode
from torchcloth.losses import chamfer_to_surface
from torchcloth.observe import DepthCamera, decode_depth, to_points
from torchcloth.parameters import PhysicalParameter
from torchcloth.synthesis import generate

SMALL = ["--triangles", "98", "--rate", "6"]
EPISODE = "sheet_stretch"


def simulate(out, *options, garment="sheet", motion="stretch"):
    return cli.main(["simulate", "--garment", garment, "--motion", motion, "--out", str(out), *SMALL, *options])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("simulate")
    assert simulate(out) == 0
    return out


@pytest.fixture(scope="module")
def recording(folder):
    return recordings.read(folder / EPISODE, with_truth=True)


def test_what_is_missing_is_said_before_anything_is_simulated(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "open3d", None)
    monkeypatch.setattr(generate, "plan_and_simulate", lambda *_: pytest.fail("simulated"))
    assert simulate(tmp_path / "out") == 2
    assert "depth cameras and clouds need open3d" in capsys.readouterr().err


def test_leaves_episode_and_pictures_and_nothing_else(folder):
    assert sorted(p.name for p in folder.iterdir()) == ["overview.png", EPISODE, f"{EPISODE}.gif"]
    assert (folder / "overview.png").stat().st_size > 10_000


def test_says_that_it_is_synthetic_and_by_what(recording):
    assert recording.provenance.startswith("synthetic: torchcloth ")
    assert "inverse crime" in recording.provenance
    assert recording.extra["order"]["garment"] == "sheet"
    assert recording.extra["plan"]["slower"] >= 1


def test_held_vertices_follow_the_replayed_joints(recording):
    """Poses from joints through the arm's kinematics; vertices from the truth."""
    motion = robots.replay(recording)
    assert set(motion) == {"left", "right"} == set(recording.robots)
    times = torch.as_tensor(recording.truth.t)
    for name, grasp in recording.grasps.items():
        pose = interpolate_poses(motion[name], times).numpy()
        gripped = recording.truth.vertices[:, grasp.vertices]
        local = np.einsum("tba,tvb->tva", pose[:, :3, :3], gripped - pose[:, None, :3, 3])
        assert np.abs(local - local[0]).max() < 2e-5
        assert np.abs(local[0]).max() < 0.08, "near the tool"


def test_the_grippers_pull_it_apart(recording):
    x = recording.truth.vertices
    corners = {name: x[:, grasp.vertices].mean(1) for name, grasp in recording.grasps.items()}
    apart = np.linalg.norm(corners["left"] - corners["right"], axis=-1)
    assert apart.max() - apart[0] == pytest.approx(0.01, abs=2e-3)
    assert np.isfinite(x).all()
    assert x[..., 2].min() > 0.05


def test_points_lie_on_the_cloth(recording):
    faces = torch.as_tensor(recording.truth.faces.astype(np.int64))
    frames = np.searchsorted(recording.truth.t, recording.points.t)
    for i in (0, len(frames) - 1):
        cloud = torch.as_tensor(recording.points.frame(i))
        surface = torch.as_tensor(recording.truth.vertices[frames[i]], dtype=torch.float64)
        assert float(chamfer_to_surface(cloud, surface, faces)) < 3e-3


def test_depth_images_show_arms_table_and_cloth(recording):
    camera = recording.cameras["cam0"]
    depth = decode_depth(camera.depth.load(0), camera.depth_scale)
    points = to_points(DepthCamera.from_recording(camera), depth)
    assert (depth > 0).mean() > 0.4
    table = (np.abs(points[:, 2]) < 0.01) & (points[:, 0] > 0.25)
    arm = np.linalg.norm(points[:, :2] - [0.0, 0.316], axis=1) < 0.1
    assert table.sum() > 5000
    assert arm.sum() > 500


def test_identification_takes_it(recording):
    cloth = build_cloth(recording)
    episode = build_episode(cloth, recording)
    assert len(episode.clouds) == len(recording.points)
    assert set(episode.motion) == {"left", "right"}


def test_a_fit_starts_from_the_model_that_made_it_but_for_a_stiffer_membrane(recording):
    truth = {key.removeprefix("parameter/"): value for key, value in recording.truth.extra.items()}
    modules = build_cloth(recording).named_modules()
    start = {name: part.value.detach().numpy() for name, part in modules if isinstance(part, PhysicalParameter)}
    assert truth["material.youngs_modulus"] == pytest.approx(609020.0)  # DiffCP's cotton, Pa at 1 mm
    bending = ("effects.bending.stiffness", "effects.bending.damping_time")
    for name in (*bending, "material.poisson_ratio", "effects.air.normal", "areal_density"):
        assert start[name] == pytest.approx(truth[name]), name
    assert start["material.youngs_modulus"] / truth["material.youngs_modulus"] == pytest.approx(1.5)


def test_a_finished_episode_is_not_made_again(folder, capsys):
    recording = (folder / EPISODE / "episode.json").stat().st_mtime_ns
    assert simulate(folder) == 0
    assert "existed" in capsys.readouterr().out
    assert (folder / EPISODE / "episode.json").stat().st_mtime_ns == recording


def test_an_episode_of_another_order_is_refused(folder, capsys):
    assert simulate(folder, "--seed", "0", "--camera", "d435") == 2
    assert "an episode with camera azure_kinect; expected camera d435" in capsys.readouterr().err


def test_grippers_alone_go_as_fast_as_asked(tmp_path):
    assert simulate(tmp_path, "--grippers-only", "--no-pictures", "--camera", "d435", "--seed", "3") == 0
    recording = recordings.read(tmp_path / f"{EPISODE}_seed3", with_truth=True)
    assert not recording.joints
    assert not recording.robots
    assert recording.cameras["cam0"].width == 848
    motion = robots.replay(recording)
    assert set(motion) == {"left", "right"}
    assert float(motion["left"].t[-1]) == pytest.approx(4 * 0.3 + 0.3)
    assert not list(tmp_path.glob("*.gif"))


@pytest.mark.parametrize(
    ("options", "what"),
    [
        (["--garment", "hat"], "garment; got 'hat'; expected one of shirt, trousers, dress, sheet"),
        (["--motion", "iron"], "motion; got 'iron'"),
        (["--fabric", "velcro"], "fabric; got 'velcro'"),
        (["--triangles", "3"], "triangles; got 3"),
        (["--triangles", "1000000000"], "triangles; got 1000000000; expected 50 to 100000"),
        (["--rate", "nan"], "rate; got nan"),
        (["--rate", "1e9"], "rate; got 1000000000.0; expected a value > 0, at most 1000"),
        (["--speed", "1e-9"], "speed or acceleration; got 1e-09 m/s"),
        (["--seed", "-1"], "seed"),
    ],
)
def test_wrong_input_is_one_line_and_leaves_nothing(tmp_path, capsys, options, what):
    out = tmp_path / "new"
    assert simulate(out, *options) == 2
    error = capsys.readouterr().err
    assert what in error
    assert error.count("\n") == 1
    assert not out.exists()


def test_a_file_is_no_folder(tmp_path, capsys):
    (tmp_path / "file").write_text("mine")
    assert simulate(tmp_path / "file") == 2
    assert "--out" in capsys.readouterr().err
    assert (tmp_path / "file").read_text() == "mine"


def test_an_interruption_leaves_no_half_episode(tmp_path, capsys, monkeypatch):
    def stop(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("torchcloth.synthesis.generate.capture", stop)
    assert simulate(tmp_path, "--grippers-only") == 130
    assert "the same command continues" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_nine_in_one_command(tmp_path):
    """Three garments by three motions at their defaults: about 10 minutes on one core."""
    command = ["simulate", "--garment", "shirt", "trousers", "dress", "--motion", "cover", "fling", "drag"]
    assert cli.main([*command, "--out", str(tmp_path)]) == 0
    generate = sorted(path for path in tmp_path.iterdir() if path.is_dir())
    assert len(generate) == 9
    for path in generate:
        recording = recordings.read(path, with_truth=True)
        x = recording.truth.vertices
        assert x[..., 2].min() > -1e-3, "nothing under the table"
        assert np.ptp(x, axis=1).max() < 1.3, "whole"
        motion = next(iter(recording.joints.values()))
        released = motion.t[~motion.closed][0]
        after = recording.truth.t > released + 0.5
        assert np.abs(np.diff(x[after], axis=0)).max() * 15 < 0.6, "it comes to rest"
        spec = json.loads((path / "episode.json").read_text())["order"]
        assert (spec["garment"], spec["motion"]) == tuple(path.name.split("_"))
