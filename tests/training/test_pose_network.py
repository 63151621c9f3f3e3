"""The study of poses from a network, reduced: an episode of the other engine, its methods, and the tables."""

import json

import numpy as np
import pytest
import torch
from helpers import twins

from torchcloth import identification
from torchcloth.pose import PoseEstimator, PoseNetworkConfig, rest_coordinates, save_network
from torchcloth.training.studies import pose_network, pose_network_tables
from torchcloth.training.studies.command import main
from torchcloth.training.validation.independent import moving_recording
from torchcloth.training.validation.independent.moving_recording import MovingSize

TINY_SIZE = MovingSize(spacing=0.15, fit=5, rate=4.0, shrink=2)
TINY_NETWORK = PoseNetworkConfig(width=16, heads=2, point_blocks=1, latents=4, vertex_blocks=1, refinements=1)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("pose_network")


@pytest.fixture(scope="module")
def held_out(folder):
    """An episode of a sheet in two grippers, coarse in space and time."""
    with pytest.MonkeyPatch.context() as patch, twins.use_float64():
        patch.setattr(pose_network, "FAST_SIZE", TINY_SIZE)
        pose_network.find_or_make_episode(folder, 0, True)
        return pose_network.find_or_make_episode(folder, 0, True)  # as it is read again


@pytest.fixture(scope="module")
def weights(folder):
    torch.manual_seed(0)
    save_network(PoseEstimator(TINY_NETWORK), folder / "tiny.safetensors")
    return folder / "tiny.safetensors"


def test_a_recording_begins_in_motion_and_has_no_first_shape(held_out):
    cloth = held_out.recording.cloth
    assert cloth.initial_vertices is None
    assert cloth.initial_velocities is None
    assert float(held_out.v[0].norm(dim=-1).max()) > 0.05
    assert held_out.recording.points.t[0] == held_out.recording.grippers["left"].t[0] == 0


def test_the_points_are_the_cloths_though_nobody_said_which(held_out):
    assert held_out.facts["foreign"] < 0.05
    assert 0.1 < held_out.facts["occluded"] < 0.6
    assert held_out.recording.points.counts.min() > 50
    distance = torch.cdist(torch.as_tensor(held_out.recording.points.frame(0)), held_out.x[0]).amin(1)
    assert float(distance.median()) < 0.06


def test_the_truth_is_at_the_vertices_that_the_grippers_hold(held_out):
    for name, part in held_out.cloth.boundaries.items():
        origin = torch.as_tensor(held_out.recording.grippers[name].position[0])
        assert float((held_out.x[0, part.index].mean(0) - origin).norm()) < 0.04


def test_the_sheet_hangs_from_its_grippers_and_is_not_the_truth(held_out):
    x = pose_network.hanging_shape(held_out)
    error = (x - held_out.x[0]).square().sum(-1).mean().sqrt()
    assert 1e-3 < float(error) < 0.08
    gripped = torch.cat([part.index for part in held_out.cloth.boundaries.values()])
    assert float((x - held_out.x[0])[gripped].norm(dim=-1).max()) < 0.02


def test_registration_comes_nearer_than_the_simulation_from_rest(held_out):
    simulated, registered = (
        case(lambda: held_out) for case in (pose_network._simulated_case, pose_network._registered_case)
    )
    assert registered["rms"] < simulated["rms"] < 0.1


def test_every_frame_has_an_estimate_and_its_time(held_out, weights):
    case = pose_network._network_cases(lambda: held_out, weights)
    for name in (pose_network.ALONE, pose_network.WITH_PREVIOUS):
        assert 0 < case[name]["rms"] < 1.0
        assert 0 <= case[name]["coverage"] <= 1
        assert 0 < case[name]["ms_per_cloud"] < 1000


def test_a_frame_without_a_cloud_has_the_estimate_before(held_out, weights):
    episode = identification.build_episode(held_out.cloth, held_out.recording, has_first_shape=False)
    episode.clouds[1] = episode.clouds[1][:0]
    network, rest = pose_network.load_network(weights), rest_coordinates(held_out.cloth.mesh)
    x, _, seconds = pose_network.predict_frames(network, held_out.cloth, episode, rest, False)
    assert len(seconds) == len(x) - 1
    torch.testing.assert_close(x[1], x[0])


def test_the_seeds_alternate_grips_and_cameras():
    pairs = {(moving_recording.grip_of_seed(k), moving_recording.camera_of_seed(k)) for k in range(8)}
    assert len(pairs) == 6


def test_an_unknown_network_is_refused_before_any_work(tmp_path, capsys):
    assert main(["pose_network", "--network", "a=lost.safetensors", "--out", str(tmp_path / "s")]) == 2
    assert "--network" in capsys.readouterr().err
    assert not (tmp_path / "s").exists()


# -- tables -----------------------------------------------------------------------------------------------------------


def results(rms):
    """Results of episodes by method."""

    def case(value):
        if value is None:
            return {"failed": "diverged"}
        numbers = {"rms": value, "rms_hidden": value, "rms_first": value, "hidden_share": 0.3, "cpu_seconds": 1.0}
        return {**numbers, "rms_of_much_hidden_clouds": [value]}

    facts = {"grip": "corner", "motion": "swing", "camera": "kinect"}
    return {
        seed: {"facts": facts, "methods": {name: case(values[seed]) for name, values in rms.items()}}
        for seed in range(len(next(iter(rms.values()))))
    }


def test_a_failure_counts_as_farther_from_the_truth():
    table = results({"simulated": [0.02, 0.02, 0.004], "network + simulation": [0.005, None, 0.005]})
    rate = pose_network_tables.compare(table, "network + simulation", "simulated")
    assert (rate.hits, rate.of) == (1, 3)


def test_the_interval_of_a_median_holds_it():
    median, low, high = pose_network_tables.bootstrap_median(np.arange(1.0, 18.0))
    assert median == 9.0
    assert 4 <= low < 9 < high <= 14


def test_tables_and_picture_of_two_networks(tmp_path):
    methods = ("simulated", "network (a)", "network + simulation (a)", "network (b)", "network + simulation (b)")
    table = results({name: [0.01 + 0.001 * k, 0.02] for k, name in enumerate(methods)})
    text = pose_network_tables.to_markdown(table, ["a", "b"])
    assert text.count("\n") == 2 + len(methods) + 1 + 2 + 2
    assert "| network (b) | 16.5 (13.0 to 20.0) |" in text
    assert pose_network_tables.write_picture(table, tmp_path / "p.png").stat().st_size > 1000


@pytest.mark.slow
def test_the_reduced_study_resumes(tmp_path, weights):
    arguments = ["pose_network", "--fast", "--network", f"tiny={weights}", "--out", str(tmp_path / "s")]
    assert main(arguments) == 0
    first = json.loads((tmp_path / "s" / "pose_network.json").read_text())
    assert main(arguments) == 0
    assert json.loads((tmp_path / "s" / "pose_network.json").read_text()) == first
