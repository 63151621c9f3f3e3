"""Curvature of a moving sheet in material axes, and the forces of bending moments, both per vertex."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from .._utils.linalg import cross, dot, safe_norm
from ..meshes import Mesh
from ._curvature import curvature_stencils, sum_entries, largest_eigenvalue, local_matrices, mixed_area, find_sparsity_pattern

MIN_FIT_AREA_RATIO = 0.5  # a fit whose tangents span less than this has no normal to speak of: its ring lies folded on itself


class SurfaceFit(NamedTuple):
    """How a sheet is bent at its vertices."""

    second_derivatives: Tensor  # [..., 3, V, 3] 1/m, second derivatives of x along ww, ff, and sqrt 2 times wf
    warp: Tensor  # [..., V, 3] -, tangent
    weft: Tensor  # [..., V, 3] -
    normal: Tensor  # [..., V, 3] -, unit, on the side from which warp turns to weft counter-clockwise; fades if FOLDED
    area_ratio: Tensor  # [..., V, 1] -, area ratio, at least FOLDED

    @property
    def curvature(self) -> Tensor:
        """[..., V, 3] 1/m along ww, ff, sqrt 2 wf: > 0 where the centre lies on the normal's side.

        Its length does not depend on the material axes.
        """
        return (self.second_derivatives * self.normal.unsqueeze(-3)).sum(-1).mT


class BendingStencil(nn.Module):
    """Constant stencils of a mesh that see how it is bent, and answer moments with forces.

    The curvature is k = n . d^2 x / da db with the unit normal n of the same quadratic fit. The forces are the exact
    transpose of its derivative, n's included, so they do the moments' work and have neither resultant nor moment.
    """

    def __init__(self) -> None:
        super().__init__()
        for name in ("neighbours", "weight", "area", "bending_bound", "turning_bound"):
            like = torch.long if name == "neighbours" else None
            self.register_buffer(name, torch.zeros(0, dtype=like), persistent=False)
        self.neighbours: Tensor  # [N, V] neighbours that a vertex's derivatives are fitted to
        self.weight: Tensor  # [5, N, V, 1] 1/m^2 (three), 1/m (two)
        self.area: Tensor  # [V, 1] m^2
        self.bending_bound: Tensor  # [V, 1] 1/m^2: over mass, bounds omega^2 per unit bending stiffness [N m]
        self.turning_bound: Tensor  # [V, 1] 1/m: over mass, bounds omega^2 per unit bending moment [N]

    def bind(self, mesh: Mesh, device: torch.device | None = None) -> BendingStencil:
        """Build the stencils of a mesh."""
        near, second, first = curvature_stencils(mesh)
        area, share, (bending, slope) = mixed_area(mesh), mesh.vertex_area, _largest(mesh)
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
        """Derivatives at positions [..., V, 3] m; ``lost``: what of them float32 could not add, see ``Moment``."""
        values = self._derivatives(self.weight, x)
        if compensation is not None:
            values = values + self._derivatives(self.weight, compensation)
        warp, weft = values[..., 3, :, :], values[..., 4, :, :]
        normal = cross(warp, weft)
        stretch = safe_norm(normal).clamp(min=MIN_FIT_AREA_RATIO)
        return SurfaceFit(values[..., :3, :, :], warp, weft, normal / stretch, stretch)

    def second_derivatives(self, x: Tensor) -> Tensor:
        """Second derivatives alone [..., 3, V, 3] 1/m."""
        return self._derivatives(self.weight[:3], x)

    def moment_force(self, bent: SurfaceFit, moment: Tensor) -> Tensor:
        """Forces [..., V, 3] N whose virtual work is minus that of ``moment`` [..., V, 3] N on the curvature."""
        couples = moment.mT.unsqueeze(-1)
        pull = (couples * bent.second_derivatives).sum(-3)
        along = torch.where(bent.area_ratio > MIN_FIT_AREA_RATIO, dot(pull, bent.normal), 0.0)
        turn = (pull - along * bent.normal) / bent.area_ratio  # on the normal
        slopes = torch.stack([cross(bent.weft, turn), cross(turn, bent.warp)], dim=-3)
        stress = torch.cat([couples * bent.normal.unsqueeze(-3), slopes], dim=-3)
        return self._transposed(self.weight, stress)

    def vector_moment_force(self, stress: Tensor) -> Tensor:
        """Forces [..., V, 3] N of vector moments [..., 3, V, 3] N on the second derivatives."""
        return self._transposed(self.weight[:3], stress)

    def _derivatives(self, weight: Tensor, x: Tensor) -> Tensor:
        return (weight * neighbour_differences(x, self.neighbours).unsqueeze(-4)).sum(-3)

    def _transposed(self, weight: Tensor, stress: Tensor) -> Tensor:
        """Minus the area-weighted transpose of ``_derivatives``."""
        shares = (weight * (self.area * stress).unsqueeze(-3)).sum(-4)
        total = shares.sum(-3)
        flat = shares.flatten(-3, -2)
        index = self.neighbours.flatten().unsqueeze(-1).expand(flat.shape)
        return total - torch.zeros_like(total).scatter_add(-2, index, flat)

    def bending_bound_over(self, mass: Tensor) -> Tensor:
        """Bound on omega^2 [1/s^2] per unit of bending stiffness."""
        return (self.bending_bound / mass).amax()

    def turning_bound_over(self, mass: Tensor) -> Tensor:
        """Bound on omega^2 [1/s^2] that a unit of bending moment adds: it couples in-plane motion with tilting."""
        return (self.turning_bound / mass).amax()


def neighbour_differences(field: Tensor, index: Tensor) -> Tensor:
    """Values at each vertex's ``index`` [D, V] less its own [..., D, V, 3]: small numbers, wherever the sheet is."""
    return field.index_select(-2, index.flatten()).unflatten(-2, index.shape) - field.unsqueeze(-3)


@lru_cache(maxsize=8)  # as curvature_stencils
def _largest(mesh: Mesh) -> tuple[float, float]:
    """Largest eigenvalues of bending and of slopes for a unit of stiffness, over the vertices' areas."""
    near, second, first = curvature_stencils(mesh)
    area, share = mixed_area(mesh), mesh.vertex_area

    def of(weight: np.ndarray) -> float:
        local = local_matrices(weight * np.sqrt(area)[:, None, None])
        found = find_sparsity_pattern(near, local)
        return largest_eigenvalue(found.columns, sum_entries(found, local), share)

    return of(second), of(first)
