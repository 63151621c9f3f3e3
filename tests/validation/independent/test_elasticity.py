"""What MuJoCo's membrane is, against closed forms and against energies written down here."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

pytest.importorskip("mujoco", minversion="4.0")

import mujoco

from torchcloth.training.validation.independent.flex_sheet import SheetSpec, sheet_mesh
from torchcloth.training.validation.independent.mujoco_cloth import Grip, MujocoCloth

LENGTH, WIDTH, STIFFNESS = 0.30, 0.06, 113.0
STRIP = SheetSpec(WIDTH, LENGTH, nodes=(7, 31), membrane_stiffness=STIFFNESS)


def hang(spec, pull, damping_rate, seconds):
    """Return the rest shape [nv, nu, 3] m and the clamp force of a strip that is pulled down with ``pull`` N."""
    cloth = MujocoCloth(spec)
    x0 = np.column_stack([np.zeros(len(cloth.uv)), cloth.uv])
    top, bottom = np.flatnonzero(cloth.uv[:, 1] > spec.height - 1e-9), np.flatnonzero(cloth.uv[:, 1] < 1e-9)
    weights = np.ones(len(bottom))
    weights[[0, -1]] = 0.5
    load = np.zeros_like(x0)
    load[bottom, 2] = -pull * weights / weights.sum()
    clamp = Grip(top, np.array([0.0, 1.0]), np.tile(np.eye(4), (2, 1, 1)))
    result = cloth.run(x0, np.array([0, 0.9 * seconds, seconds]), {"top": clamp}, damping_rate=damping_rate, load=load)
    assert np.abs(result.x[-1] - result.x[-2]).max() < 1e-7  # at rest
    return result.x[-1].reshape(spec.nodes[1], spec.nodes[0], 3), result.force["top"][-1]


@pytest.mark.parametrize("strain", [0.01, 0.10])
def test_a_strip_under_load_stretches_and_contracts_as_saint_venant_kirchhoff(strain):
    stretch = 1 + strain
    pull = STIFFNESS * WIDTH * stretch * (stretch**2 - 1) / 2  # uniaxial stress; F / (Y w) at small strain
    x, force = hang(replace(STRIP, gravity=0.0), pull, damping_rate=60.0, seconds=0.6)
    # the middle, away from the clamp that hinders the contraction
    measured = (x[24, :, 2] - x[6, :, 2]).mean() / (18 * LENGTH / 30)
    across = (x[15, -1, 1] - x[15, 0, 1]) / WIDTH
    assert measured - 1 == pytest.approx(strain, rel=0.002)
    assert -(across**2 - 1) / (measured**2 - 1) == pytest.approx(0.30, rel=0.01)  # Poisson's ratio of Green strains
    assert -force[2] == pytest.approx(pull, rel=1e-5)


def test_hanging_strip_stretches_by_its_weight():
    x, force = hang(replace(STRIP, poisson_ratio=0.0), 0.0, damping_rate=20.0, seconds=1.5)
    # the mesh's lumped mass rounds the last row: 2 %
    assert -x[0, :, 2].mean() == pytest.approx(0.20 * 9.81 * LENGTH**2 / (2 * STIFFNESS), rel=0.02)
    assert -force[2] == pytest.approx(0.20 * LENGTH * WIDTH * 9.81, rel=1e-5)


def passive(spec, x):
    """MuJoCo's elastic forces [V, 3] N at positions x [V, 3] m."""
    cloth = MujocoCloth(spec, dt=1e-4)
    cloth.data.qpos[:] = (x - np.column_stack([cloth.uv, np.zeros(len(x))])).ravel()
    mujoco.mj_forward(cloth.model, cloth.data)
    return cloth.data.qfrc_passive.reshape(-1, 3).copy()


@pytest.mark.parametrize("diagonals", ["alternating", "parallel"])
def test_the_membrane_is_plane_stress_saint_venant_kirchhoff(diagonals):
    spec = SheetSpec(0.3, 0.2, nodes=(5, 4), membrane_stiffness=STIFFNESS, poisson_ratio=0.3, diagonals=diagonals)
    uv, faces = sheet_mesh(spec)
    x = np.column_stack([uv, np.zeros(len(uv))]) @ np.linalg.qr(np.random.default_rng(0).standard_normal((3, 3)))[0]
    x += 0.01 * np.random.default_rng(1).standard_normal(x.shape)
    expected = np.zeros_like(x)
    mu, lam = STIFFNESS / 2 / 1.3, STIFFNESS * 0.3 / (1 - 0.3**2)
    for a, b, c in faces:
        inverse = np.linalg.inv(np.stack([uv[b] - uv[a], uv[c] - uv[a]], 1))
        area = abs(0.5 / np.linalg.det(inverse))
        F = np.stack([x[b] - x[a], x[c] - x[a]], 1) @ inverse
        green = 0.5 * (F.T @ F - np.eye(2))
        force = -area * F @ (2 * mu * green + lam * np.trace(green) * np.eye(2)) @ inverse.T
        expected[b] += force[:, 0]
        expected[c] += force[:, 1]
        expected[a] -= force.sum(1)
    got = passive(spec, x)
    assert np.abs(expected).max() > 0.1
    np.testing.assert_allclose(got, expected, atol=1e-9 * np.abs(expected).max())


def test_bending_stores_the_plate_s_energy():
    rigidity, curvature = 1e-5, 5.0
    spec = SheetSpec(0.2, 0.2, nodes=(21, 21), bending_stiffness=rigidity, poisson_ratio=0.3)
    uv, _ = sheet_mesh(spec)

    def bent(k):
        return np.column_stack([np.sin(k * uv[:, 0]) / k, uv[:, 1], (1 - np.cos(k * uv[:, 0])) / k])

    steps = np.linspace(1e-6, curvature, 21)
    work = 0.0
    for k0, k1 in pairwise(steps):
        flat = replace(spec, bending_stiffness=0.0)  # take off what the chords' tiny shortening stores in the membrane
        x = bent((k0 + k1) / 2)
        work -= ((passive(spec, x) - passive(flat, x)) * (bent(k1) - bent(k0))).sum()
    # hinges stand for half a cell more at the rim: 1/20 of the area is not bent
    assert work == pytest.approx(0.5 * rigidity * curvature**2 * 0.2 * 0.2, rel=0.08)
