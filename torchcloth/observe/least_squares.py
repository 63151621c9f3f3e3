"""Sparse linear least squares for the motion of vertices, by conjugate gradients."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

ITERATIONS, ACCURATE = 400, 1e-3  # of conjugate gradients; relative residual
LARGEST = 0.05  # m, a step of one vertex that nothing else holds


class Equations(NamedTuple):
    """sum_k coefficients_nk . d[vertices_nk] = value_n, each in standard deviations, for moves d [V, 3] m."""

    vertices: Tensor  # [N, K] int64
    coefficients: Tensor  # [N, K, 3] 1/m
    value: Tensor  # [N]

    def weighted(self, weight: Tensor) -> Equations:
        """Each equation counted ``weight`` [N] times."""
        root = weight.sqrt()
        return Equations(self.vertices, self.coefficients * root[:, None, None], self.value * root)


def along_axes(vertices: Tensor, coefficients: Tensor, value: Tensor) -> list[Equations]:
    """Three equations, one for each axis, from scalar coefficients [N, K] 1/m (or [K]) and vectors [N, 3]."""
    axes = torch.eye(3, dtype=value.dtype)
    c = coefficients.expand(vertices.shape).unsqueeze(-1)
    return [Equations(vertices, c * axes[k], value[:, k]) for k in range(3)]


def solve(equations: list[Equations], count: int) -> Tensor:
    """Moves [count, 3] m of least squares, with a weak pull to zero."""
    row, column, entry, value, start = [], [], [], [], 0
    for part in equations:
        rows = torch.arange(start, start + len(part.value))
        row.append(rows[:, None, None].expand(part.coefficients.shape).reshape(-1))
        column.append((3 * part.vertices.unsqueeze(-1) + torch.arange(3)).reshape(-1))
        entry.append(part.coefficients.reshape(-1))
        value.append(part.value)
        start += len(part.value)
    index = torch.stack([torch.cat(row), torch.cat(column)])
    A = torch.sparse_coo_tensor(index, torch.cat(entry), (start, 3 * count), check_invariants=False).coalesce()
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Sparse CSR tensor support is in beta")  # 80 times faster than COO
        forward, backward = A.to_sparse_csr(), A.t().coalesce().to_sparse_csr()
    ridge = 1 / LARGEST**2
    diagonal = torch.zeros(3 * count, dtype=A.dtype).index_add(0, index[1], torch.cat(entry) ** 2) + ridge
    return _conjugate_gradients(lambda d: backward @ (forward @ d) + ridge * d, diagonal, backward @ torch.cat(value))


def _conjugate_gradients(operator: Callable[[Tensor], Tensor], diagonal: Tensor, right: Tensor) -> Tensor:
    """Solution [3 V] -> [V, 3], preconditioned by the diagonal."""
    d, r = torch.zeros_like(right), right
    z = r / diagonal
    p, rz = z, r @ z
    least = ACCURATE**2 * rz
    for _ in range(ITERATIONS):
        if rz <= least:
            break
        image = operator(p)
        step = rz / (p @ image)
        d, r = d + step * p, r - step * image
        z = r / diagonal
        before, rz = rz, r @ z
        p = z + rz / before * p
    return d.reshape(-1, 3)
