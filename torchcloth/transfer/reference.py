"""Contact through the grid in plain torch: the definition that faster kernels are compared with.

Quadratic B-splines on a grid that wraps around: node indices are taken modulo a size that exceeds the cloth's extent,
so the cloth may travel anywhere in space without leaving the grid.
"""

from __future__ import annotations

import torch
from torch import Tensor


def exchange(
    position: Tensor,
    velocity: Tensor,
    affine: Tensor,
    mass: Tensor,
    pull: Tensor,
    director: Tensor,
    spacing: float,
    nodes: int,
    dt: float,
) -> tuple[Tensor, Tensor]:
    """Carry the points' momentum to the grid, let the directors' forces act there, bring the change back.

    Args:
        position: [B, P, 3] m. The extent along each axis must stay below (nodes - 3) spacing.
        velocity: [B, P, 3] m/s, before contact.
        affine: [B, P, 3, 3] 1/s, velocity gradient at each point, derived from the mesh.
        mass: [B or 1, P, 1] kg, share of each point.
        pull: [B, P, 3] N m, V d(psi)/d(d3): what the director's energy does through the grid's velocity gradient.
        director: [B, P, 3], d3.
        spacing: grid spacing [m].
        nodes: nodes per axis before the grid repeats.
        dt: substep [s].

    Returns:
        (change of each point's velocity [B, P, 3] m/s from the contact forces,
        velocity gradient of the grid at each point [B, P, 3, 3] 1/s)
    """
    batch, points, _ = position.shape
    scaled = position / spacing
    base = torch.floor(scaled.detach() - 0.5)
    offset = scaled - base  # in [0.5, 1.5)
    weight, slope = _splines(offset, spacing)
    index = _node_index(base.long(), nodes)

    step = torch.arange(3, dtype=position.dtype, device=position.device)
    lattice = torch.cartesian_prod(step, step, step)
    arm = (lattice - offset.unsqueeze(-2)) * spacing  # [B, P, 27, 3]
    carried = velocity.unsqueeze(-2) + arm @ affine.mT
    share = mass.unsqueeze(-2) * weight.unsqueeze(-1)
    force = -(slope @ director.unsqueeze(-1)) * pull.unsqueeze(-2)
    payload = torch.cat([share, share * carried, force], dim=-1)

    grid = payload.new_zeros(batch * nodes**3, 7).index_add(0, index.reshape(-1), payload.reshape(-1, 7))
    seen = grid.index_select(0, index.reshape(-1)).reshape(batch, points, 27, 7)
    inverse = 1.0 / torch.where(seen[..., :1] > 0, seen[..., :1], 1.0)  # a weight of exactly 0 leaves an empty node
    change = dt * seen[..., 4:] * inverse
    moved = seen[..., 1:4] * inverse + change
    return (weight.unsqueeze(-1) * change).sum(-2), moved.mT @ slope


def _splines(offset: Tensor, spacing: float) -> tuple[Tensor, Tensor]:
    """Weights [B, P, 27] and their gradients [B, P, 27, 3] 1/m from the offset to the lowest node [B, P, 3]."""
    w = torch.stack([0.5 * (1.5 - offset) ** 2, 0.75 - (offset - 1) ** 2, 0.5 * (offset - 0.5) ** 2], dim=-2)
    d = torch.stack([offset - 1.5, 2 - 2 * offset, offset - 0.5], dim=-2) / spacing

    def outer(x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        xy = x[..., :, None] * y[..., None, :]
        return (xy[..., None] * z[..., None, None, :]).flatten(-3)

    (wx, wy, wz), (dx, dy, dz) = w.unbind(-1), d.unbind(-1)
    slope = torch.stack([outer(dx, wy, wz), outer(wx, dy, wz), outer(wx, wy, dz)], dim=-1)
    return outer(wx, wy, wz), slope


def _node_index(base: Tensor, nodes: int) -> Tensor:
    """Flat index of the 27 nodes of each point [B, P, 27], batches apart, wrapped around."""
    step = torch.arange(3, device=base.device)
    near = (base.unsqueeze(-2) + torch.cartesian_prod(step, step, step)) % nodes
    scene = torch.arange(base.shape[0], device=base.device)[:, None, None]
    return ((scene * nodes + near[..., 0]) * nodes + near[..., 1]) * nodes + near[..., 2]
