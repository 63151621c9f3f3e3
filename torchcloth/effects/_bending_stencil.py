"""Curvature of a moving sheet in material axes, and the forces of bending moments, both per vertex."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from .._utils.linalg import cross, dot, safe_norm
from ..meshes import Mesh
from ._curvature import (
    curvature_stencils,
    find_sparsity_pattern,
    largest_eigenvalue,
    local_matrices,
    mixed_area,
    sum_entries,
)

# Smallest area ratio of the tangents of a fit. Below it the ring of neighbours lies folded on itself, and the fit has
# no meaningful normal.
MIN_FIT_AREA_RATIO = 0.5


class SurfaceFit(NamedTuple):
    """Quadratic fit of a sheet at its vertices.

    Attributes:
        second_derivatives: [..., 3, V, 3] 1/m, of x along ww, ff, and sqrt 2 times wf.
        warp: [..., V, 3] -, tangent along the warp.
        weft: [..., V, 3] -, tangent along the weft.
        normal: [..., V, 3] -, unit vector on the side from which warp turns to weft counter-clockwise. It becomes
            shorter where the area ratio is below MIN_FIT_AREA_RATIO.
        area_ratio: [..., V, 1] -, at least MIN_FIT_AREA_RATIO.
    """

    second_derivatives: Tensor
    warp: Tensor
    weft: Tensor
    normal: Tensor
    area_ratio: Tensor

    @property
    def curvature(self) -> Tensor:
        """Curvature [..., V, 3] 1/m along ww, ff, sqrt 2 wf: > 0 where the centre lies on the normal's side.

        Its length does not depend on the material axes.
        """
        return (self.second_derivatives * self.normal.unsqueeze(-3)).sum(-1).mT


class BendingStencil(nn.Module):
    """Constant stencils of a mesh that compute curvatures, and forces from bending moments.

    The curvature is k = n . d^2 x / da db with the unit normal n of the same quadratic fit. The forces are the exact
    transpose of its derivative, that of n included. So they do the moments' work and have no resultant and no moment.
    """

    def __init__(self) -> None:
        super().__init__()
        for name in ("neighbours", "weight", "area", "bending_bound", "turning_bound"):
            like = torch.long if name == "neighbours" else None
            self.register_buffer(name, torch.zeros(0, dtype=like), persistent=False)
        self.neighbours: Tensor  # [N, V], vertices that a vertex's derivatives are fitted to
        self.weight: Tensor  # [5, N, V, 1] 1/m^2 (three), 1/m (two)
        self.area: Tensor  # [V, 1] m^2
        self.bending_bound: Tensor  # [V, 1] 1/m^2; over mass it bounds omega^2 per unit of bending stiffness [N m]
        self.turning_bound: Tensor  # [V, 1] 1/m; over mass it bounds omega^2 per unit of bending moment [N]

    def bind(self, mesh: Mesh, device: torch.device | None = None) -> BendingStencil:
        """Build the stencils of a mesh, and return self."""
        near, second, first = curvature_stencils(mesh)
        area, share, (bending, slope) = mixed_area(mesh), mesh.vertex_area, _largest_eigenvalues(mesh)
        weight = np.concatenate([second, first], axis=-1).transpose(2, 1, 0)[..., None]
        self.neighbours = torch.as_tensor(near.T.copy(), device=device)
        self.weight, self.area, self.bending_bound, self.turning_bound = (
            torch.as_tensor(value.copy(), dtype=torch.get_default_dtype(), device=device)
            for value in (
                weight,
                area[:, None],
                (share * bending)[:, None],
                (share * (bending * slope) ** 0.5)[:, None],
            )
        )
        return self

    def fit_surface(self, x: Tensor, compensation: Tensor | None = None) -> SurfaceFit:
        """Compute the derivatives at positions [..., V, 3] m; ``compensation`` as of ``EffectInputs``."""
        values = self._derivatives(self.weight, x)
        if compensation is not None:
            values = values + self._derivatives(self.weight, compensation)
        warp, weft = values[..., 3, :, :], values[..., 4, :, :]
        normal = cross(warp, weft)
        stretch = safe_norm(normal).clamp(min=MIN_FIT_AREA_RATIO)
        return SurfaceFit(values[..., :3, :, :], warp, weft, normal / stretch, stretch)

    def second_derivatives(self, x: Tensor) -> Tensor:
        """Compute the second derivatives alone, [..., 3, V, 3] 1/m."""
        return self._derivatives(self.weight[:3], x)

    def moment_force(self, fit: SurfaceFit, moment: Tensor) -> Tensor:
        """Return forces [..., V, 3] N whose virtual work is minus that of ``moment`` [..., V, 3] N on the curvature."""
        couples = moment.mT.unsqueeze(-1)
        pull = (couples * fit.second_derivatives).sum(-3)
        along = torch.where(fit.area_ratio > MIN_FIT_AREA_RATIO, dot(pull, fit.normal), 0.0)
        turn = (pull - along * fit.normal) / fit.area_ratio  # on the normal
        slopes = torch.stack([cross(fit.weft, turn), cross(turn, fit.warp)], dim=-3)
        stress = torch.cat([couples * fit.normal.unsqueeze(-3), slopes], dim=-3)
        return self._transposed(self.weight, stress)

    def vector_moment_force(self, stress: Tensor) -> Tensor:
        """Return forces [..., V, 3] N of vector-valued moments [..., 3, V, 3] N on the second derivatives."""
        return self._transposed(self.weight[:3], stress)

    def _derivatives(self, weight: Tensor, x: Tensor) -> Tensor:
        return (weight * neighbour_differences(x, self.neighbours).unsqueeze(-4)).sum(-3)

    def _transposed(self, weight: Tensor, stress: Tensor) -> Tensor:
        """Return minus the area-weighted transpose of ``_derivatives``."""
        shares = (weight * (self.area * stress).unsqueeze(-3)).sum(-4)
        total = shares.sum(-3)
        flat = shares.flatten(-3, -2)
        index = self.neighbours.flatten().unsqueeze(-1).expand(flat.shape)
        return total - torch.zeros_like(total).scatter_add(-2, index, flat)

    def bending_bound_over(self, mass: Tensor) -> Tensor:
        """Return a bound on omega^2 [1/s^2] per unit of bending stiffness, for vertex masses [..., V, 1] kg."""
        return (self.bending_bound / mass).amax()

    def turning_bound_over(self, mass: Tensor) -> Tensor:
        """Return a bound on omega^2 [1/s^2] per unit of bending moment, for vertex masses [..., V, 1] kg.

        A moment couples in-plane motion with tilting.
        """
        return (self.turning_bound / mass).amax()


def neighbour_differences(field: Tensor, index: Tensor) -> Tensor:
    """Return values at each vertex's ``index`` [D, V] minus its own, [..., D, V, 3]: small wherever the sheet is."""
    return field.index_select(-2, index.flatten()).unflatten(-2, index.shape) - field.unsqueeze(-3)


@lru_cache(maxsize=8)  # as many as ``curvature_stencils`` caches
def _largest_eigenvalues(mesh: Mesh) -> tuple[float, float]:
    """Return the largest eigenvalues of bending and of slopes per unit of stiffness, over the vertices' areas."""
    neighbours, second, first = curvature_stencils(mesh)
    area, vertex_area = mixed_area(mesh), mesh.vertex_area

    def eigenvalue(weight: np.ndarray) -> float:
        local = local_matrices(weight * np.sqrt(area)[:, None, None])
        sparsity = find_sparsity_pattern(neighbours, local)
        return largest_eigenvalue(sparsity.columns, sum_entries(sparsity, local), vertex_area)

    return eigenvalue(second), eigenvalue(first)
