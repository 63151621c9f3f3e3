"""Stamps that scatter: the times of frames, the scatter, and the weight that is left to every other unknown."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import torchcloth as tc
from torchcloth.episodes.observed import Episode
from torchcloth.episodes.observed_surface import build_surface
from torchcloth.episodes.replay import Frames
from torchcloth.identification.estimators.frame_times import FrameTimes, RowNoise, Scene, estimate_stamp_std
from torchcloth.identification.nuisances import StampJitter, select_nuisances
from torchcloth.identification.residuals.blocks import select_blocks

PERIOD_S, STROKE_M, DURATION_S, FRAME_COUNT, NOISE_M = 0.8, 0.15, 1.6, 49, 2e-3
NOISE = {name: RowNoise(NOISE_M, 0.5, 15.0) for name in ("points", "edges", "markers", "force", "torque")}


def stroke(t):
    """Place and speed of a sheet that swings along its normal."""
    phase = 2 * np.pi * t / PERIOD_S
    return STROKE_M * np.sin(phase), STROKE_M * 2 * np.pi / PERIOD_S * np.cos(phase)


def make_scene(stamp_errors, noise=NOISE_M):
    """Return the simulated frames of a rigid sheet at their stamps, and clouds of it at stamps plus errors."""
    generator = np.random.default_rng(3)
    cloth = tc.Cloth(tc.meshes.rectangle(0.3, 0.2, resolution=(5, 4)), tc.materials.AEP(1e5, 0.3), 0.2, contact=None)
    rest = torch.as_tensor(cloth.mesh.vertices, dtype=torch.float64)
    times = torch.linspace(0, DURATION_S, FRAME_COUNT, dtype=torch.float64)
    normal = torch.tensor([0.0, 0.0, 1.0])
    place, speed = (torch.as_tensor(p)[:, None, None] * normal for p in stroke(times.numpy()))
    frames = Frames(rest + place, speed.expand(-1, len(rest), 3), {}, times.new_zeros(FRAME_COUNT))
    seen = torch.as_tensor(stroke(times.numpy() + stamp_errors)[0])
    clouds = []
    for z in seen:
        xy = torch.as_tensor(generator.uniform([0.02, 0.02], [0.28, 0.18], (60, 2)))
        clouds.append(torch.cat([xy, z + torch.as_tensor(noise * generator.standard_normal((60, 1)))], 1))
    episode = Episode("swing", {}, times, clouds, rest, False, None)
    return frames, Scene(episode, build_surface(cloth, [episode]), select_blocks(["points"]))


def draw_errors(std):
    return std * np.random.default_rng(6).standard_normal(FRAME_COUNT)


@pytest.fixture(autouse=True)
def float64():
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(before)


def test_each_frame_gets_its_time():
    errors = draw_errors(0.025)
    frames, scene = make_scene(errors)
    shifts = FrameTimes(0.025, NOISE).find_shifts(frames, scene).numpy()
    fast = np.abs(stroke(scene.episode.times.numpy())[1]) > 0.5
    fast[[0, -1]] = False  # the first frame is where the simulation starts; beyond the last there is none
    assert fast.sum() > 20
    assert np.abs(shifts - errors)[fast].max() < 3e-3


def test_where_nothing_moves_the_stamp_counts():
    frames, scene = make_scene(np.zeros(FRAME_COUNT))
    still = frames._replace(v=torch.zeros_like(frames.v), x=frames.x[:1].expand_as(frames.x))
    assert float(FrameTimes(0.025, NOISE).find_shifts(still, scene).abs().max()) == 0.0


def test_the_scatter_comes_from_the_data():
    stds = [
        estimate_stamp_std(FrameTimes(0.0, NOISE), *([part] for part in make_scene(draw_errors(s))))
        for s in (0.01, 0.03)
    ]
    np.testing.assert_allclose(stds, [0.01, 0.03], rtol=0.25)


@pytest.mark.parametrize("errors", [np.zeros(FRAME_COUNT), 0.02 * np.sin(np.linspace(0, 6, FRAME_COUNT))])
def test_exact_stamps_and_a_wrong_model_show_no_scatter(errors):
    """A wrong model moves neighbouring frames alike."""
    frames, scene = make_scene(errors)
    assert estimate_stamp_std(FrameTimes(0.0, NOISE), [frames], [scene]) == 0.0


def test_slopes_are_those_of_generalised_least_squares():
    frames, scene = make_scene(draw_errors(0.02))
    times, count = FrameTimes(0.02, NOISE), 3
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(count, *frames.x.shape, generator=generator)
    derivatives = Frames(x, torch.zeros_like(x), {}, x.new_zeros(count, FRAME_COUNT))
    exact, projected = (t.project(frames, derivatives, scene)["points"] for t in (replace(times, std=0.0), times))
    slope = replace(times, std=0.0).project(
        frames, Frames(frames.v[None], x[:1] * 0, {}, x.new_zeros(1, FRAME_COUNT)), scene
    )
    slope = slope["points"].jacobian[:, 0]
    weight = NOISE["points"].weights(exact.residual)
    expected = exact.jacobian.mT @ (weight[:, None] * exact.jacobian)
    for t in range(1, FRAME_COUNT):
        rows = exact.frame == t
        c, w, jacobian = slope[rows], weight[rows], exact.jacobian[rows]
        common = (w * c) @ jacobian
        expected -= torch.outer(common, common) / (times.std**-2 + (w * c * c).sum())
    torch.testing.assert_close(projected.jacobian.mT @ (weight[:, None] * projected.jacobian), expected)


def test_jitter_is_a_nuisance_without_numbers():
    (estimated,), (stated,) = select_nuisances(["jitter"]), select_nuisances({"jitter": 0.02})
    assert isinstance(estimated, StampJitter)
    assert (estimated.is_estimated, stated.is_estimated, stated.std) == (True, False, 0.02)
