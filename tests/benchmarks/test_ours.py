"""What is timed is the right computation: gradient and tangents are derivatives of the same forward run."""

import numpy as np
import pytest
import torch

from torchcloth.benchmarks import cases, ours
from torchcloth.benchmarks.contestant import TANGENT_DIRECTIONS, Task
from torchcloth.benchmarks.ours import TorchclothContestant

STEPS = 20


def prepared(quantity, name="standard-usual", **options):
    return TorchclothContestant("reference", 1).prepare(Task(name, quantity, STEPS, small=True, **options))


def test_the_gradient_is_that_of_the_loss():
    outcome = prepared("gradient")()
    assert outcome.loss == pytest.approx(float((prepared("forward")().x ** 2).mean()), rel=1e-12)
    direction = np.random.default_rng(0).standard_normal(outcome.x.shape)
    errors = []
    for size in (4e-5, 2e-5):
        values = []
        for sign in (1, -1):
            scene = cases.build_scene(cases.make_case("standard-usual", small=True), "reference", STEPS)
            x = scene.x + sign * size * torch.as_tensor(direction)
            values.append(float((ours.end_positions(scene, x, scene.motion) ** 2).mean().detach()))
        errors.append(abs((values[0] - values[1]) / (2 * size) - (direction * outcome.gradient_x).sum()))
    assert errors[1] < 0.3 * errors[0] or errors[1] < 1e-9  # second order


def test_tangents_and_gradient_agree():
    """By Young's modulus: two modes of differentiation, one number."""
    scene = cases.build_scene(cases.make_case("standard", small=True), "reference", STEPS)
    raw = dict(scene.cloth.named_parameters())["material.youngs_modulus.raw"]
    x, tangent = ours.tangents(scene, {"material.youngs_modulus.raw": raw}, torch.ones(1, 1))
    by_raw = float((2 * x * tangent[0, -1]).mean())
    outcome = prepared("gradient", "standard")()
    assert outcome.gradient_youngs * cases.MATERIAL["youngs_modulus"] == pytest.approx(by_raw, rel=1e-8)
    assert outcome.x == pytest.approx(x.numpy(), abs=1e-12)


def test_eight_directions_of_all_frames():
    (tangent,) = prepared("tangents8", "standard-everywhere")().extra
    assert tangent.shape[0] == TANGENT_DIRECTIONS
    assert tangent.shape[1] == 2
    assert np.isfinite(tangent).all()
    assert len({float(abs(t).max()) for t in tangent}) == TANGENT_DIRECTIONS


def test_a_batch_starts_with_the_single_scene():
    assert prepared("forward", batch=3)().x == pytest.approx(prepared("forward")().x, abs=1e-12)
