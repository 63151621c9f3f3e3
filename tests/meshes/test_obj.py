"""The OBJ subset: what other programs export is read, what is written reads back exactly."""

from __future__ import annotations

import numpy as np
import pytest

from torchcloth.errors import InvalidInput
from torchcloth.meshes import obj


def test_quads_comments_and_negative_indices():
    text = "o sheet\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0 # corner\nvn 0 0 1\nusemtl x\nf -4//1 -3//1 -2//1 -1//1\n"
    vertices, faces, uv = obj.parse(text, "cloth.obj")
    assert vertices.shape == (4, 3)
    assert faces.tolist() == [[0, 1, 2], [0, 2, 3]]
    assert uv is None


def test_vt_follows_its_corner():
    text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 9\nvt 9 0\nvt 0 0\nf 1/3/1 2/2/1 3/1/1\n"
    _, _, uv = obj.parse(text, "cloth.obj")
    assert uv is not None
    assert uv.tolist() == [[[0, 0], [9, 0], [0, 9]]]


@pytest.mark.parametrize("line", ["v 0 0", "vt 1"])
def test_a_line_with_too_few_numbers_is_named(line):
    with pytest.raises(InvalidInput, match=r"cloth.obj is damaged at line 1; got 'v"):
        obj.parse(line + "\nv 0.2 0 0\nv 0.2 0.2 0\nv 0 0.2 0\nf 1 2 3 4\n", "cloth.obj")


def test_lists_are_written_too():
    mesh = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], [[0, 1, 2]], [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]
    assert obj.dump(*mesh) == obj.dump(*map(np.array, mesh))


@pytest.mark.parametrize("form", ["none", "vertex", "corner"])
def test_round_trip_is_exact(form):
    rng = np.random.default_rng(0)
    vertices, faces = rng.normal(size=(5, 3)), np.array([[0, 1, 2], [2, 3, 4]])
    uv = {"none": None, "vertex": rng.normal(size=(5, 2)) * 1e-7, "corner": rng.normal(size=(2, 3, 2)) * 1e-7}[form]
    back = obj.parse(obj.dump(vertices, faces, uv), "cloth.obj")
    np.testing.assert_array_equal(back[0], vertices)
    np.testing.assert_array_equal(back[1], faces)
    if uv is None:
        assert back[2] is None
    else:
        np.testing.assert_array_equal(back[2], uv[faces] if form == "vertex" else uv)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "cloth.obj: v has the wrong shape"),
        ("v 0 0 zero", "damaged at line 1; got 'v 0 0 zero'"),
        ("v 0 0\nv 1 0 0\n", "damaged at line 1; got 'v 0 0'"),
        ("v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3", "v is not finite"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\n", "f has the wrong shape"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4", "damaged at line 4"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2\nf 1 2 3", "damaged at line 4; got 'f 1 2'; .*three vertices or more"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf\nf 1 2 3", "damaged at line 4; got 'f'"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nf 1 2 3", "a vertex in no face; got vertex 4"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0\nf 1/1 2/1 3/1", "damaged at line 4; got 'vt 0'"),
    ],
)
def test_damage_is_named(text, message):
    with pytest.raises(InvalidInput, match=message):
        obj.parse(text, "cloth.obj")


def test_a_quad_may_be_bent_and_not_be_concave():
    """By 20 degrees along its diagonal, as cloth's are; a dart is refused."""
    bent = "v 0 0 0\nv 1 0 0\nv 1 1 0.25\nv 0 1 0\nf 1 2 3 4\n"
    assert len(obj.parse(bent, "bent")[1]) == 2
    with pytest.raises(InvalidInput, match="not convex"):
        obj.parse("v 0 0 0\nv 1 0 0\nv 0.2 0.2 0\nv 0 1 0\nf 2 3 4 1\n", "dart")
