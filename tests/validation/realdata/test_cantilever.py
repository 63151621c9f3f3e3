"""A measured cantilever of heavy glass fabric (Broberg et al., bendstiff), whose bending moment saturates.

The published table of moments ends at 1.87 1/m, below which four fifths of this strip lie, and its straight way to 0
leaves 6.6 mm. The law below has the table's moment at the largest curvature and was fitted to the profile.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

import torchcloth as tc
from torchcloth import recordings
from torchcloth.training.validation.realdata import cantilever
from torchcloth.training.validation.realdata.cantilever import LENGTH, LOAD

pytestmark = pytest.mark.realdata

TANGENT, SATURATION, KNEE = 0.00196, 0.335, 2.52  # N m, N, 1/m
MARK = 5e-3  # m


@pytest.fixture
def source(measured_in) -> Path:
    return measured_in("cantilever")


@pytest.fixture
def profile(source: Path, tmp_path: Path) -> np.ndarray:
    """Through the disk."""
    return cantilever.profile(recordings.read(recordings.write(cantilever.episode(source), tmp_path / "episode")))


@pytest.fixture
def table(source: Path) -> np.ndarray:
    return cantilever.moments(source)


def law(curvature: np.ndarray) -> np.ndarray:
    return TANGENT * curvature + SATURATION * curvature / np.sqrt(curvature**2 + KNEE**2)


def elastica(curvature: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """[N, 2] m, the strip clamped level, from curvature(moment): theta' = -k(M), M' = -w (L - s) cos theta."""
    from scipy.integrate import solve_bvp

    s = np.linspace(0, LENGTH, 200)
    guess = np.array([-0.6 * s / LENGTH, 0.4 * LOAD * (LENGTH - s) ** 2, s, -0.2 * s])
    found = solve_bvp(
        lambda s, y: np.array([-curvature(y[1]), -LOAD * (LENGTH - s) * np.cos(y[0]), np.cos(y[0]), np.sin(y[0])]),
        lambda a, b: np.array([a[0], b[1], a[2], a[3]]),
        s,
        guess,
        tol=1e-5,
        max_nodes=50000,
    )
    assert found.status == 0
    return found.sol(np.linspace(0, LENGTH, 2000))[2:].T


def inverse(moment: Callable[[np.ndarray], np.ndarray]) -> Callable[[np.ndarray], np.ndarray]:
    k = np.concatenate([np.linspace(0, 5, 20000), np.linspace(5, 300, 40000)[1:]])
    return lambda m: np.interp(m, moment(k), k)


def largest(profile: np.ndarray, curve: np.ndarray) -> float:
    """Largest distance [m] of the measured points from a curve."""
    return float(distances(profile, curve).max())


def distances(profile: np.ndarray, curve: np.ndarray) -> np.ndarray:
    a, along = curve[:-1], np.diff(curve, axis=0)
    share = ((profile[:, None] - a) * along).sum(-1) / (along**2).sum(-1)
    nearest = a + np.clip(share, 0, 1)[..., None] * along
    return np.linalg.norm(profile[:, None] - nearest, axis=-1).min(1)


def hanging(effects: dict[str, tc.effects.AbstractEffect], columns: int = 20, held: int = 4) -> np.ndarray:
    """[N, 2] m, midline of the simulated strip at rest, by dynamic relaxation: stopped whenever it slows down.

    A vertex bends half a cell to either side of it, so the clamp's edge is half a cell before the last held column.
    """
    cell = LENGTH / (columns - held + 0.5)
    mesh = tc.meshes.rectangle((columns - 1) * cell, 0.05, resolution=(columns, 5))
    inside = np.flatnonzero(mesh.vertices[:, 0] < (held - 0.5) * cell).tolist()
    cloth = tc.Cloth(
        mesh,
        tc.materials.AEP(2e6, 0.02),  # 2 kN/m
        LOAD / 9.81,
        {"gravity": tc.effects.Gravity(), "damping": tc.effects.MassDamping(2.0), **effects},
        {"clamp": tc.boundaries.Grasp(inside)},
        contact=None,
    )
    still = tc.Trajectory(torch.tensor([0.0, 9.0]), torch.eye(4).repeat(2, 1, 1), torch.ones(2, dtype=torch.bool))
    state, before = cloth.rest_state(), 0.0
    with torch.no_grad():
        for _ in range(80):
            state = cloth(state, {"clamp": still}, (0.0, 0.02)).state
            kinetic = cloth.energy(state)["kinetic"].item()
            if kinetic < before:
                state, kinetic = state._replace(v=torch.zeros_like(state.v)), 0.0
            before = kinetic
    line = state.x.unflatten(0, (columns, -1)).mean(1)[:, [0, 2]].numpy() - [(held - 1.5) * cell, 0.0]
    return np.concatenate([[[0.0, 0.0]], line[held - 1 :]])


def test_the_law_saturates_as_the_authors_table(table):
    """At the largest curvature; at small ones the profile is softer than the table."""
    top = table[-1]
    assert law(top[0]) == pytest.approx(top[1], rel=0.02)
    middle = table[np.abs(table[:, 0] - 9.97) < 0.1][0]
    assert law(middle[0]) == pytest.approx(middle[1], rel=0.05)


def test_no_constant_stiffness_fits(profile):
    """By the elastica, from 0.03 to 0.08 N m. The best, 0.048 N m, is 7.2 mm off; the saturating law 0.6 mm."""
    best = min(largest(profile, elastica(lambda m, B=B: m / B)) for B in np.linspace(0.03, 0.08, 51))
    assert best > 1.3 * MARK
    assert largest(profile, elastica(inverse(law))) < 1e-3


def test_the_published_table_does_not_determine_the_profile(profile, table):
    """Straight from its last point to 0 and on beyond its first, it leaves 6.6 mm."""
    k, m = table.T
    slope = (k[-1] - k[-2]) / (m[-1] - m[-2])
    curve = elastica(lambda moment: np.interp(moment, m, k) + slope * np.clip(moment - m[-1], 0, None))
    assert MARK < largest(profile, curve) < 8e-3


def test_the_cloth_hangs_as_measured(profile):
    """Beside the strip (reached: 1.8 mm at most, 1.0 mm RMS), and beside the elastica of its own law (1.3 mm)."""
    curve = hanging(
        {"bending": tc.effects.Bending(TANGENT), "saturating": tc.effects.SaturatingBending(SATURATION, KNEE)}
    )
    assert largest(profile, curve) < MARK
    assert largest(elastica(inverse(law))[::40], curve) < 2e-3


def test_a_linear_cloth_does_not(profile):
    """With the best of all constant stiffnesses: 7.0 mm off, 4.6 mm RMS."""
    curve = hanging({"bending": tc.effects.Bending(0.048)})
    assert largest(profile, curve) > MARK
