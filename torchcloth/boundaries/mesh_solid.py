"""A solid of any shape, from a closed triangle mesh."""

from __future__ import annotations

from importlib import import_module
from typing import Unpack

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from .._utils.linalg import safe_norm
from ..errors import InvalidInput, MissingDependency
from ..meshes.topology import find_edges
from .collider import AbstractCollider, ColliderOptions
from .friction import Coulomb

GRID_MARGIN_CELLS = 2  # around the solid
MAX_GRID_NODES = 2**25  # 256 MiB in float64


class MeshSolid(AbstractCollider):
    """The inside of a closed triangle mesh, with its signed distance on a regular grid.

    The distance is interpolated trilinearly, and the normal is the direction of the interpolant's gradient. Edges are
    rounded to about one cell; parts thinner than two cells vanish.

    Args:
        vertices: [V, 3] m.
        faces: [F, 3] triangles, each edge shared by exactly two.
        cell: cell of the grid [m]; None: a 48th of the longest extent. Memory grows with its inverse cubed.
        pose: [4, 4], of the mesh in the world, or in the body when it moves. None: as the vertices say.
        friction: Coulomb coefficient >= 0, or a law.
        options: as for every collider (``AbstractCollider``).

    Raises:
        InvalidInput: a mesh that is not closed, or a cell that is not positive or asks for too large a grid.
        MissingDependency: open3d cannot be imported.
    """

    def __init__(
        self,
        vertices: ArrayLike,
        faces: ArrayLike,
        cell: float | None = None,
        pose: Tensor | None = None,
        friction: float | Coulomb = 0.4,
        **options: Unpack[ColliderOptions],
    ) -> None:
        super().__init__(friction, pose=pose, **options)
        x, f = _check_and_compact(np.array(vertices, np.float64), np.array(faces, np.int64))
        low, extent = x.min(0), np.ptp(x, axis=0)
        cell = float(extent.max() / 48 if cell is None else cell)
        if not 0 < cell < np.inf:
            raise InvalidInput("cell", got=f"{cell:g} m", expected="a length > 0")
        count = np.ceil(extent / cell - 1e-9) + 1 + 2 * GRID_MARGIN_CELLS
        if count.prod() > MAX_GRID_NODES:
            raise InvalidInput(
                "cell",
                got=f"{cell:g} m, which asks for {count.prod():.3g} grid nodes",
                expected=f"at most {MAX_GRID_NODES:.3g} nodes",
                remedy=f"take a cell of {cell * (count.prod() / MAX_GRID_NODES) ** (1 / 3):.2g} m or more",
            )
        origin = low + extent / 2 - (count - 1) / 2 * cell
        axes = [origin[k] + cell * np.arange(int(count[k])) for k in range(3)]
        values = _signed_distances(x, f, np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3))
        dtype = torch.get_default_dtype()
        self.register_buffer("values", torch.as_tensor(values, dtype=dtype), persistent=False)
        self.register_buffer("cell", torch.tensor(cell, dtype=dtype), persistent=False)
        self.register_buffer("origin", torch.as_tensor(origin, dtype=dtype), persistent=False)
        self.register_buffer("count", torch.as_tensor(count.astype(np.int64)), persistent=False)
        self.register_buffer("up", torch.tensor([0.0, 0.0, 1.0], dtype=dtype), persistent=False)
        self.up: Tensor
        self.values: Tensor
        self.cell: Tensor
        self.origin: Tensor
        self.count: Tensor

    def distance(self, p: Tensor) -> tuple[Tensor, Tensor]:
        """Interpolate distance and normal; outside the grid the distance to it is added.

        Where the gradient vanishes the normal is the z axis.
        """
        position = (p - self.origin) / self.cell
        inside = torch.minimum(position.clamp(min=0), (self.count - 1).to(position))
        first = torch.minimum(inside.detach().nan_to_num().long().clamp(min=0), self.count - 2)  # diverged states too
        value, gradient = self._interpolate(first, inside - first)
        length = safe_norm(gradient)
        flat = length < 1e-3
        normal = torch.where(flat, self.up, gradient / torch.where(flat, 1.0, length))
        return value + self.cell * safe_norm(position - inside), normal

    def _interpolate(self, first: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        """Return value [..., 1] m and gradient [..., 3] at fractions ``t`` of the cells that start at ``first``."""
        _, ny, nz = self.count.unbind(-1)
        i, j, k = first.unbind(-1)
        base = (i * ny + j) * nz + k
        c = {(a, b, d): self.values[base + (a * ny + b) * nz + d] for a in (0, 1) for b in (0, 1) for d in (0, 1)}
        x, y, z = t.unbind(-1)
        low, high = (_bilinear(c[a, 0, 0], c[a, 0, 1], c[a, 1, 0], c[a, 1, 1], y, z) for a in (0, 1))
        value = low[0] + x * (high[0] - low[0])
        slopes = (high[0] - low[0], low[1] + x * (high[1] - low[1]), low[2] + x * (high[2] - low[2]))
        return value.unsqueeze(-1), torch.stack(slopes, dim=-1) / self.cell

    def extra_repr(self) -> str:
        """Return the line of the data sheet: grid, and what colliders say."""
        return f"grid {'x'.join(map(str, self.count.tolist()))}, cell={self.cell:.3g} m, {super().extra_repr()}"


def _bilinear(c00: Tensor, c01: Tensor, c10: Tensor, c11: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, ...]:
    """Return value, slope along y and slope along z from the corners c[y, z] of a unit square."""
    low, high = c00 + z * (c01 - c00), c10 + z * (c11 - c10)
    return low + y * (high - low), high - low, (c01 - c00) + y * ((c11 - c10) - (c01 - c00))


def _check_and_compact(x: np.ndarray, f: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Check that a mesh is closed, and return it without unused vertices: [V, 3] m and [F, 3].

    Raises:
        InvalidInput: shapes, indices or values that are wrong, or an edge without exactly two triangles.
    """
    if x.ndim != 2 or x.shape[1] != 3 or f.ndim != 2 or f.shape[1] != 3 or not len(f) or not np.isfinite(x).all():
        raise InvalidInput(
            "solid mesh", got=f"shapes {x.shape} and {f.shape}", expected="finite vertices [V, 3] and faces [F, 3]"
        )
    if f.min() < 0 or f.max() >= len(x):
        raise InvalidInput("solid mesh", got=f"vertex index {f.max()}", expected=f"indices in 0..{len(x) - 1}")
    x, f = x[np.unique(f)], np.unique(f, return_inverse=True)[1].reshape(-1, 3)
    open_edges = int((find_edges(f)[1] != 2).sum())
    if open_edges or np.linalg.norm(np.ptp(x, axis=0)) == 0 or np.ptp(x, axis=0).min() == 0:
        raise InvalidInput(
            "solid mesh",
            got=f"{open_edges} edges that do not have exactly two triangles",
            expected="a closed (watertight) surface",
            remedy="merge duplicate vertices and fill holes, for example with trimesh",
        )
    return x, f


def _signed_distances(x: np.ndarray, f: np.ndarray, at: np.ndarray) -> np.ndarray:
    try:
        o3d = import_module("open3d")  # imported here: it takes seconds and needs a system library
    except ImportError as error:
        raise MissingDependency(
            "MeshSolid needs open3d", got=str(error), remedy='pip install "torchcloth[observe]"'
        ) from error
    middle = x.mean(0)  # open3d computes in float32
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.core.Tensor((x - middle).astype(np.float32)), o3d.core.Tensor(f.astype(np.uint32)))
    query = o3d.core.Tensor((at - middle).astype(np.float32))
    return scene.compute_signed_distance(query, nsamples=5).numpy().astype(np.float64)
