"""Measures of the folding case, on sheets with constructed folds."""

import numpy as np
import pytest

import torchcloth as tc
from torchcloth.training.validation.verification import folding

MESH = tc.meshes.rectangle(folding.TOWEL_SIDE_M, folding.TOWEL_SIDE_M, resolution=(42, 42))  # no vertex on a crease


def make_stack(heights, quarter=True):
    """Return positions with every quadrant flat at its height [m], in the order that ``measure_gaps`` expects."""
    u, v = MESH.uv.T
    right, back = u > folding.TOWEL_SIDE_M / 2, quarter & (v > folding.TOWEL_SIDE_M / 2)
    place = np.where(back, 3 - right, 0 + right)
    x = np.where(right, folding.TOWEL_SIDE_M - u, u)
    y = (
        np.where(back, folding.TOWEL_SIDE_M - v, v) - 0.001 * right
    )  # the inner layers' crease lies within the outer ones'
    return np.stack([x, y, np.array(heights)[place]], -1)


@pytest.mark.parametrize("quarter", [False, True])
def test_gaps_of_flat_layers_are_exact(quarter):
    heights = (0.0, 0.004, 0.007, 0.012) if quarter else (0.0, 0.004)
    gap, wrong = folding.measure_gaps(make_stack(heights, quarter), MESH, quarter)
    assert wrong == 0
    assert len(gap) > 500
    np.testing.assert_allclose(gap, np.broadcast_to(np.diff(heights), gap.shape), atol=1e-12)


def test_swapped_and_missing_layers_are_counted():
    gap, wrong = folding.measure_gaps(make_stack((0.0, 0.008, 0.004, 0.012)), MESH, True)
    assert len(gap) == 0
    assert wrong > 500
    unfolded = folding.measure_gaps(MESH.vertices, MESH, False)
    assert len(unfolded[0]) == 0
    assert unfolded[1] > 500


def test_a_layer_that_was_pushed_through_another_crosses_it():
    x = make_stack((0.0, 0.004, 0.008, 0.012))
    assert len(folding.crossing_distances(x, MESH)) == 0
    top = np.argmin(np.linalg.norm(x - [0.1, 0.1, 0.012], axis=-1))
    x[top, 2] = 0.006  # below the third layer, above the second
    distances = folding.crossing_distances(x, MESH)
    assert len(distances) > 0
    assert distances.min() > 0.2  # top and third layer are joined at the first crease, 0.3 m away
