"""Contact through the grid in plain torch: the definition that faster kernels are compared with.

Quadratic B-splines on a grid that wraps around: node indices are taken modulo a size that exceeds the cloth's extent,
so the cloth may travel anywhere in space without leaving the grid.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from .grid import Grid


class Stencil(NamedTuple):
    """The 27 nodes around each point."""

    weight: Tensor  # [P, 27]
    weight_gradient: Tensor  # [P, 27, 3] 1/m, gradient of the weight
    offset: Tensor  # [P, 3] grid spacings, from the lowest node
    node: Tensor  # [27 P] int64, rows of a grid that holds only the nodes that are touched
    inverse_mass: Tensor  # [P, 27] 1/kg, one over the mass on the node


def place_on_grid(position: Tensor, mass: Tensor, scene: Tensor, grid: Grid, slots: Tensor) -> Stencil:
    """Place points on the grid.

    Args:
        position: [P, 3] m. The extent of a scene along each axis must stay below (nodes - 3) spacing.
        mass: [P, 1] kg, share of each point.
        scene: [P] int64; points of different scenes do not meet.
        grid: its spacing and size.
        slots: int32 scratch, one entry per node and scene, overwritten.
    """
    scaled = position / grid.spacing
    base = torch.floor(scaled.detach() - 0.5)
    offset = scaled - base  # in [0.5, 1.5)
    weight, slope = _splines(offset, grid.spacing)
    node = _compact(_node_index(base.long(), scene, grid.nodes).reshape(-1), slots)
    total = sum_on_nodes(node, mass * weight)
    least = torch.finfo(total.dtype).tiny ** 0.5  # kg; a weight may be 0, and the derivative of 1 / 1e-20 kg overflows
    return Stencil(weight, slope, offset, node, 1.0 / torch.where(total > least, total, 1.0))


def transfer_director_forces(nodes: Stencil, pull: Tensor, director: Tensor, spacing: float, dt: float) -> tuple[Tensor, Tensor]:
    """What the directors' forces -pull (d3 . grad w) on the nodes do to the points: the transpose of how they carry.

    Args:
        nodes: of the points.
        pull: [P, 3] N m, V d(psi)/d(d3): what the director's energy does through the grid's velocity gradient.
        director: [P, 3], d3.
        spacing: grid spacing [m].
        dt: substep [s].

    Returns:
        (change of each point's velocity [P, 3] m/s, its moment about the point: change (x) arm [P, 3, 3] m^2/s)
    """
    force = -(nodes.weight_gradient @ director.unsqueeze(-1)) * pull.unsqueeze(-2)
    change = dt * sum_on_nodes(nodes.node, force) * nodes.inverse_mass.unsqueeze(-1)
    weighted = nodes.weight.unsqueeze(-1) * change
    arm = (stencil_nodes(director) - nodes.offset.unsqueeze(-2)) * spacing
    return weighted.sum(-2), weighted.mT @ arm


def velocity_gradient(nodes: Stencil, mass: Tensor, velocity: Tensor, affine: Tensor, spacing: float) -> Tensor:
    """Gradient [P, 3, 3] 1/s at each point of the velocity that all points together have on the grid.

    Args:
        nodes: of the points.
        mass: [P, 1] kg.
        velocity: [P, 3] m/s.
        affine: [P, 3, 3] 1/s, velocity gradient at each point, derived from the mesh.
        spacing: grid spacing [m].
    """
    momentum = affine_momentum(nodes, mass, velocity, affine, spacing)
    return (sum_on_nodes(nodes.node, momentum) * nodes.inverse_mass.unsqueeze(-1)).mT @ nodes.weight_gradient


def affine_momentum(nodes: Stencil, mass: Tensor, velocity: Tensor, affine: Tensor, spacing: float) -> Tensor:
    """What each point gives to its nodes [P, 27, 3] kg m/s: its mass times the affine velocity field around it."""
    spread = spacing * affine
    lowest = velocity - (spread @ nodes.offset.unsqueeze(-1)).squeeze(-1)  # the affine field at the lowest node
    carried = lowest.unsqueeze(-2) + stencil_nodes(velocity) @ spread.mT
    return (mass * nodes.weight).unsqueeze(-1) * carried


def stencil_nodes(like: Tensor) -> Tensor:
    """[27, 3] grid spacings, the nodes of a stencil from its lowest one."""
    step = torch.arange(3, dtype=like.dtype, device=like.device)
    return torch.cartesian_prod(step, step, step)


def sum_on_nodes(node: Tensor, field: Tensor) -> Tensor:
    """Sum on the nodes, seen from each point again: [P, 27, ...] -> [P, 27, ...]."""
    flat = field.flatten(0, 1)
    return torch.zeros_like(flat).index_add(0, node, flat).index_select(0, node).view(field.shape)


def _splines(offset: Tensor, spacing: float) -> tuple[Tensor, Tensor]:
    """Weights [P, 27] and their gradients [P, 27, 3] 1/m from the offset to the lowest node [P, 3]."""
    w = torch.stack([0.5 * (1.5 - offset) ** 2, 0.75 - (offset - 1) ** 2, 0.5 * (offset - 0.5) ** 2], dim=-2)
    d = torch.stack([offset - 1.5, 2 - 2 * offset, offset - 0.5], dim=-2) / spacing

    def outer(x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        xy = x[..., :, None] * y[..., None, :]
        return (xy[..., None] * z[..., None, None, :]).flatten(-3)

    (wx, wy, wz), (dx, dy, dz) = w.unbind(-1), d.unbind(-1)
    slope = torch.stack([outer(dx, wy, wz), outer(wx, dy, wz), outer(wx, wy, dz)], dim=-1)
    return outer(wx, wy, wz), slope


def _node_index(base: Tensor, scene: Tensor, nodes: int) -> Tensor:
    """Number of each of the 27 nodes of each point [P, 27], scenes apart, wrapped around."""
    x, y, z = ((base.unsqueeze(-1) + torch.arange(3, device=base.device)) % nodes).unbind(-2)
    plane = (scene[:, None] * nodes + x) * nodes
    return (((plane.unsqueeze(-1) + y.unsqueeze(-2)) * nodes).unsqueeze(-1) + z[:, None, None, :]).flatten(-3)


def _compact(node: Tensor, slots: Tensor) -> Tensor:
    """Rows [N] of a grid that holds only the nodes that are touched; equal nodes share a row.

    Each node remembers the last visitor that wrote its number there, whoever that was: no sorting, no clearing.
    """
    slots[node] = torch.arange(len(node), dtype=slots.dtype, device=node.device)
    return slots[node].long()
