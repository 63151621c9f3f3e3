"""Physics that must hold before a timing counts."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from .cases import DT, Case
from .contestant import Outcome

HELD = 1e-3  # m, rounding of thousands of float32 steps
STRETCH, STRETCHED = 0.10, 0.05  # at most this share of edges is longer by more than 10 %
G = 9.81  # m/s^2
PULLED = 0.005  # m, of a centre of mass beyond free fall: the recoil of a sheet that is held
SAME = 0.01  # of the way: float32, in another order; 0.001 measured after 40 ms
OTHER = (
    0.10  # of the way: another discretisation or law, 40 ms after the start; 0.004 (Newton) and 0.03 (MuJoCo) measured
)
# relative, two float32 implementations of the same scheme over 40 ms: 2e-5 measured on sheets; by E of a shirt, whose
# parts cancel, the fused engine is 0.7e-3 and the reference 0.3e-3 from float64, and they were 1.4e-3 from each other
DERIVATIVE = 2e-3
ROUNDED = 1e-2  # the same on the tiny scenes, whose sheet is hardly strained: 0.8e-3 to 2e-3 measured, by E


def problems(case: Case, substeps: int, x: np.ndarray) -> list[str]:
    """What is wrong with positions [V, 3] m at the end of a run; empty if nothing is."""
    if x.shape != case.mesh.vertices.shape or not np.isfinite(x).all():
        return ["positions are not finite"]
    found = []
    start, seconds = case.mesh.vertices, substeps * DT
    way = case.displacements(substeps).sum(0)
    held = np.abs(x[case.fixed] - start[case.fixed] - way).max()
    if held > HELD:
        found.append(f"held vertices are {1e3 * held:.2g} mm from where the gripper is")
    fall = (start - x).mean(0)[2]
    free = G * seconds**2 / 2
    if fall > free + PULLED:
        found.append(f"the centre of mass fell {fall:.3g} m, more than freely ({free:.3g} m)")
    if apart(x, start + way) < 1e-7:
        found.append("the cloth did not move but with its grippers")
    share = stretched(case, x)
    if share > STRETCHED:
        found.append(f"{100 * share:.1f} % of the edges are stretched by more than {100 * STRETCH:.0f} %")
    return found


def stretched(case: Case, x: np.ndarray) -> float:
    """Share of the triangles' edges that are longer than at rest by more than STRETCH."""
    now, rest = _edges(x[case.mesh.faces]), _edges(case.mesh.rest)
    return float((now / rest > 1 + STRETCH).mean())


def _edges(corners: np.ndarray) -> np.ndarray:
    return np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1)


def derivative_problems(arrays: list[np.ndarray]) -> list[str]:
    """Derivatives that are not finite, or vanish altogether."""
    found = []
    for array in arrays:
        if not np.isfinite(array).all():
            found.append("derivatives are not finite")
        elif not np.any(array):
            found.append("derivatives are exactly zero")
    return found


def disagreement(case: Case, truth: Outcome, found: Outcome, limit: float, derivative: float = DERIVATIVE) -> list[str]:
    """Positions farther from another run's than ``limit`` times the way; derivatives, by ``derivative``."""
    distance, way = apart(truth.x, found.x), apart(truth.x, case.mesh.vertices)
    wrong = (
        [] if distance <= limit * way else [f"{1e3 * distance:.2g} mm from the expected, of {1e3 * way:.2g} mm moved"]
    )
    if limit <= SAME and truth.by_x is not None and found.by_x is not None:
        errors = {"positions": _relative(truth.by_x, found.by_x), "E": _relative(truth.by_youngs, found.by_youngs)}
        wrong += [f"derivative by {k} {e:.1e} from the expected" for k, e in errors.items() if not e <= derivative]
    return wrong


def _relative(truth: ArrayLike, found: ArrayLike) -> float:
    return float(np.linalg.norm(np.subtract(found, truth)) / np.linalg.norm(truth))


def apart(x: np.ndarray, y: np.ndarray) -> float:
    """RMS distance of vertices [m]."""
    return float(np.sqrt(((x - y) ** 2).sum(-1).mean()))
