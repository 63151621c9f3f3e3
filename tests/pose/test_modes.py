"""Smooth fields over a cloth, against the closed form for a rectangle, and over a seam."""

import math

import numpy as np
import pytest
import torch

import torchcloth as tc
from torchcloth.errors import InvalidInput
from torchcloth.pose.fine_scale_uncertainty import _build_basis
from torchcloth.pose.modes import Modes, compute_modes


def test_a_rectangle_has_cosines():
    mesh = tc.meshes.rectangle(0.6, 0.4, resolution=(31, 21))
    modes = compute_modes(mesh, 4)
    exact = [0.0, math.pi / 0.6, math.pi / 0.4, math.hypot(math.pi / 0.6, math.pi / 0.4)]
    torch.testing.assert_close(modes.wave_numbers, torch.tensor(exact), rtol=0.005, atol=0)
    shape = torch.cos(math.pi * torch.as_tensor(mesh.uv)[:, 0] / 0.6)
    assert abs(float(torch.corrcoef(torch.stack([modes.fields[1], shape]))[0, 1])) > 0.999


def test_unit_mean_square_and_orthogonal():
    mesh = tc.meshes.shirt(triangles=240)
    modes = compute_modes(mesh, 8)
    share = torch.as_tensor(mesh.vertex_area)
    product = (modes.fields * share) @ modes.fields.mT / share.sum()
    torch.testing.assert_close(product, torch.eye(8), rtol=0, atol=1e-8)
    torch.testing.assert_close(modes.fields[0], torch.ones(len(mesh.vertices)), rtol=0, atol=1e-6)


def test_every_mode_of_a_mesh():
    mesh = tc.meshes.rectangle(0.3, 0.3, resolution=(4, 4))
    assert compute_modes(mesh).fields.shape == (16, 16)


@pytest.mark.parametrize("count", [0, 17])
def test_too_many(count):
    with pytest.raises(InvalidInput, match="modes"):
        compute_modes(tc.meshes.rectangle(0.3, 0.3, resolution=(4, 4)), count)


@pytest.mark.parametrize(("size", "informed"), [((0.3, 0.3), [2, 5, 7]), ((0.3, 0.2), [])])
def test_modes_that_symmetry_makes_equal_are_not_divided_silently(size, informed):
    modes = compute_modes(tc.meshes.rectangle(*size, resolution=(8, 8)))
    assert [count for count in range(1, 9) if modes.truncation_warnings(count)] == informed
    assert "take 1 or 3" in compute_modes(tc.meshes.rectangle(0.3, 0.3, resolution=(8, 8))).truncation_warnings(2)[0]


def test_a_cloth_in_two_pieces_has_two_constant_modes():
    modes = Modes(torch.zeros(3, 4), torch.tensor([0.0, 0.0, 2.0]))
    assert modes.truncation_warnings(1)[0].endswith("take 2")
    assert not modes.truncation_warnings(2)


def two_sheets():
    """One cloth of two pieces, side by side."""
    one = tc.meshes.rectangle(0.2, 0.1, resolution=(5, 4))
    both = [one.vertices, np.add(one.vertices, [0.3, 0.0, 0.0])]
    faces = np.concatenate([one.faces, one.faces + len(one.vertices)])
    return tc.meshes.Mesh.build(np.concatenate(both), faces, np.concatenate(both)[:, :2])


def test_so_have_two_sheets_and_what_is_left_of_one_mode_is_no_less_than_of_one_sheet():
    """The field beyond the forces' mode vanishes on four held vertices, not everywhere."""
    modes = compute_modes(two_sheets())
    assert modes.wave_numbers[:2].tolist() == [0.0, 0.0]
    assert modes.truncation_warnings(1)
    gripped = torch.tensor([0, 1, 20, 21])
    basis = _build_basis(modes, 1, gripped)
    assert len(basis) > 4
    torch.testing.assert_close(basis.square().sum(0).mean(), torch.ones(()), rtol=0, atol=1e-9)
    assert float(basis[:, gripped].abs().max()) < 1e-9
