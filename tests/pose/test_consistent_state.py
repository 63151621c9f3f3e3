"""The nearest state in which a sheet hardly stretches."""

import pytest
import torch

from torchcloth.meshes import rectangle
from torchcloth.pose.consistent_state import make_consistent

SIDE_M, NOISE_STD_M, SPEED_NOISE_STD_M_PER_S = 0.3, 8e-3, 0.2
NO_POINTS = torch.zeros(0, 3)


@pytest.fixture
def sheet():
    """A sheet that hangs as part of a cylinder and swings about its upper edge; mesh, positions, velocities, held."""
    mesh = rectangle(SIDE_M, SIDE_M, triangles=128)
    u, v = torch.as_tensor(mesh.uv).T
    radius = 0.8
    x = torch.stack([radius * torch.sin(u / radius), radius * (1 - torch.cos(u / radius)), v], -1)
    velocity = torch.zeros_like(x)
    velocity[:, 1] = 2.0 * (SIDE_M - v)  # turns the sheet rigidly about its upper edge, to first order
    velocity[:, 2] = 2.0 * x[:, 1]
    return mesh, x, velocity, torch.nonzero(v > SIDE_M - 1e-9)[:, 0]


def rms(difference: torch.Tensor) -> float:
    return float(difference.square().sum(-1).mean().sqrt())


def test_a_state_without_stretch_stays(sheet):
    mesh, x, v, held = sheet
    seen = x[torch.as_tensor(mesh.faces)].mean(1)
    position, velocity = make_consistent(mesh, x, v, torch.full((len(x),), NOISE_STD_M), held, seen)
    assert rms(position - x) < 1e-3
    assert rms(velocity - v) < 0.02


def test_noise_is_at_least_halved_and_held_vertices_stay(sheet):
    mesh, x, v, held = sheet
    generator = torch.Generator().manual_seed(0)
    noise = NOISE_STD_M * torch.randn(x.shape, generator=generator, dtype=x.dtype)
    speed_noise = SPEED_NOISE_STD_M_PER_S * torch.randn(x.shape, generator=generator, dtype=x.dtype)
    noise[held], speed_noise[held] = 0.0, 0.0
    std = torch.full((len(x),), NOISE_STD_M)
    position, velocity = make_consistent(mesh, x + noise, v + speed_noise, std, held, NO_POINTS)
    assert rms(position - x) < 0.5 * rms(noise)
    assert rms(velocity - v) < 0.8 * rms(speed_noise)
    assert float((position - x)[held].norm(dim=-1).max()) < 1e-3
    assert float((velocity - v)[held].norm(dim=-1).max()) < 0.05


def test_points_of_the_surface_correct_a_shape_that_is_off_as_a_whole(sheet):
    mesh, x, v, held = sheet
    bulge = torch.zeros_like(x)
    bulge[:, 1] = 2 * NOISE_STD_M * (1 - torch.as_tensor(mesh.uv)[:, 1] / SIDE_M)
    seen, std = x[torch.as_tensor(mesh.faces)].mean(1), torch.full((len(x),), NOISE_STD_M)
    alone, with_points = (make_consistent(mesh, x + bulge, v, std, held, cloud)[0] for cloud in (NO_POINTS, seen))
    assert rms(alone - x) > NOISE_STD_M
    assert rms(with_points - x) < 0.25 * NOISE_STD_M


def test_the_dtype_of_an_estimate_remains(sheet):
    mesh, x, v, held = sheet
    position, velocity = make_consistent(
        mesh, x.float(), v.float(), torch.full((len(x),), NOISE_STD_M), held, NO_POINTS
    )
    assert position.dtype == velocity.dtype == torch.float32
