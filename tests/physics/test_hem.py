"""Mass along lines: how much, where, and what it weighs."""

import numpy as np
import pytest
import torch

import torchcloth as tc

STILL = {"rod": tc.Trajectory(torch.tensor([0.0, 9.0]), torch.eye(4).repeat(2, 1, 1), torch.ones(2, dtype=bool))}


@pytest.fixture(autouse=True)
def _values_only():
    with torch.no_grad():
        yield


def extra(mesh, *args, **options):
    hem = tc.effects.LineMass(*args, **options).bind(mesh)
    return hem.mass(hem.coefficients())[..., 0]


def test_a_hem_goes_round_the_cloth_once():
    mesh = tc.meshes.rectangle(0.3, 0.2, resolution=(4, 6))
    mass = extra(mesh, 0.02)
    assert float(mass.sum()) == pytest.approx(0.02 * 1.0, rel=1e-12)
    inside = torch.as_tensor(((mesh.uv > 1e-9) & (mesh.uv < np.array([0.3, 0.2]) - 1e-9)).all(1))
    assert (mass[inside] == 0).all()
    corner = mass[0]  # half a cell each way
    assert float(corner) == pytest.approx(0.02 * (0.05 + 0.02), rel=1e-12)


def test_lengths_are_those_of_the_pattern():
    """A cloth that was scanned crumpled still has the hem that was sewn."""
    flat = tc.meshes.rectangle(0.3, 0.2, resolution=(4, 6))
    crumpled = tc.meshes.Mesh.build(0.5 * flat.vertices + 0.01 * np.sin(40 * flat.vertices), flat.faces, flat.uv)
    assert torch.equal(extra(crumpled, 0.02), extra(flat, 0.02))


def test_lines_by_vertex_pairs():
    mesh = tc.meshes.rectangle(0.3, 0.2, resolution=(4, 6))
    bottom = np.flatnonzero(mesh.uv[:, 1] < 1e-9)
    pairs = np.stack([bottom[:-1], bottom[1:]], -1)
    for given in (pairs, pairs[:, ::-1], np.concatenate([pairs, pairs])):
        mass = extra(mesh, 0.02, given)
        assert float(mass.sum()) == pytest.approx(0.02 * 0.3, rel=1e-12)
        assert float(mass[torch.as_tensor(bottom)].sum()) == float(mass.sum())


@pytest.mark.parametrize("resolution", [(5, 6), (4, 6), (12, 7)])
def test_a_path_is_the_same_line_on_every_mesh(resolution):
    """Along edges or between them, aslant, or half beside the cloth: mass, and where its middle lies."""
    mesh = tc.meshes.rectangle(0.3, 0.2, resolution=resolution)
    for path, length in (
        ([[0.15, 0.0], [0.15, 0.2]], 0.2),
        ([[0.05, 0.04], [0.2, 0.17]], None),
        ([[0.1, 0.1], [0.4, 0.1]], 0.2),
        ([[0.02, 0.02], [0.1, 0.02], [0.1, 0.15]], 0.21),
    ):
        mass = extra(mesh, 0.02, path=path).numpy()
        points = np.asarray(path)
        long = np.linalg.norm(np.diff(points, axis=0), axis=1)
        assert mass.sum() == pytest.approx(0.02 * (long.sum() if length is None else length), rel=1e-7)
        inside = np.minimum(points, [0.3, 0.2])
        long = np.linalg.norm(np.diff(inside, axis=0), axis=1)
        middle = ((inside[1:] + inside[:-1]) / 2 * long[:, None]).sum(0) / long.sum()
        np.testing.assert_allclose(mass @ mesh.uv / mass.sum(), middle, atol=1e-8)
        assert (mass > -1e-10).all()
    along, pairs = (extra(mesh, 0.02, **given) for given in ({"path": [[0, 0], [0.3, 0]]}, {"edges": _bottom(mesh)}))
    torch.testing.assert_close(along, pairs, rtol=1e-6, atol=1e-10)


