"""The WAM of the carries, and its runs as recordings."""

import math

import numpy as np
import pytest
import torch

from torchcloth import recordings
from torchcloth.boundaries import Grasp
from torchcloth.identification import build_cloth, build_episode
from torchcloth.training.validation.realdata import carries, swings

UPPER_ARM_M, ELBOW_M, FOREARM_M, TOOL_M = 0.55, 0.045, 0.30, 0.0609  # Denavit-Hartenberg parameters of the WAM


def test_a_straight_arm_is_as_long_as_its_links():
    pose = carries.load_arm()(torch.zeros(7, dtype=torch.float64))
    expected = torch.eye(4, dtype=torch.float64)
    expected[2, 3] = UPPER_ARM_M + FOREARM_M + TOOL_M
    assert torch.allclose(pose, expected, atol=1e-12)


def test_a_right_angle_of_the_elbow_computed_by_hand():
    """Joint 4 turns about +y, 0.045 m in front of the upper arm; the forearm then points along +x, 0.045 m above it."""
    q = torch.zeros(7, dtype=torch.float64)
    q[3] = math.pi / 2
    pose = carries.load_arm()(q)
    expected = [ELBOW_M + FOREARM_M + TOOL_M, 0.0, UPPER_ARM_M + ELBOW_M]
    assert pose[:3, 3].tolist() == pytest.approx(expected, abs=1e-12)
    assert pose[:3, 2].tolist() == pytest.approx([1.0, 0.0, 0.0], abs=1e-12)


def test_the_arm_is_the_product_of_its_denavit_hartenberg_transforms():
    """Rot_z(theta) Trans_z(d) Trans_x(a) Rot_x(alpha), written out, at random joints."""
    table = [(0, -90, 0), (0, 90, 0), (0.045, -90, 0.55), (-0.045, 90, 0), (0, -90, 0.3), (0, 90, 0), (0, 0, TOOL_M)]
    q = np.random.default_rng(0).uniform(-1, 1, 7)
    expected = np.eye(4)
    for theta, (a, alpha, d) in zip(q, table, strict=True):
        c, s, ca, sa = math.cos(theta), math.sin(theta), math.cos(math.radians(alpha)), math.sin(math.radians(alpha))
        expected = expected @ [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1]]
    assert carries.load_arm()(torch.as_tensor(q)).numpy() == pytest.approx(expected, abs=1e-12)


@pytest.mark.realdata
def test_joints_give_the_recorded_pose_of_the_tool(measured_in):
    """Base and tool need no fitted constant: below 0.1 mm and 0.02 degrees RMS in every run.

    The largest differences, 0.74 mm and 0.17 degrees, are between samples whose stamps differ by up to a millisecond.
    """
    for run in carries.read_runs(measured_in("wam_carries")).values():
        error = carries.measure_kinematics(run)
        assert error.count > 250
        assert error.rms_m < 1e-4
        assert error.largest_m < 1e-3
        assert error.rms_deg < 0.02
        assert error.largest_deg < 0.2


@pytest.mark.realdata
def test_a_carry_is_an_episode(measured_in, tmp_path):
    source = measured_in("wam_carries")
    name = sorted(carries.read_runs(source))[4]
    recording = recordings.read(recordings.write(carries.read_episode(source, name), tmp_path / "episode"))
    cloth = build_cloth(recording)
    assert isinstance(cloth.boundaries["hanger"], Grasp)
    episode = build_episode(cloth, recording)
    assert len(episode.clouds) == len(recording.require("points")) > 100
    first = episode.clouds[0] - episode.initial.mean(0)
    assert float(first.mean(0).norm()) < 0.03
    assert recording.clock_offset == pytest.approx(-0.2, abs=0.02)


@pytest.mark.realdata
def test_few_frames_of_carries_are_rejected(measured_in):
    accepted = [swings.accepted_frames(run).mean() for run in carries.read_runs(measured_in("wam_carries")).values()]
    assert min(accepted) > 0.85
    assert np.median(accepted) > 0.95
