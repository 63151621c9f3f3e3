"""Rigidity of hinges against dihedral angles of meshes that are rolled up."""

import numpy as np
import pytest

import torchcloth as tc
from torchcloth.export.hinges import DIRECTION_COUNT, find_hinges

RADIUS_M = 50.0


def roll(rest, direction):
    """Vertices of a flat sheet rolled around a cylinder, whose curvature is along a direction."""
    along = np.array([np.cos(direction), np.sin(direction)])
    s, axis = rest[:, :2] @ along, rest[:, :2] @ [-along[1], along[0]]
    frame = np.array([[*along, 0], [-along[1], along[0], 0], [0, 0, 1]])
    angle = s / RADIUS_M
    return np.column_stack([RADIUS_M * np.sin(angle), axis, RADIUS_M * (1 - np.cos(angle))]) @ frame


def dihedral_angles(x, vertices):
    a, b, c, d = (x[vertices[:, k]] for k in range(4))
    first, second = np.cross(b - a, c - a), np.cross(d - a, b - a)
    sine = np.linalg.norm(np.cross(first, second), axis=1)
    return np.arctan2(sine, (first * second).sum(1))


@pytest.fixture
def sheet():
    mesh = tc.meshes.rectangle(0.3, 0.2, resolution=(7, 6))
    rest = np.column_stack([mesh.uv, np.zeros(len(mesh.uv))])
    inner = (rest[:, 0] % 0.3 > 1e-9) & (rest[:, 1] % 0.2 > 1e-9)
    rest[inner, :2] += 0.004 * np.random.default_rng(0).standard_normal((int(inner.sum()), 2))
    return rest, mesh.faces


@pytest.mark.parametrize("k", [0, 5, 12, 19])
def test_angles_are_those_of_a_rolled_sheet(sheet, k):
    hinges = find_hinges(*sheet)
    angles = dihedral_angles(roll(sheet[0], np.pi * k / DIRECTION_COUNT), hinges.vertices)
    np.testing.assert_allclose(angles * RADIUS_M, np.abs(hinges.bend[:, k]), rtol=1e-4, atol=1e-6)


def test_hinges_of_a_strip_have_their_textbook_stiffness():
    """Bars of length h that are joined by hinges of stiffness w per width b bend like a plate of rigidity w h / b."""
    mesh = tc.meshes.rectangle(1.0, 0.1, resolution=(21, 2))
    hinges = find_hinges(np.column_stack([mesh.uv, np.zeros(len(mesh.uv))]), mesh.faces)
    across = np.isclose(hinges.length, 0.1)
    np.testing.assert_allclose(np.abs(hinges.bend[across, 0]), 0.05, rtol=1e-9)


def test_equilateral_triangles_bend_like_a_plate_by_length_squared_over_area():
    i, j = np.divmod(np.arange(144), 12)
    rest = np.column_stack([j + 0.5 * i, i * 3**0.5 / 2, 0 * i]) * 0.02
    a = np.arange(144)[(i < 11) & (j < 11)]
    faces = np.concatenate([np.column_stack([a, a + 1, a + 12]), np.column_stack([a + 1, a + 13, a + 12])])
    hinges = find_hinges(rest, faces)
    rigidity = hinges.rigidity(hinges.length**2 / hinges.area)
    assert rigidity.mean() == pytest.approx(1.0)
    assert np.ptp(rigidity) < 0.12  # only the rim tells directions apart


def test_folds_of_the_rest_shape_do_not_change_the_mean(sheet):
    rest, faces = sheet
    hinges = find_hinges(rest, faces)
    folded = find_hinges(roll(rest, 0.0), faces)
    weight = hinges.length**2 / hinges.area
    assert folded.rigidity(weight).mean() == pytest.approx(hinges.rigidity(weight).mean(), rel=1e-4)
