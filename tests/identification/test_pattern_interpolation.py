"""Values between vertices."""

import numpy as np
import pytest
import torch

from torchcloth.episodes.pattern_interpolation import interpolate_on_pattern, interpolation_weights
from torchcloth.errors import InvalidInput
from torchcloth.meshes import Mesh, rectangle

RNG = np.random.default_rng(0)


def quadratic(uv):
    u, v = uv.T
    return 3.0 + 2.0 * u - v + 5.0 * u * u - 7.0 * u * v + 2.0 * v * v


@pytest.mark.parametrize("crooked", [0.0, 5e-3])
def test_quadratics_come_out_everywhere(crooked):
    mesh = rectangle(0.3, 0.2, resolution=(9, 7))
    inside = np.isin(np.arange(len(mesh.uv)), mesh.boundary_edges, invert=True)
    uv = mesh.uv + crooked * RNG.uniform(-1, 1, mesh.uv.shape) * inside[:, None]
    mesh = Mesh.build(np.c_[uv, np.zeros(len(uv))], mesh.faces, uv)
    places = RNG.random((200, 2)) * [0.3, 0.2]
    result = interpolate_on_pattern(
        interpolation_weights(mesh, places),
        torch.as_tensor(np.stack([quadratic(uv), uv[:, 0]], 1)).expand(2, 3, -1, -1),
    )
    assert result.shape == (2, 3, 200, 2)
    np.testing.assert_allclose(result[1, 2].T, [quadratic(places), places[:, 0]], atol=1e-8)


def test_many_vertices_cost_little():
    """Most stay where they are, and have no other in their rows."""
    mesh = rectangle(0.5, 0.5, resolution=(81, 81))
    places = mesh.uv + np.where(np.linalg.norm(mesh.uv, axis=1) < 0.03, 1e-3, 0.0)[:, None]
    weights = interpolation_weights(mesh, places)
    moved = (places != mesh.uv).any(1).sum()
    assert 0 < moved < 40
    result = weights.to_dense()[(places == mesh.uv).all(1)]
    assert int((result.abs() > 1e-9).sum()) == len(mesh.uv) - moved


def test_vertices_are_what_they_are():
    mesh = rectangle(0.3, 0.2, resolution=(5, 4))
    values = RNG.standard_normal(len(mesh.uv))
    np.testing.assert_allclose(interpolation_weights(mesh, mesh.uv).to_dense().numpy() @ values, values, atol=1e-12)


def test_beside_the_pattern_is_nothing():
    with pytest.raises(InvalidInput, match=r"off the cloth.*on its pattern"):
        interpolation_weights(rectangle(0.3, 0.2), np.array([[0.35, 0.1]]))
