"""The OBJ subset: what other programs export is read, what is written reads back exactly."""

from __future__ import annotations

import numpy as np
import pytest

from torchcloth.recordings import obj


def test_quads_comments_and_negative_indices():
    text = "o sheet\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0 # corner\nvn 0 0 1\nusemtl x\nf -4//1 -3//1 -2//1 -1//1\n"
    vertices, faces, uv = obj.parse(text, "cloth.obj")
    assert vertices.shape == (4, 3)
    assert faces.tolist() == [[0, 1, 2], [0, 2, 3]]
    assert uv is None


def test_vt_follows_its_vertex():
    text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 9\nvt 9 0\nvt 0 0\nf 1/3/1 2/2/1 3/1/1\n"
    _, _, uv = obj.parse(text, "cloth.obj")
    assert uv is not None
    assert uv.tolist() == [[0, 0], [9, 0], [0, 9]]


@pytest.mark.parametrize("with_uv", [True, False])
def test_round_trip_is_exact(with_uv):
    rng = np.random.default_rng(0)
    vertices, faces = rng.normal(size=(5, 3)), np.array([[0, 1, 2], [2, 3, 4]])
    uv = rng.normal(size=(5, 2)) * 1e-7 if with_uv else None
    back = obj.parse(obj.dump(vertices, faces, uv), "cloth.obj")
    for a, b in zip((vertices, faces, uv), back, strict=True):
        np.testing.assert_array_equal(a, b)
