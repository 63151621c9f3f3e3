"""Training of the pose network: its losses, its steps, its command."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import torchcloth as tc
from torchcloth import recordings
from torchcloth._utils.torch_modes import default_dtype
from torchcloth.pose.first_shape import load_network
from torchcloth.pose.network import PoseEstimator, PoseNetworkConfig
from torchcloth.training.pose import train
from torchcloth.training.pose.command import main
from torchcloth.training.pose.data import PoseDataset, collate
from torchcloth.training.pose.module import PoseLossWeights, PoseTraining
from torchcloth.training.pose.motions import make_data
from torchcloth.training.pose.physics_loss import PhysicsLoss
from torchcloth.training.pose.train import evaluate
from torchcloth.training.pose.unlabelled import write_unlabelled

SMALL = PoseNetworkConfig(width=16, heads=2, point_blocks=1, latents=4, vertex_blocks=1, refinements=2, hypotheses=2)
STEP = 1e-6


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder of three motions of one cloth."""
    path = tmp_path_factory.mktemp("pose-data")
    make_data(path, 3, "train")
    return path


@pytest.fixture
def batch(folder):
    dataset = PoseDataset(folder)
    return collate([dataset[k] for k in (0, 3, 16, 31)])


@pytest.fixture
def single_precision():
    with default_dtype(torch.float32):
        yield


@pytest.mark.usefixtures("single_precision")
def test_a_few_steps_make_the_error_smaller(batch):
    torch.manual_seed(0)
    module = PoseTraining(PoseEstimator(SMALL), learning_rate=3e-3)
    optimizer = torch.optim.Adam(module.parameters(), 3e-3)
    errors = []
    for _ in range(40):
        optimizer.zero_grad()
        terms = module.loss_terms(batch)
        terms["loss"].backward()
        optimizer.step()
        errors.append(float(terms["error_mm"].detach()))
    assert errors[-1] < 0.5 * errors[0]


@pytest.mark.usefixtures("single_precision")
def test_scenes_without_truth_teach_by_physics_alone(batch):
    torch.manual_seed(0)
    unlabelled = batch._replace(x=torch.full_like(batch.x, torch.nan), v=torch.full_like(batch.v, torch.nan))
    module = PoseTraining(PoseEstimator(SMALL), PoseLossWeights(physics=1.0))
    terms = module.loss_terms(unlabelled)
    assert float(terms["loss"].detach()) == pytest.approx(float(terms["physics"].detach()), rel=1e-6)
    terms["loss"].backward()
    gradient = module.network.to_correction[-1].weight.grad
    assert bool(gradient.isfinite().all())
    assert float(gradient.norm()) > 0


def test_a_recording_becomes_training_data_without_truth(tmp_path):
    """Its clouds are near its own first shape."""
    recording = recordings.read(Path(tc.__file__).with_name("examples") / "bimanual_swing")
    recording = replace(recording, points=recording.points.select(slice(0, 4)))
    assert write_unlabelled(tmp_path, [recording]) == 4
    sample = PoseDataset(tmp_path)[0]
    assert bool(np.isnan(sample.x).all())
    assert np.isfinite(sample.next_times).all()
    x = torch.as_tensor(recording.cloth.initial_vertices)
    fabric, physics = torch.as_tensor(sample.fabric).double(), PhysicsLoss()
    right, wrong = (float(physics.distance_ahead(x + shift, 0 * x, fabric, sample)) for shift in (0.0, 0.02))
    assert right < 4e-3
    assert wrong > 3 * right


def test_gradients_of_the_physics_agree_with_finite_differences(batch):
    """By positions, velocities and fabric of a scene that is simulated onward."""
    sample = batch.samples[0]
    count, physics = len(sample.rest), PhysicsLoss()
    generator = torch.Generator().manual_seed(1)
    # off the surface by a millimetre or two, smoothly: no point changes its triangle within the step
    x = batch.x[0, :count].double() + 0.002
    values = [x, batch.v[0, :count].double(), batch.fabric[0].double()]
    directions = [torch.randn(value.shape, generator=generator).double() for value in values]
    leaves = [value.clone().requires_grad_() for value in values]
    gradients = torch.autograd.grad(physics.distance_ahead(*leaves, sample), leaves)
    for k, (gradient, direction) in enumerate(zip(gradients, directions, strict=True)):
        ends = []
        for sign in (1, -1):
            moved = [
                v + sign * STEP * d if j == k else v for j, (v, d) in enumerate(zip(values, directions, strict=True))
            ]
            with torch.no_grad():
                ends.append(float(physics.distance_ahead(*moved, sample)))
        expected = (ends[0] - ends[1]) / (2 * STEP)
        assert float((gradient * direction).sum()) == pytest.approx(expected, rel=1e-3), k


def test_the_truth_predicts_the_next_clouds_better_than_a_wrong_velocity(batch):
    physics = PhysicsLoss(len(batch.x))
    x, v, fabric = batch.x.double(), batch.v.double(), batch.fabric.double()
    right = float(physics(x, v, fabric, batch))
    wrong = float(physics(x, v + 0.5, fabric, batch))
    assert right < 0.8 * wrong


@pytest.mark.usefixtures("single_precision")
def test_the_calibration_makes_the_intervals_hold_the_truth(folder):
    """Of an untrained network, whose standard deviations mean nothing before."""
    torch.manual_seed(0)
    network = PoseEstimator(SMALL)
    report = evaluate(network, folder)
    assert report["held_out"]["all"]["samples"] > 20
    assert report["held_out"]["all"]["coverage"] == pytest.approx(0.95, abs=0.03)


@pytest.mark.usefixtures("single_precision")
def test_the_command_trains_resumes_and_writes_weights(folder, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(train, "CHECKPOINT_PERIOD_STEPS", 2)
    arguments = ["--data", str(folder), "--held-out", str(folder), "--out", str(tmp_path), "--batch", "4"]
    assert main([*arguments, "--steps", "4", "--physics-steps", "2", "--width", "16"]) == 0
    assert "held out" in capsys.readouterr().out
    assert load_network(tmp_path / "pose_network.safetensors").description["width"] == 16
    assert json.loads((tmp_path / "training.json").read_text())["plan"]["steps"] == 4
    assert main([*arguments, "--steps", "4"]) == 2
    assert "--resume" in capsys.readouterr().err
    assert main([*arguments, "--steps", "6", "--width", "16", "--resume"]) == 0


@pytest.mark.slow
def test_two_processes_train_one_network(folder, tmp_path):
    """By Lightning's DDP; each takes every other batch."""
    command = [sys.executable, "-m", "torchcloth.training.pose", "--data", str(folder), "--held-out", str(folder)]
    command += ["--out", str(tmp_path), "--batch", "4", "--steps", "4", "--width", "16", "--processes", "2"]
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "OMP_NUM_THREADS": "1"})
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("held out") == 1
    assert load_network(tmp_path / "pose_network.safetensors").description["width"] == 16


@pytest.mark.parametrize(
    ("option", "expected"),
    [
        (["--steps", "-1"], "--steps"),
        (["--processes", "0"], "--processes"),
        (["--data", "none"], "data"),
        (["--processes", "2", "--physics-steps", "1"], "one of them"),
    ],
)
def test_wrong_input_is_one_line(tmp_path, capsys, option, expected):
    assert main(["--out", str(tmp_path / "out"), "--held-out", str(tmp_path), *option]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert expected in error
