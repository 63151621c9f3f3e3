from types import SimpleNamespace

import numpy as np
import pytest

from torchcloth.errors import InvalidInput
from torchcloth.observe import build_solid_mesh, build_solid_meshes


@pytest.mark.parametrize(("pose", "at"), [(np.tile(np.eye(4), (4, 1, 1)), None), (np.eye(4), 0)])
def test_poses_of_many_moments_need_one_of_them(pose, at):
    with pytest.raises(
        InvalidInput, match=r"pose; got shape .*; expected \[4, 4\] at one time; for several times: .*at=k"
    ):
        build_solid_meshes([SimpleNamespace(kind="sphere", size=(0.1,), pose=pose)], at)


def volume(vertices, faces):
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6


@pytest.mark.parametrize(
    ("kind", "size", "expected"),
    [
        ("box", (0.1, 0.2, 0.3), 0.006),
        ("cylinder", (0.1, 0.5), np.pi * 0.01 * 0.5),
        ("sphere", (0.2,), 4 / 3 * np.pi * 0.008),
    ],
)
def test_volume_and_place(kind, size, expected):
    pose = np.eye(4)
    pose[:3, :3] = np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]])
    pose[:3, 3] = 1.0, 2.0, 3.0
    vertices, faces = build_solid_mesh(kind, size, pose, segments=96)
    # outward faces give a positive volume; 96 corners lose 0.2 %
    assert volume(vertices, faces) == pytest.approx(expected, rel=0.004)
    np.testing.assert_allclose((vertices.min(0) + vertices.max(0)) / 2, [1, 2, 3], atol=1e-3)


@pytest.mark.parametrize("segments", [3, 4, 5, 24, 96])
def test_a_sphere_lies_within_the_true_one_by_no_more_than_stated(segments):
    vertices, faces = build_solid_mesh("sphere", (0.1,), np.eye(4), segments=segments)
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal = normal[np.linalg.norm(normal, axis=1) > 1e-12]
    places = np.random.default_rng(0).dirichlet(np.ones(3), 200) @ corners  # [F, 200, 3]
    depth = 0.1 - np.linalg.norm(places, axis=-1)
    assert len(normal) >= 2 * segments
    assert depth.min() > -1e-12
    assert depth.max() < 2.05 * 0.1 * (1 - np.cos(np.pi / segments))


def test_the_cylinder_s_axis_is_z():
    vertices, _ = build_solid_mesh("cylinder", (0.1, 0.5), np.eye(4))
    np.testing.assert_allclose(np.ptp(vertices, axis=0), [0.2, 0.2, 0.5], atol=1e-3)


@pytest.mark.parametrize(
    ("kind", "size"), [("capsule", (1.0, 1.0)), ("box", (1.0,)), ("sphere", (-1.0,)), ("sphere", (np.nan,))]
)
def test_unknown_or_impossible_solids_are_refused(kind, size):
    with pytest.raises(InvalidInput):
        build_solid_mesh(kind, size, np.eye(4))


def test_an_arm_without_solids_is_named():
    with pytest.warns(UserWarning, match="no solid: an arm without solids hides nothing, .* it is taken for cloth"):
        assert build_solid_meshes([]) == []
