"""Plasticity in the plane of the sheet: permanent set."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from .._utils.linalg import safe_norm
from ..parameters import PhysicalParameter
from ..types import Surface
from .stretch import right_stretch


class NormYield(nn.Module):
    """Elastic stretches stay within sum (sigma_i - 1)^2 <= c^2; what exceeds it becomes permanent set.

    The DiffCP paper bounds |F - 1|, which a rigid rotation violates; this is its objective form. It acts on the right
    stretch: the rotation is unchanged, the strain U - 1 is shortened to length c without turning, and the set is stored
    in the material's axes. The law is rate-independent: a strain that lasts longer sets no further. Shear counts as any
    other strain, although woven cloth recovers from it, and yarns do not follow the set (as in ``RestShape``).

    Args:
        limit: c [-], the elastic strain that does not set; 0.02 is 2 % along one axis. Scalar or one per triangle.

    Raises:
        InvalidInput: a limit that is not positive.
    """

    def __init__(self, limit: float | Tensor) -> None:
        super().__init__()
        self.limit = PhysicalParameter(limit, "-", name="yield limit")

    def initial_memory(self, triangles: int) -> Tensor:
        """Return the identity by rows, [E, 4]: no set."""
        return torch.eye(2).flatten().expand(triangles, 4)

    def flow(self, limit: Tensor, trial: Surface, inverse_plastic: Tensor) -> Tensor:
        """Return A U^-1 (1 + c (U - 1) / |U - 1|) where |U - 1| > c, else A; [..., E, 4] by rows.

        U is the right stretch of ``trial``.
        """
        u = right_stretch(trial)
        strain = torch.cat([u.warp - 1, u.shear, u.shear, u.weft - 1], dim=-1)
        length = safe_norm(strain)
        yields = length > limit
        keep = torch.where(yields, limit / torch.where(yields, length, 1.0), 1.0)
        # U^-1 (1 + keep (U - 1)) = keep + (1 - keep) U^-1, with U^-1 = adj U / J
        adjugate = torch.cat([u.weft, -u.shear, -u.shear, u.warp], dim=-1)
        one = torch.eye(2, dtype=strain.dtype, device=strain.device).flatten()
        change = (1 - keep) / trial.J * adjugate + keep * one
        set_now = (inverse_plastic.unflatten(-1, (2, 2)) @ change.unflatten(-1, (2, 2))).flatten(-2)
        return torch.where(yields, set_now, inverse_plastic)
