"""Random states for contracts: stretched, sheared, compressed and turned."""

from __future__ import annotations

import torch
from torch import Tensor

from .._utils.linalg import cross, dot
from ..types import Surface


def rotation(seed: int = 0) -> Tensor:
    """Draw a random proper rotation, [3, 3]."""
    q = torch.linalg.qr(normal((3, 3), seed))[0]
    return q * torch.linalg.det(q)


def normal(shape: tuple[int, ...], seed: int) -> Tensor:
    """Draw standard normal float64 numbers that do not depend on the global generator."""
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def frames(count: int, strain: float, seed: int) -> tuple[Tensor, Tensor]:
    """Draw surface columns f1 and f2, [E, 3] each: random rotations times 1 + ``strain`` x random; 0 is rest."""
    q = torch.linalg.qr(normal((count, 3, 3), seed))[0][..., :2]
    stretch = torch.eye(2, dtype=torch.float64) + strain * normal((count, 2, 2), seed + 1)
    return (q @ stretch).unbind(-1)  # type: ignore[return-value]


def surface(f1: Tensor, f2: Tensor) -> Surface:
    """Build the kinematics of triangles with the given deformation columns, 1 m^2 each, at rest."""
    raw = cross(f1, f2)
    J = dot(raw, raw).sqrt()
    n = raw / J
    area = torch.ones(f1.shape[-2], 1, dtype=f1.dtype)
    return Surface(f1, f2, cross(f2, n), cross(n, f1), n, J, area, torch.zeros_like(f1))


def directors(n: Tensor, points: int, seed: int) -> Tensor:
    """Draw elastic directors [E, S, 3] about the normals [E, 1, 3]: separated, sliding and sticking."""
    shape = (n.shape[0], points)
    height = 1 + 0.3 * normal((*shape, 1), seed)
    size = 10.0 ** normal((*shape, 1), seed + 1).clamp(-1.0, 0.5).sub(0.5)  # 0.03 to 1: both sides of a cone
    return height * n + size * normal((*shape, 3), seed + 2)
