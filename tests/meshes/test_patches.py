"""Patches that end where they are said to."""

import numpy as np
import pytest

from torchcloth.meshes import Mesh, rectangle, topology
from torchcloth.meshes.mesh import signed_area
from torchcloth.meshes.patches import Patch, fit_to_patches

SIDE, EDGE = 0.3, 0.025
CORNERS = ([[0.0, SIDE]], [[SIDE, SIDE]])


@pytest.fixture(scope="module")
def sheet():
    return rectangle(SIDE, SIDE, triangles=288)


def at(centres, radius):
    return [Patch(np.array(c), radius) for c in centres]


def far(patch, uv):
    return np.linalg.norm(patch.offset_from_centre(uv), axis=1)


def check(mesh, uv, patches, notches=0):
    """No edge crosses, but for so many; the outline stays, no triangle is flat."""
    ends, _ = topology.find_edges(mesh.faces)
    for patch in patches:
        d = far(patch, uv)
        inside = d <= patch.radius * (1 + 1e-9)
        leaving = inside[ends[:, 0]] != inside[ends[:, 1]]
        assert leaving.any()
        crossing = d[ends[leaving]].min(1) < patch.radius * (1 - 1e-12)
        assert crossing.sum() <= notches
    after, before = signed_area(uv[mesh.faces]), signed_area(mesh.uv[mesh.faces])
    assert after.sum() == pytest.approx(before.sum(), rel=1e-12)
    assert (after / before).min() > 0.25
    Mesh.build(np.column_stack([uv, np.zeros(len(uv))]), mesh.faces, uv)


@pytest.mark.parametrize("radius", [0.015, 0.02, 0.03, 0.036, 0.04, 0.049, 0.0505, 0.061])
def test_at_corners_of_the_cloth(sheet, radius):
    patches = at(CORNERS, radius)
    check(sheet, fit_to_patches(sheet, patches), patches)


@pytest.mark.parametrize("centre", [(0.11, 0.3), (0.13, 0.16), (0.2, 0.21)])
def test_along_the_rim_and_within_the_cloth(sheet, centre):
    patches = at([[centre]], 0.037)
    check(sheet, fit_to_patches(sheet, patches), patches)


def test_on_triangles_of_any_shape(sheet):
    rng = np.random.default_rng(0)
    rim = np.unique(sheet.boundary_edges)
    uv = sheet.uv + rng.uniform(-0.2 * EDGE, 0.2 * EDGE, sheet.uv.shape)
    uv[rim] = sheet.uv[rim]
    bent = Mesh.build(np.column_stack([uv, np.zeros(len(uv))]), sheet.faces, uv)
    patches = at(CORNERS, 0.043)
    check(bent, fit_to_patches(bent, patches), patches, notches=1)


def test_a_patch_of_several_points_is_all_that_is_near_one_of_them(sheet):
    patch = Patch(np.array([[0.0, SIDE], [0.06, SIDE]]), 0.04)
    uv = fit_to_patches(sheet, [patch])
    check(sheet, uv, [patch], notches=1)
    rim = uv[uv[:, 1] == SIDE]
    assert rim[far(patch, rim) <= 0.04 * (1 + 1e-9), 0].max() == pytest.approx(0.1)


def test_what_the_mesh_cannot_resolve_stays(sheet):
    np.testing.assert_array_equal(fit_to_patches(sheet, at(CORNERS, 0.3 * EDGE)), sheet.uv)


def test_the_next_finer_mesh_holds_the_same_material(sheet):
    """Else the difference between both would be a cause."""
    patches = at(CORNERS, 0.04)
    uv = fit_to_patches(sheet, patches)
    middles = uv[topology.find_edges(sheet.faces)[0]].mean(1)
    for patch in patches:
        inside = far(patch, uv) <= patch.radius * (1 + 1e-9)
        ends = topology.find_edges(sheet.faces)[0]
        between = far(patch, middles) <= patch.radius * (1 + 1e-9)
        np.testing.assert_array_equal(between, inside[ends].all(1))


def test_patches_with_hardly_any_cloth_between_flip_no_triangle(sheet):
    uv = fit_to_patches(sheet, at([[[0.1, 0.15]], [[0.2, 0.15]]], 0.0495))
    ratio = signed_area(uv[sheet.faces]) / signed_area(sheet.uv[sheet.faces])
    assert ratio.min() >= 0.25
