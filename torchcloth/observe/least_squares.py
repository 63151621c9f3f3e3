"""Sparse linear least squares for the displacements of vertices, by conjugate gradients."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import cg
from torch import Tensor

MAX_CG_ITERATIONS = 400
CG_RELATIVE_TOLERANCE = 1e-3  # of the residual, in the norm of the diagonal preconditioner
TYPICAL_FREE_MOVE_M = 0.05  # standard deviation of the displacement of a vertex that no equation determines


class Equations(NamedTuple):
    """N equations: sum_k coefficients_nk . d[vertices_nk] = value_n for displacements d [V, 3] m.

    They are in standard deviations.

    Attributes:
        vertices: [N, K] int64.
        coefficients: [N, K, 3] 1/m.
        value: [N].
    """

    vertices: Tensor
    coefficients: Tensor
    value: Tensor

    def weighted(self, weight: Tensor) -> Equations:
        """Return the equations with each of them counted ``weight`` [N] times."""
        root = weight.sqrt()
        return Equations(self.vertices, self.coefficients * root[:, None, None], self.value * root)


def expand_to_axes(vertices: Tensor, coefficients: Tensor, value: Tensor) -> list[Equations]:
    """Return three equations, one for each axis, from scalar coefficients [N, K] 1/m (or [K]) and vectors [N, 3]."""
    axes = torch.eye(3, dtype=value.dtype)
    c = coefficients.expand(vertices.shape).unsqueeze(-1)
    return [Equations(vertices, c * axes[k], value[:, k]) for k in range(3)]


def solve_moves(equations: list[Equations], count: int) -> Tensor:
    """Return the displacements [count, 3] m that solve the equations by least squares, with a weak pull to zero."""
    rows, columns, entries, start = [], [], [], 0
    for part in equations:
        row = torch.arange(start, start + len(part.value))
        rows.append(row[:, None, None].expand(part.coefficients.shape).reshape(-1))
        columns.append((3 * part.vertices.unsqueeze(-1) + torch.arange(3)).reshape(-1))
        entries.append(part.coefficients.reshape(-1))
        start += len(part.value)
    row, column, entry = (torch.cat(parts).numpy() for parts in (rows, columns, entries))
    matrix = csr_array((entry, (row, column)), shape=(start, 3 * count))
    value = torch.cat([part.value for part in equations])
    ridge = 1 / TYPICAL_FREE_MOVE_M**2
    # With unit diagonal, the residual that cg looks at is the one preconditioned by the diagonal.
    scale = 1 / np.sqrt(np.bincount(column, entry**2, minlength=3 * count) + ridge)
    scaled = matrix @ diags_array(scale)
    normal = (scaled.T @ scaled + diags_array(ridge * scale**2)).tocsr()
    right = scaled.T @ value.numpy()
    solution, _ = cg(normal, right, rtol=CG_RELATIVE_TOLERANCE, maxiter=MAX_CG_ITERATIONS)
    return torch.as_tensor(scale * solution, dtype=value.dtype).reshape(-1, 3)
