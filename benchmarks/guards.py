"""Checks of the physics; a timing counts only if its result passes them."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from torchcloth._utils.constants import STANDARD_GRAVITY_M_PER_S2

from .cases import SUBSTEP_S, Case
from .contestant import Outcome

MAX_GRIP_ERROR_M = 1e-3  # rounding of thousands of float32 substeps
MAX_EDGE_STRETCH, MAX_STRETCHED_FRACTION = 0.10, 0.05  # at most 5 % of the edges are longer by more than 10 %
MAX_FALL_BEYOND_FREE_M = 0.005  # fall of the centre of mass beyond free fall: the recoil of a gripped sheet
# Distances relative to the displacement. Float32 in another order of operations: 0.001 measured after 40 ms. Another
# discretisation or law after 40 ms: 0.004 (Newton) and 0.03 (MuJoCo) measured.
MAX_DISTANCE_SAME_SCHEME = 0.01
MAX_DISTANCE_OTHER_SCHEME = 0.10
# Relative errors of derivatives between two float32 implementations of the same scheme over 40 ms. On sheets 2e-5 was
# measured. By E of a shirt, whose contributions cancel, the fused engine differs by 0.7e-3 and the reference by 0.3e-3
# from float64, and they differed by 1.4e-3 from each other. On small scenes, whose sheet is hardly strained, 0.8e-3 to
# 2e-3 was measured by E.
MAX_DERIVATIVE_ERROR = 2e-3
MAX_DERIVATIVE_ERROR_SMALL = 1e-2


def physics_violations(case: Case, substeps: int, x: np.ndarray) -> list[str]:
    """Return what is wrong with positions [V, 3] m at the end of a run; empty if nothing is."""
    if x.shape != case.mesh.vertices.shape or not np.isfinite(x).all():
        return ["positions are not finite"]
    violations = []
    start, seconds = case.mesh.vertices, substeps * SUBSTEP_S
    grip_motion = case.displacements(substeps).sum(0)
    grip_error = np.abs(x[case.gripped_vertices] - start[case.gripped_vertices] - grip_motion).max()
    if grip_error > MAX_GRIP_ERROR_M:
        violations.append(f"gripped vertices are {1e3 * grip_error:.2g} mm from where the gripper is")
    fall = (start - x).mean(0)[2]
    free = STANDARD_GRAVITY_M_PER_S2 * seconds**2 / 2
    if fall > free + MAX_FALL_BEYOND_FREE_M:
        violations.append(f"the centre of mass fell {fall:.3g} m, more than freely ({free:.3g} m)")
    if rms_distance(x, start + grip_motion) < 1e-7:
        violations.append("the cloth did not move but with its grippers")
    fraction = stretched_fraction(case, x)
    if fraction > MAX_STRETCHED_FRACTION:
        violations.append(
            f"{100 * fraction:.1f} % of the edges are stretched by more than {100 * MAX_EDGE_STRETCH:.0f} %"
        )
    return violations


def stretched_fraction(case: Case, x: np.ndarray) -> float:
    """Return the fraction of the triangles' edges that are longer than at rest by more than MAX_EDGE_STRETCH."""
    now, rest = _edges(x[case.mesh.faces]), _edges(case.mesh.rest)
    return float((now / rest > 1 + MAX_EDGE_STRETCH).mean())


def _edges(corners: np.ndarray) -> np.ndarray:
    return np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1)


def derivative_violations(arrays: list[np.ndarray]) -> list[str]:
    """Return what is wrong with derivatives: they are not finite, or all are zero."""
    violations = []
    for array in arrays:
        if not np.isfinite(array).all():
            violations.append("derivatives are not finite")
        elif not np.any(array):
            violations.append("derivatives are exactly zero")
    return violations


def disagreement(
    case: Case, expected: Outcome, outcome: Outcome, limit: float, derivative: float = MAX_DERIVATIVE_ERROR
) -> list[str]:
    """Return where an outcome differs from the expected one.

    Args:
        case: the case.
        expected: outcome of another contestant.
        outcome: what is checked.
        limit: allowed RMS distance of positions, relative to the displacement.
        derivative: allowed relative error of derivatives.
    """
    distance, displacement = rms_distance(expected.x, outcome.x), rms_distance(expected.x, case.mesh.vertices)
    wrong = []
    if not distance <= limit * displacement:
        wrong.append(f"{1e3 * distance:.2g} mm from the expected, of {1e3 * displacement:.2g} mm moved")
    if limit <= MAX_DISTANCE_SAME_SCHEME and expected.gradient_x is not None and outcome.gradient_x is not None:
        errors = {
            "positions": _relative_error(expected.gradient_x, outcome.gradient_x),
            "E": _relative_error(expected.gradient_youngs, outcome.gradient_youngs),
        }
        wrong += [f"derivative by {k} {e:.1e} from the expected" for k, e in errors.items() if not e <= derivative]
    return wrong


def _relative_error(expected: ArrayLike, value: ArrayLike) -> float:
    return float(np.linalg.norm(np.subtract(value, expected)) / np.linalg.norm(expected))


def rms_distance(x: np.ndarray, y: np.ndarray) -> float:
    """Return the RMS distance of vertices [m]."""
    return float(np.sqrt(((x - y) ** 2).sum(-1).mean()))
