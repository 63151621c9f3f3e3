"""The study of honest intervals: how it scores, what its faults do, and a reduced run from recording to table."""

import json

import numpy as np
import pytest

from torchcloth import recordings
from torchcloth.inspection.corrections import find_frozen_clouds
from torchcloth.training.studies import honesty
from torchcloth.training.studies.command import main
from torchcloth.training.validation.independent import rig_recording
from torchcloth.training.validation.independent.rig_recording import FAULTS, MeshSize, draw_faults, make_rig_recording

SMALL = MeshSize(truth=7, fit=5, coarse=4)


def case(value, std, identifiable=True, truth=1.0):
    fitted = {"value": value, "std": std, "ci95": [value - 1.96 * std, value + 1.96 * std]}
    return {
        "motion": "swing",
        "faults": {"lag": "20 ms"},
        "truth": {"air.normal": truth},
        "parameters": {"air.normal": {**fitted, "identifiable": identifiable}},
        "refused": "",
        "cpu_seconds": 10.0,
    }


def test_only_numbers_that_are_called_identifiable_count():
    cases = {0: case(1.1, 0.1), 1: case(2.0, 0.1), 2: case(9.0, 0.1, identifiable=False), 3: case(1.29, 0.1)}
    numbers = honesty.identified_numbers(cases)
    assert [holds for _, holds in numbers] == [True, False, False]
    assert [round(z) for z, _ in numbers] == [1, 10, 3]
    ((_, count, identified, holds, far, refused, seconds),) = honesty.summarise({"a": cases})
    assert (count, identified, refused, seconds) == ("4", "3 of 4", "0", "40")
    assert holds.startswith("1 of 3 = 33 %")
    assert far.startswith("1 of 3")  # 2.9 is not more than 3


def test_a_refused_recording_has_no_number_and_is_counted():
    refused = {**case(1.0, 0.1), "parameters": {}, "refused": "nothing holds the cloth"}
    ((_, _, identified, holds, _, count, _),) = honesty.summarise({"a": {0: refused}})
    assert (identified, holds, count) == ("0 of 1", "–", "1")


def test_every_fault_is_drawn_and_rigs_have_one_to_three():
    drawn = [draw_faults(seed) for seed in range(40)]
    assert {len(faults) for faults in drawn} == {1, 2, 3}
    assert all(len(set(faults)) == len(faults) for faults in drawn)
    counts = {name: sum(name in faults for faults in drawn) for name in FAULTS}
    assert min(counts.values()) >= 4
    assert drawn == [draw_faults(seed) for seed in range(40)]


def only(monkeypatch, *names):
    monkeypatch.setattr(rig_recording, "draw_faults", lambda seed: list(names))
    return make_rig_recording(0, SMALL)


@pytest.fixture
def plain(monkeypatch):
    return only(monkeypatch)


def test_a_recording_says_nothing_that_a_stranger_does_not_know(plain):
    recording = plain.recording
    assert recording.observation_noise_std is None
    assert recording.split == {}
    assert all(m.force is None and m.torque is None for m in recording.grippers.values())


def test_the_true_vertices_are_near_the_points(plain):
    first = plain.recording.points.frame(0)
    distance = np.linalg.norm(first[:, None] - plain.vertices[0], axis=-1).min(1)
    assert np.median(distance) < 0.05  # less than an edge of this mesh
    assert len(plain.vertices) == len(plain.recording.points.t)


@pytest.mark.parametrize("name", ["lost frames", "frozen frames", "jitter", "robot points", "lag"])
def test_faults_of_clouds_leave_what_they_promise(monkeypatch, plain, name):
    changed = only(monkeypatch, name)
    clouds, before = changed.recording.points, plain.recording.points
    assert (np.diff(clouds.t) > 0).all()
    assert len(changed.vertices) == len(clouds.t)
    if name == "lost frames":
        assert len(clouds.t) <= len(before.t) - rig_recording.GAP_FRAMES
    if name == "frozen frames":
        assert find_frozen_clouds(clouds).sum() == rig_recording.GAP_FRAMES - 1
    if name == "jitter":
        assert not np.array_equal(clouds.t, before.t)
        assert np.array_equal(clouds.xyz, before.xyz)
    if name == "robot points":
        assert (clouds.counts == before.counts + 2 * rig_recording.FINGER_POINTS).all()
    if name == "lag":
        assert np.abs(changed.vertices - plain.vertices).max() > 1e-3


def run_reduced(folder, *options):
    """The result of a reduced study of one rig, with a short motion."""
    assert main(["honesty", "--out", str(folder), "--fast", "--rigs", "1", "--first", "12", *options]) == 0
    return json.loads((folder / "honesty.json").read_text())


def test_a_reduced_study_runs_from_the_recording_to_the_table(tmp_path, capsys):
    result = run_reduced(tmp_path / "a", "--poses", "0")
    (answer,) = result["answers"][honesty.THIS_VERSION].values()
    assert answer["refused"] == ""
    assert answer["parameters"].keys() == honesty.PARAMETER_SYMBOLS.keys()
    numbers = honesty.identified_numbers({0: answer})
    assert numbers
    assert all(abs(z) < honesty.MAX_STD_ERRORS for z, _ in numbers)
    assert recordings.read(tmp_path / "a" / "episodes" / "012").observation_noise_std is None
    assert "Numbers that are called identifiable" in capsys.readouterr().out


@pytest.mark.slow  # half a minute
def test_a_reduced_study_compares_a_pose_with_the_truth(tmp_path):
    (pose,) = run_reduced(tmp_path / "a", "--poses", "1")["poses"].values()
    assert pose["coverage"] > 0.8
    assert pose["rms"] < pose["rms_simulated"]


@pytest.mark.parametrize(
    "options", [["--rigs", "0"], ["--rigs", "2", "--poses", "3"], ["--compare", "old=/no/such/python"]]
)
def test_wrong_options_are_refused(tmp_path, capsys, options):
    assert main(["honesty", "--out", str(tmp_path / "a"), *options]) == 2
    assert "--" in capsys.readouterr().err
    assert not (tmp_path / "a").exists()
