"""The mesh of a fit, with its vertices as they were measured at the first frame."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .flex_sheet import SheetSpec, interpolate_bilinear, sheet_mesh

Array = np.ndarray


def measured_mesh(
    sheet: SheetSpec,
    x: Array,
    nodes: int,
    error_rms: float,
    grasp_points: Sequence[Array | tuple[float, float]],
    radius: float,
    rng: np.random.Generator,
) -> tuple[Array, Array, Array]:
    """Return a mesh of ``nodes`` x ``nodes`` vertices with measured first positions.

    The positions are the truth, interpolated bilinearly, plus a smooth error along the cloth's normal. A surface that
    is fitted to depth images has such an error. Independent errors of single vertices would be strains of several per
    cent, which no cloth at rest has. Near the grasp points there is no error: the robots know these positions.

    Args:
        sheet: the sheet of the truth.
        x: [V', 3] m, true positions of its vertices.
        nodes: vertices along each side of the mesh.
        error_rms: m, root mean square of the error.
        grasp_points: [2] m each, pattern points that grippers hold.
        radius: m, distance from a grasp point without an error.
        rng: source of the error.

    Returns:
        Material coordinates [V, 2] m, triangles [F, 3] and measured positions [V, 3] m.
    """
    uv, faces = sheet_mesh(SheetSpec(sheet.width, sheet.height, nodes=(nodes, nodes)))
    position, along_u, along_v = interpolate_bilinear(sheet, x, uv)
    normal = np.cross(along_u, along_v)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    knots = rng.standard_normal((5, 5))
    coarse = SheetSpec(sheet.width, sheet.height, nodes=(5, 5))
    error = interpolate_bilinear(coarse, knots.reshape(-1, 1), uv)[0]
    error *= error_rms / np.sqrt((error**2).mean())
    is_free = np.min([np.linalg.norm(uv - point, axis=1) for point in grasp_points], axis=0) > radius
    return uv, faces, position + error * normal * is_free[:, None]
