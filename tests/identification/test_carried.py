"""Values between vertices."""

import numpy as np
import pytest

from torchcloth.errors import InvalidInput
from torchcloth.identification.carried import between
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
    np.testing.assert_allclose(between(mesh, places).numpy() @ quadratic(uv), quadratic(places), atol=1e-8)


def test_vertices_are_what_they_are():
    mesh = rectangle(0.3, 0.2, resolution=(5, 4))
    values = RNG.standard_normal(len(mesh.uv))
    np.testing.assert_allclose(between(mesh, mesh.uv).numpy() @ values, values, atol=1e-12)


def test_beside_the_pattern_is_nothing():
    with pytest.raises(InvalidInput, match=r"off the cloth.*on its pattern"):
        between(rectangle(0.3, 0.2), np.array([[0.35, 0.1]]))
