"""Figures, robust weights, patches, and the null, against closed forms."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

import torchcloth as tc
from torchcloth.episodes.observed import Episode
from torchcloth.episodes.observed_surface import (
    build_rim,
    build_surface_of_mesh,
    compute_pattern_fractions,
    error_group_at,
)
from torchcloth.identification.residuals.metrics import HUBER_THRESHOLD, distance_metrics, huber, noise_scale
from torchcloth.identification.residuals.rigid_carry import carry_rigidly
from torchcloth.identification.uncertainty.richardson import refine_cloth


def seen(clouds: list[Tensor], motion=None, initial=None) -> Episode:
    initial = torch.zeros(4, 3) if initial is None else initial
    return Episode("fake", motion or {}, torch.arange(len(clouds)) * 0.1, clouds, initial, True, 1e-3)


def test_figures_of_points_at_known_heights():
    mesh = tc.meshes.rectangle(1.0, 1.0, resolution=(3, 3))
    flat = torch.as_tensor(mesh.vertices)
    inside = torch.tensor([[0.2, 0.3, 0.0], [0.6, 0.7, 0.0], [0.5, 0.1, 0.0]])
    up = torch.tensor([0.0, 0.0, 1.0])
    clouds = [inside + 0.01 * up, inside[:1] - 0.04 * up]
    frames = flat.expand(2, -1, -1)
    now = distance_metrics([frames], [seen(clouds)], torch.as_tensor(mesh.faces))
    torch.testing.assert_close(now.per_frame, torch.tensor([0.01, 0.04]))
    assert now.chamfer == pytest.approx(0.025)  # mean over frames, whatever their numbers of points
    assert now.rms == pytest.approx(math.sqrt((3 * 0.01**2 + 0.04**2) / 4))  # over all points


def test_figures_of_two_episodes_count_every_frame_once():
    mesh = tc.meshes.rectangle(1.0, 1.0, resolution=(2, 2))
    flat, up = torch.as_tensor(mesh.vertices), torch.tensor([0.0, 0.0, 1.0])
    point = torch.tensor([[0.5, 0.4, 0.0]])
    one, three = seen([point + 0.01 * up]), seen([point + 0.05 * up] * 3)
    now = distance_metrics([flat.expand(1, -1, -1), flat.expand(3, -1, -1)], [one, three], torch.as_tensor(mesh.faces))
    assert now.chamfer == pytest.approx((0.01 + 3 * 0.05) / 4)


def test_huber_is_quadratic_then_linear_and_smooth_between():
    z = torch.linspace(-5, 5, 101, requires_grad=True)
    loss, weight = huber(z)
    (slope,) = torch.autograd.grad(loss.sum(), z)
    torch.testing.assert_close(slope, weight * z)  # what iteratively reweighted least squares assumes
    assert torch.equal(weight[z.abs() <= HUBER_THRESHOLD], torch.ones(int((z.abs() <= HUBER_THRESHOLD).sum())))
    far = z.abs() > HUBER_THRESHOLD
    torch.testing.assert_close(slope[far], HUBER_THRESHOLD * z[far].sign())
    assert float(huber(torch.tensor(HUBER_THRESHOLD * (1 + 1e-9)))[0]) == pytest.approx(0.5 * HUBER_THRESHOLD**2)


def test_noise_scale_is_robust_and_never_below_the_sensor():
    noise = 2e-3 * torch.randn(20_000, generator=torch.Generator().manual_seed(0))
    assert noise_scale(noise, None) == pytest.approx(2e-3, rel=0.05)
    spoilt = noise.clone()
    spoilt[:2000] = 1.0  # 10 % outliers raise a median by a fifth of a standard deviation
    assert noise_scale(spoilt, None) < 2.5e-3
    assert noise_scale(noise, 5e-3) == 5e-3
    assert noise_scale(torch.cat([noise, torch.zeros(20_000)]), None) == noise_scale(noise, None)  # unused rows
    assert noise_scale(torch.zeros(5), None) > 0  # a perfect fit must not divide by zero


def patches(mesh):
    return error_group_at(compute_pattern_fractions(mesh))


def test_patches_cover_the_fabric_in_equal_parts():
    mesh = tc.meshes.rectangle(0.4, 0.2, resolution=(17, 17))
    patch, u = patches(mesh), torch.as_tensor(mesh.uv)
    assert patch.shape == (17 * 17,)
    assert set(patch.tolist()) == set(range(16))
    assert int(torch.bincount(patch).min()) >= 16  # 17 = 4 + 4 + 4 + 5
    for p in range(16):  # patches are compact: an eighth of them would not pass as one observation otherwise
        extent = u[patch == p].amax(0) - u[patch == p].amin(0)
        assert float(extent[0]) <= 0.11
        assert float(extent[1]) <= 0.06


@pytest.mark.parametrize("side", [0.2, 0.3, 0.35, 0.6])
@pytest.mark.parametrize("resolution", [9, pytest.param(13, marks=pytest.mark.slow)])
@pytest.mark.parametrize("patterned", [True, False])
def test_parts_and_rim_are_the_same_on_a_finer_mesh(side, resolution, patterned):
    """Squares, of which no axis is the longer one, and pieces of the rim that are shorter than a coarse edge."""
    coarse = tc.meshes.rectangle(side, side, resolution=(resolution, resolution))
    coarse = tc.meshes.Mesh.build(coarse.vertices, coarse.faces, coarse.uv if patterned else None)
    cloth = tc.Cloth(coarse, tc.materials.AEP(1e5, 0.3, thickness=1e-3), 0.2)
    fine = refine_cloth(cloth).mesh
    assert torch.equal(patches(fine)[: len(coarse.vertices)], patches(coarse))
    a, b, c = torch.as_tensor(coarse.faces).T
    inside = torch.tensor([0.6, 0.3, 0.1]).expand(len(a), 3)
    place = (inside[:, :, None] * torch.as_tensor(coarse.vertices)[torch.stack([a, b, c], 1)].to(inside)).sum(1)
    every = (4 * place[:, :2] / side).long()
    assert torch.equal(
        build_surface_of_mesh(coarse).error_groups_at(torch.stack([a, b, c], 1), inside), 4 * every[:, 0] + every[:, 1]
    )
    length = side / 10
    middles = []
    for mesh in (coarse, fine):
        rim = build_rim(mesh, None, length)
        x = torch.as_tensor(mesh.vertices)
        centre = 0.5 * (x[rim.edges[:, 0]] + x[rim.edges[:, 1]])
        places = [centre[rim.piece == k].mean(0) for k in range(rim.piece_count)]
        middles.append(dict(zip(rim.labels.tolist(), places, strict=True)))
    one, other = middles
    assert len(other) >= len(one) > 20
    assert all(float((one[k] - other[k]).norm()) < side / (resolution - 1) for k in one)


def test_a_closed_surface_has_no_rim():
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    mesh = tc.meshes.Mesh.build(0.1 * corners, np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]))
    assert build_rim(mesh, None, 0.01).piece_count == 0


def turned(angle: float, axis=(0.3, -0.5, 0.8)) -> Tensor:
    axis = torch.tensor(axis) / torch.tensor(axis).norm()
    skew = torch.linalg.cross(axis.expand(3, 3), torch.eye(3)).mT
    return torch.linalg.matrix_exp(angle * skew)


def rigid(count: int, grips: Tensor) -> tuple[Tensor, Tensor, dict[str, tc.Trajectory]]:
    """A body that turns by 2 rad while it travels, and grippers on it [G, 3]."""
    t = torch.linspace(0.0, 1.0, count)
    rotation = torch.stack([turned(2.0 * float(s)) for s in t])
    shift = torch.stack([t, 0.3 * torch.sin(3 * t), -(t**2)], dim=-1)
    motion = {}
    for g, grip in enumerate(grips):
        pose = torch.eye(4).repeat(count, 1, 1)
        pose[:, :3, :3] = rotation @ turned(0.4 * g, (1.0, 2.0, 3.0))
        pose[:, :3, 3] = (rotation @ grip) + shift
        motion[f"g{g}"] = tc.Trajectory(t, pose, torch.ones(count, dtype=torch.bool))
    return rotation, shift, motion


@pytest.mark.parametrize("grippers", [1, 2, 3])
def test_rigid_carry_reproduces_a_rigid_motion(grippers):
    """To rounding, with one gripper (orientation matters), two, and three; frames at the knots: no interpolation."""
    generator = torch.Generator().manual_seed(0)
    count, shape = 21, torch.randn(7, 3, generator=generator)
    rotation, shift, motion = rigid(count, torch.randn(grippers, 3, generator=generator))
    episode = seen([torch.zeros(1, 3)] * count, motion, shape)
    episode = Episode(**{**vars(episode), "times": torch.linspace(0.0, 1.0, count)})
    carried = carry_rigidly(episode)
    torch.testing.assert_close(carried, shape @ rotation.mT + shift[:, None], rtol=0, atol=1e-9)
    torch.testing.assert_close(carried[0], shape, rtol=0, atol=1e-9)


def test_rigid_carry_without_grippers_leaves_the_cloth_where_it_is():
    shape = torch.randn(5, 3, generator=torch.Generator().manual_seed(0))
    assert torch.equal(carry_rigidly(seen([torch.zeros(1, 3)] * 3, {}, shape)), shape.expand(3, -1, -1))


def test_rigid_carry_of_grippers_that_part_is_the_best_rigid_motion():
    """Two grippers that move apart in opposite directions: the best rigid motion stays."""
    t = torch.linspace(0.0, 1.0, 5)
    motion = {}
    for name, sign in (("left", -1.0), ("right", 1.0)):
        pose = torch.eye(4).repeat(5, 1, 1)
        pose[:, 0, 3] = sign * (0.1 + 0.02 * t)
        motion[name] = tc.Trajectory(t, pose, torch.ones(5, dtype=torch.bool))
    shape = torch.randn(5, 3, generator=torch.Generator().manual_seed(0))
    episode = Episode(**{**vars(seen([torch.zeros(1, 3)] * 5, motion, shape)), "times": t})
    torch.testing.assert_close(carry_rigidly(episode), shape.expand(5, -1, -1), rtol=0, atol=1e-12)
