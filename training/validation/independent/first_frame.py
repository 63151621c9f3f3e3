"""The mesh that a fit uses, and where its vertices were measured to be at the first frame."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .flex_sheet import SheetSpec, bilinear, grid

Array = np.ndarray


def measured_mesh(
    sheet: SheetSpec,
    x: Array,
    nodes: int,
    size: float,
    held: Sequence[Array | tuple[float, float]],
    radius: float,
    rng: np.random.Generator,
) -> tuple[Array, Array, Array]:
    """Material coordinates [V, 2], triangles [F, 3] and measured first positions [V, 3] m of ``nodes`` x ``nodes``.

    The positions are the truth's x [V', 3], bilinear between its vertices, with a smooth error of ``size`` m along the
    cloth's normal: what a surface fitted to depth images has. Errors of single vertices would be strains of several per
    cent, which no cloth at rest has. Within ``radius`` of the held pattern points they are where the robots say.
    """
    uv, faces = grid(SheetSpec(sheet.width, sheet.height, nodes=(nodes, nodes)))
    position, along_u, along_v = bilinear(sheet, x, uv)
    normal = np.cross(along_u, along_v)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    knots = rng.standard_normal((5, 5))
    coarse = SheetSpec(sheet.width, sheet.height, nodes=(5, 5))
    error = bilinear(coarse, knots.reshape(-1, 1), uv)[0]
    error *= size / np.sqrt((error**2).mean())
    free = np.min([np.linalg.norm(uv - corner, axis=1) for corner in held], axis=0) > radius
    return uv, faces, position + error * normal * free[:, None]
