"""The plate matrix of woven cloth, assembled for given stiffnesses."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from .._utils.linalg import dot
from ._curvature import CurvatureStencils, find_sparsity_pattern, local_matrices

PLATE_ENTRIES = ((0, 0), (1, 1), (0, 1), (2, 2))  # rows and columns of P that do not vanish, as fields of ``Plate``


class Plate(NamedTuple):
    """Stiffness matrix P of the bending energy per area k . P k / 2, for curvatures k = (k_ww, k_ff, sqrt 2 k_wf).

    Attributes:
        warp: P_11 [..., V or 1, 1] N m.
        weft: P_22 [..., V or 1, 1] N m.
        cross: P_12 [..., V or 1, 1] N m.
        twist: P_33 [..., V or 1, 1] N m.
    """

    warp: Tensor
    weft: Tensor
    cross: Tensor
    twist: Tensor

    def moment(self, k: Tensor) -> Tensor:
        """Return the bending moment P k, [..., V, 3] N."""
        ww, ff, wf = k.split(1, dim=-1)
        return torch.cat([self.warp * ww + self.cross * ff, self.cross * ww + self.weft * ff, self.twist * wf], dim=-1)

    def energy(self, second: Tensor) -> Tensor:
        """Return k . P k / 2, [..., V, 1] J/m^2, of vector-valued curvatures [..., 3, V, 3] 1/m."""
        ww, ff, wf = second.unbind(-3)
        direct = self.warp * dot(ww, ww) + 2 * self.cross * dot(ww, ff) + self.weft * dot(ff, ff)
        return 0.5 * (direct + self.twist * dot(wf, wf))

    def eigenvalue_bound(self) -> Tensor:
        """Return a bound [] N m on the eigenvalues of P."""
        direct = torch.maximum(self.warp, self.weft) + self.cross.abs()
        return torch.maximum(direct, self.twist).amax()


class PlateOperator(nn.Module):
    """Q of F = -Q x for any plate. Entries are summed once per rollout, so substeps cost as with fixed ones."""

    def __init__(self) -> None:
        super().__init__()
        for name in ("columns", "slots", "locals"):
            self.register_buffer(name, torch.zeros(0, dtype=None if name == "locals" else torch.long), persistent=False)
        self.columns: Tensor  # [D, V], vertices that a vertex's force depends on
        self.slots: Tensor  # [V, M], position of a stencil's local entries in the flat result; D V for none
        self.locals: Tensor  # [4, V, M] 1/m^2, minus the local entries for a unit of each of a plate's coefficients

    def bind(self, stencils: CurvatureStencils, area: np.ndarray, device: torch.device | None = None) -> PlateOperator:
        """Compute the local matrices of every vertex's stencil, and return self."""
        form = stencils.second * np.sqrt(area)[:, None, None]
        parts = [_symmetric_matrices(form, i, j) for i, j in PLATE_ENTRIES]
        sparsity = find_sparsity_pattern(stencils.neighbours, np.abs(parts).sum(0))
        count, depth = sparsity.columns.shape
        turned = sparsity.slots % depth * count + sparsity.slots // depth  # of the transposed table
        turned = np.where(sparsity.slots == count * depth, count * depth, turned)
        self.columns = torch.as_tensor(sparsity.columns.T.copy(), device=device)
        self.slots = torch.as_tensor(turned.reshape(count, -1), device=device)
        flat = np.stack([-part.reshape(count, -1) for part in parts])
        self.locals = torch.as_tensor(flat, dtype=torch.get_default_dtype(), device=device)
        return self

    def entries(self, plate: Plate) -> Tensor:
        """Return minus the off-diagonal entries of Q, [..., D V, 1] N/m."""
        local = sum(c * part for c, part in zip(plate, self.locals, strict=True)) + torch.zeros_like(self.locals[0])
        flat, index = local.flatten(-2), self.slots.flatten()
        total = flat.new_zeros(*flat.shape[:-1], self.columns.numel() + 1)
        return total.scatter_add(-1, index.expand_as(flat), flat)[..., :-1].unsqueeze(-1)


def _symmetric_matrices(form: np.ndarray, i: int, j: int) -> np.ndarray:
    a, b = form[..., i : i + 1], form[..., j : j + 1]
    return local_matrices(a) if i == j else local_matrices(a, b) + local_matrices(b, a)
