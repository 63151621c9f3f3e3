"""The same model on a mesh twice as fine: what differs is numerics, no physics.

Residuals are taken on the finer mesh, slopes on the coarser: an error of the slopes costs an iteration, an error of the
residuals would be named as a cause.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..meshes import Mesh
from ..recordings import Recording
from .world import Model, World, rebuilt


def refined(model: Model, recordings: Sequence[Recording]) -> tuple[Model, list[Recording]]:
    """(model, recordings) with every triangle divided into four."""
    mesh = model.base.cloth.mesh
    ends, faces = _divided(mesh.faces)
    between = lambda field: np.concatenate([field, 0.5 * (field[ends[:, 0]] + field[ends[:, 1]])])  # noqa: E731
    finer = Mesh.build(between(mesh.vertices), faces, None if mesh.uv is None else between(mesh.uv))
    cloth = rebuilt(model.base.cloth, {}, None, {}, finer)
    found = []
    for recording in recordings:
        first = recording.cloth.initial_vertices
        info = replace(
            recording.cloth,
            vertices=finer.vertices,
            faces=finer.faces,
            uv=finer.uv,
            initial_vertices=between(first) if first is not None and first.ndim == 2 else first,  # or a sheet's grid
        )
        found.append(replace(recording, cloth=info))
    return replace(model, base=World(cloth, model.base.motions, model.base.views)), found


def _divided(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(vertex pairs [N, 2] with a new vertex between, faces [4 F, 3])."""
    sides = np.sort(faces[:, [1, 2, 2, 0, 0, 1]].reshape(-1, 2), axis=1)
    ends, index = np.unique(sides, axis=0, return_inverse=True)
    a, b, c = (index.reshape(-1, 3) + faces.max() + 1).T  # opposite to the corners
    i, j, k = faces.T
    parts = [np.stack(t, 1) for t in ((i, c, b), (c, j, a), (b, a, k), (a, b, c))]
    return ends, np.concatenate(parts)