def _bottom(mesh):
    bottom = np.flatnonzero(mesh.uv[:, 1] < 1e-9)
    return np.stack([bottom[:-1], bottom[1:]], -1)


def test_seams_are_counted_once():
    """A sheet of two panels that lie apart on the pattern."""
    flat = tc.meshes.rectangle(0.3, 0.2, resolution=(4, 6))
    corners = flat.uv[flat.faces]
    right = corners[..., 0].mean(1) > 0.1
    apart = corners + np.where(right, 0.5, 0.0)[:, None, None]
    mesh = tc.meshes.Mesh.build(flat.vertices, flat.faces, apart)
    mass = extra(mesh, 0.02, "seams")
    assert float(mass.sum()) == pytest.approx(0.02 * 0.2, rel=1e-12)
    assert (mass[torch.as_tensor(np.abs(flat.uv[:, 0] - 0.1) > 1e-9)] == 0).all()
    assert float(extra(mesh, 0.02).sum()) == pytest.approx(0.02 * 1.0, rel=1e-12)


def strip(Y, density, mass):
    mesh = tc.meshes.rectangle(0.1, 0.4, resolution=(4, 17))
    top, bottom = (np.flatnonzero(np.abs(mesh.uv[:, 1] - edge) < 1e-9) for edge in (0.4, 0.0))
    hem = tc.effects.LineMass(mass, np.stack([bottom[:-1], bottom[1:]], -1))
    effects = {"gravity": tc.effects.Gravity((0.0, -9.81, 0.0)), "hem": hem}
    grasp = {"rod": tc.boundaries.Grasp(top.tolist())}
    return tc.Cloth(mesh, tc.materials.AEP(Y * 1e3, 1e-3), density, effects, grasp, contact=None), bottom


def test_a_strip_with_a_heavy_end_sags_and_weighs():
    """Sag rho_A g L^2 / (2 Y) + m_h g L / Y; the rod carries both weights. The fixed-corotated strip is linear."""
    Y, density, line = 40.0, 0.2, 0.05
    cloth, bottom = strip(Y, density, line)
    state = cloth.settle(cloth.rest_state(), STILL, duration=1.0, rate=35.0)
    sag = -float((state.x - cloth.rest_state().x)[torch.as_tensor(bottom), 1].mean())
    expected = density * 9.81 * 0.4**2 / (2 * Y) + line * 9.81 * 0.4 / Y
    assert sag == pytest.approx(expected, rel=0.005)
    out = cloth(state, STILL, times=[0.0, 0.05])
    weight = 9.81 * (density * 0.04 + line * 0.1)
    assert float(out.wrench["rod"][-1, 1]) == pytest.approx(-weight, rel=0.005)


def test_a_batch_of_hems():
    mesh = tc.meshes.rectangle(0.3, 0.2, resolution=(4, 6))
    mass = extra(mesh, torch.tensor([[0.01], [0.03]]))
    assert mass.shape == (2, 24)
    torch.testing.assert_close(mass[1], 3 * mass[0])


@pytest.mark.parametrize(
    "options",
    [
        {"mass_per_length": -0.1},
        {"mass_per_length": torch.ones(7)},
        {"edges": "collar"},
        {"edges": "seams"},
        {"edges": [[0, 17]]},
        {"edges": [0, 1]},
        {"edges": [[0.0, 1.0]]},
        {"edges": np.zeros((0, 2), int)},
        {"path": [0.1, 0.2]},
        {"path": [[0.1, 0.2]]},
        {"path": [[0.1, np.nan], [0.2, 0.1]]},
        {"path": [[100.0, 0.0], [100.0, 200.0]]},
    ],
)
def test_refusals(options):
    mesh = tc.meshes.rectangle(0.3, 0.2, resolution=(4, 6))
    with pytest.raises(tc.errors.InvalidInput, match="|".join(options).replace("_", " ")):
        tc.effects.LineMass(**options).bind(mesh)
