"""Correct a fit for the coarseness of its mesh by Richardson extrapolation: discretisation error, no physics.

A sheet of coarse triangles does not bend and wrinkle as the cloth does, and a fit makes up for that in its parameters.
One simulation on a mesh twice as fine shows by how much. With residuals r and r' of the two meshes at the solution, it
asks for the step d = -(J' W J + P)^-1 J' W (r' - r). Errors fall with the square of the edges, so the limit is 4/3 d
away. A third of d is added to the standard errors for the uncertainty of the extrapolation. A second simulation on the
finer mesh, d away, shows whether the slopes hold that far.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ...boundaries import AbstractBoundary, Grasp
from ...cloth import Cloth
from ...episodes.observed import build_episode
from ...episodes.pattern_interpolation import interpolate_on_pattern, interpolation_weights, move_vertices_to_patches
from ...episodes.recorded_cloth import transfer_vertices
from ...errors import InvalidInput, SimulationDiverged, UnstableStep
from ...meshes import Mesh
from ...meshes.patches import Patch
from ...parameters import PhysicalParameter
from ...recordings import Recording
from ...simulation.bound_modules import copy_parts
from ..estimators import levenberg_marquardt
from ..estimators.objective import Objective

EXTRAPOLATION_FACTOR = 4 / 3  # of the step between two meshes with edges of ratio 2, to the limit
CORRECTION_UNCERTAINTY = 1 / 3  # of that step, added to the standard errors
MIN_CHECKED_DECREASE = 0.5  # of the cost: a step of one standard error
MAX_FAILED_CORRECTION = 1.0  # standard errors that a parameter may be off by a correction that does not hold


class FineScene(NamedTuple):
    """What the correction simulates.

    Attributes:
        cloth: the fit's, on a mesh twice as fine (``refine_cloth``).
        recordings: of the fit.
    """

    cloth: Cloth
    recordings: Sequence[Recording]


def refine_cloth(cloth: Cloth) -> Cloth:
    """Return the cloth with every triangle divided into four; grippers hold what they held.

    Raises:
        InvalidInput: a parameter with one value per triangle or vertex.
    """
    counts = len(cloth.mesh.faces), len(cloth.mesh.vertices)
    for name, part in cloth.named_modules():
        if isinstance(part, PhysicalParameter) and any(size in counts for size in part.raw.shape[-2:]):
            expected = "one number for all triangles"
            raise InvalidInput(f"a finer mesh: {name}", got=f"shape {tuple(part.raw.shape)}", expected=expected)
    mesh, parts = cloth.mesh, copy_parts(cloth)
    ends, _ = _divide_faces(mesh.faces)
    patches = {name: _grasped_patch(part, mesh) for name, part in parts.boundaries.items()}
    # patches are rounder than on the coarse mesh
    fine = move_vertices_to_patches(_divide_mesh(mesh), [p for p in patches.values() if p])
    boundaries = {
        name: part if patches[name] else _hold_new_vertices(part, ends, mesh) for name, part in parts.boundaries.items()
    }
    grid, contact = cloth.contact_grid(), cloth.contact
    if contact is not None:  # the contact gap is physics and stays
        contact = replace(contact, spacing=None if grid is None else grid.spacing)
    return Cloth(fine, parts.material, parts.areal_density, parts.effects, boundaries, contact, cloth.engine)


def refine_recording(recording: Recording, coarse: Mesh, fine: Mesh) -> Recording:
    """Return the episode for the fine mesh of ``refine_cloth``, whose first shape includes the new vertices."""
    info = recording.cloth
    refined = {
        name: _refine_vertices(recording, coarse, fine, values)
        for name in ("initial_vertices", "initial_velocities")
        if (values := getattr(info, name)) is not None and values.ndim == 2  # else it is a sheet's grid
    }
    info = replace(info, vertices=fine.vertices, faces=fine.faces, uv=fine.uv, **refined)
    return replace(recording, cloth=info)


def _refine_vertices(recording: Recording, coarse: Mesh, fine: Mesh, values: np.ndarray) -> np.ndarray:
    """Return values of the fine mesh's vertices, [V, 3], from those of the episode's own."""
    values = _add_midpoints(
        transfer_vertices(coarse, recording, torch.as_tensor(values)).numpy(), _divide_faces(coarse.faces)[0]
    )
    if fine.uv is None:
        return values
    weights = interpolation_weights(_divide_mesh(coarse), fine.uv)
    return interpolate_on_pattern(weights, torch.as_tensor(values)).numpy()


class CorrectedSolution(NamedTuple):
    """A solution for ever smaller triangles.

    Attributes:
        final: the solution.
        covariance: [K, K] of it.
        entries: size of the correction, and its gain ratio if it was checked, for ``Identification.fit``; empty where
            there is none.
        warnings: why there is none.
        unusable: names of parameters that are no estimates without it.
    """

    final: levenberg_marquardt.Iterate
    covariance: Tensor
    entries: dict[str, float]
    warnings: list[str]
    unusable: tuple[str, ...] = ()


def correct_for_mesh(
    objective: Objective, final: levenberg_marquardt.Iterate, covariance: Tensor, scene: FineScene | None
) -> CorrectedSolution:
    """Extrapolate a solution to ever smaller triangles.

    Where the step does not bring the finer mesh nearer to the data, its slopes do not hold that far. Parameters that it
    would move by more than a standard error are no estimates then. In ``studies strangers`` (seed 59) such a step of 7
    standard errors made E h 2.3 times the truth; in ``studies honesty`` (rig 12) one of 10 that is confirmed leads
    within a standard error of it.

    Args:
        objective: of all frames.
        final: the solution.
        covariance: [K, K] of it.
        scene: the same on a mesh twice as fine; None: there is no correction.
    """
    if scene is None:
        return CorrectedSolution(final, covariance, {}, [])
    try:
        step, gain_ratio = mesh_correction(objective, final, scene)
        moved = final._replace(raw=objective.clip(final.raw + EXTRAPOLATION_FACTOR * step))
        objective.observe(moved.raw)  # fails here if it cannot be simulated; the frames are remembered for later
    except (SimulationDiverged, UnstableStep) as error:
        reason = f"not corrected for the coarseness of the mesh: on a finer one, {error}"
        return CorrectedSolution(final, covariance, {}, [reason])
    correction = EXTRAPOLATION_FACTOR * step.abs() / covariance.diagonal().sqrt()
    if gain_ratio < levenberg_marquardt.SOLVER_SETTINGS.min_gain_ratio:
        pairs = zip(objective.unknowns, correction.tolist(), strict=False)
        unusable = tuple(u.name for u, size in pairs if size > MAX_FAILED_CORRECTION and not u.measured)
        reason = "not corrected for the coarseness of the mesh: the correction brings a finer one no nearer to the data"
        reason += f", so there is no estimate of {', '.join(unusable)}" if unusable else ""
        return CorrectedSolution(final, covariance, {}, [reason], unusable)
    entries = {"mesh_correction": float(correction[: len(objective.unknowns)].max())}
    entries |= {} if math.isnan(gain_ratio) else {"mesh_correction_gain": gain_ratio}
    covariance = covariance + CORRECTION_UNCERTAINTY**2 * torch.outer(step, step)
    return CorrectedSolution(moved, covariance, entries, [])


class MeshCorrection(NamedTuple):
    """What a mesh twice as fine asks for.

    Attributes:
        step: [K] from the solution to the optimum of the finer mesh, by the slopes of the given one, in unconstrained
            coordinates.
        gain_ratio: decrease of the finer mesh's cost along the step, over what the slopes promise; NaN where they
            promise less than ``MIN_CHECKED_DECREASE``.
    """

    step: Tensor
    gain_ratio: float


def mesh_correction(objective: Objective, final: levenberg_marquardt.Iterate, scene: FineScene) -> MeshCorrection:
    """Compute what a mesh twice as fine asks for at the solution, and whether it is nearer to the data there.

    Args:
        objective: of all frames.
        final: the solution.
        scene: the same on the finer mesh.

    Raises:
        SimulationDiverged: the finer mesh cannot be simulated.
        UnstableStep: the same.
    """
    coarse, cloth = objective.cloth, scene.cloth
    episodes = [
        build_episode(cloth, refine_recording(r, coarse.mesh, cloth.mesh)).with_lookahead(e.lookahead)
        for r, e in zip(scene.recordings, objective.episodes, strict=True)
    ]
    fine, problem = objective.with_cloth(cloth, episodes), objective.problem()
    residual = _fine_residual(final.linear, fine.evaluate_all(final.raw))
    weighted = final.row_weights()[0][:, None] * final.linear.jacobian
    information = levenberg_marquardt.information_matrix(problem, final)
    step = -torch.linalg.solve(information, weighted.mT @ (residual - final.linear.residual))
    there, promised = problem.clip(final.raw + step), 0.5 * float(step @ information @ step)
    if promised < MIN_CHECKED_DECREASE:
        return MeshCorrection(step, math.nan)
    moved = _fine_residual(final.linear, fine.evaluate_all(there))
    before = levenberg_marquardt.robust_cost(problem, final, final.raw, residual)
    after = levenberg_marquardt.robust_cost(problem, final, there, moved)
    return MeshCorrection(step, (before - after) / promised)


def _fine_residual(linear: levenberg_marquardt.Linearised, fine: levenberg_marquardt.Linearised) -> Tensor:
    """Return the residuals [R] on the finer mesh; those of the given mesh where rows have no counterpart."""
    residual = linear.residual.clone()
    for b in linear.blocks.unique():
        rows, fine_rows = linear.blocks == b, fine.blocks == b
        if int(rows.sum()) == int(fine_rows.sum()):  # along the rim other points may count: no change is known there
            before, after = linear.residual[rows], fine.residual[fine_rows]
            is_missing = (before == 0) | (after == 0)  # a piece of the rim that was not seen
            residual[rows] = torch.where(is_missing, before, after)
    return residual


def _divide_mesh(mesh: Mesh) -> Mesh:
    ends, faces = _divide_faces(mesh.faces)
    pattern = None if mesh.pattern is None else _divide_corners(mesh.pattern)
    return Mesh.build(_add_midpoints(mesh.vertices, ends), faces, pattern, mesh.places)


def _grasped_patch(part: AbstractBoundary, mesh: Mesh) -> Patch | None:
    """Patch that a grasp holds, if the mesh has vertices on its edge."""
    if not isinstance(part, Grasp) or part.uv is None or mesh.uv is None:
        return None
    patch = Patch(part.uv, part.radius)
    return patch if patch.has_vertices_on_edge(mesh.uv) else None


def _hold_new_vertices(part: AbstractBoundary, ends: np.ndarray, mesh: Mesh) -> AbstractBoundary:
    """Let a grasp hold the new vertices between those it held; by its radius it would hold more or fewer."""
    if not isinstance(part, Grasp):
        return part
    added = len(mesh.vertices) + np.flatnonzero(np.isin(ends, part.index.cpu().numpy()).all(1))
    return part.with_vertices(torch.cat([part.index, torch.as_tensor(added).to(part.index)]))


def _add_midpoints(field: np.ndarray, ends: np.ndarray) -> np.ndarray:
    return np.concatenate([field, 0.5 * (field[ends[:, 0]] + field[ends[:, 1]])])


def _divide_corners(corners: np.ndarray) -> np.ndarray:
    """[4 F, 3, 2] corners of the divided triangles from [F, 3, 2]; along a seam each panel has its own."""
    i, j, k = corners.transpose(1, 0, 2)
    return _assemble_quarters((i, j, k), ((j + k) / 2, (k + i) / 2, (i + j) / 2))


def _divide_faces(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(vertex pairs [N, 2] with a new vertex between them, faces [4 F, 3])."""
    sides = np.sort(faces[:, [1, 2, 2, 0, 0, 1]].reshape(-1, 2), axis=1)
    ends, index = np.unique(sides, axis=0, return_inverse=True)
    return ends, _assemble_quarters(faces.T, (index.reshape(-1, 3) + faces.max() + 1).T)


def _assemble_quarters(corners: Iterable[np.ndarray], midpoints: Iterable[np.ndarray]) -> np.ndarray:
    """[4 F, 3, ...] parts of every triangle, from its corners and the opposite midpoints [F, ...]."""
    (i, j, k), (a, b, c) = corners, midpoints
    return np.concatenate([np.stack(t, 1) for t in ((i, c, b), (c, j, a), (b, a, k), (a, b, c))])
