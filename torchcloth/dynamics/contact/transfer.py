"""Transfer between contact points and grid nodes in torch: the definition that faster kernels are compared with.

Quadratic B-splines on a grid that wraps around. Node indices are taken modulo a size that exceeds the cloth's extent,
so the cloth may travel anywhere in space without leaving the grid.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from .grid import Grid


class Stencil(NamedTuple):
    """The 27 nodes around each of P points.

    Attributes:
        weight: [P, 27] -.
        weight_gradient: [P, 27, 3] 1/m.
        offset: [P, 3] in grid spacings, of the point from its lowest node.
        node: [27 P] int64, rows of a grid that holds only the nodes with points.
        inverse_mass: [P, 27] 1/kg, one over the mass on the node.
    """

    weight: Tensor
    weight_gradient: Tensor
    offset: Tensor
    node: Tensor
    inverse_mass: Tensor


def place_on_grid(
    position: Tensor, mass: Tensor, scene: Tensor, grid: Grid, node_scratch: Tensor, shift: Tensor
) -> Stencil:
    """Find the nodes around points, their weights and their masses.

    Args:
        position: [P, 3] m. The extent of a scene along each axis must stay below (nodes - 3) spacing.
        mass: [P, 1] kg, mass of each point.
        scene: [P] int64; points of different scenes do not interact.
        grid: spacing and size of the grid.
        node_scratch: int32 work memory, one entry per node and scene; overwritten.
        shift: [3] in grid spacings, by which the points lie farther along the grid's axes.
    """
    scaled = position / grid.spacing + shift.to(position)
    base = torch.floor(scaled.detach() - 0.5)
    offset = scaled - base  # in [0.5, 1.5)
    weight, weight_gradient = _splines(offset, grid.spacing)
    node = _compact(_node_index(base.long(), scene, grid.nodes).reshape(-1), node_scratch)
    total = sum_on_nodes(node, mass * weight)
    smallest = (
        torch.finfo(total.dtype).tiny ** 0.5
    )  # kg; a weight may be 0, and 1 / 1e-20 kg has an infinite derivative
    return Stencil(weight, weight_gradient, offset, node, 1.0 / torch.where(total > smallest, total, 1.0))


def transfer_director_forces(
    nodes: Stencil, energy_by_d3: Tensor, director: Tensor, spacing: float, dt: float
) -> tuple[Tensor, Tensor]:
    """Transfer the directors' forces -energy_by_d3 (d3 . grad w) on the nodes back to the points.

    This is the transpose of how points carry momentum to the nodes.

    Args:
        nodes: nodes of the points.
        energy_by_d3: [P, 3] N m, V d(psi)/d(d3): what the director's energy does through the grid's velocity gradient.
        director: [P, 3] -, d3.
        spacing: grid spacing [m].
        dt: substep [s].

    Returns:
        Change of each point's velocity [P, 3] m/s, and its moment about the point, change (x) arm [P, 3, 3] m^2/s.
    """
    force = -(nodes.weight_gradient @ director.unsqueeze(-1)) * energy_by_d3.unsqueeze(-2)
    change = dt * sum_on_nodes(nodes.node, force) * nodes.inverse_mass.unsqueeze(-1)
    weighted = nodes.weight.unsqueeze(-1) * change
    arm = (stencil_nodes(director) - nodes.offset.unsqueeze(-2)) * spacing
    return weighted.sum(-2), weighted.mT @ arm


def velocity_gradient(nodes: Stencil, mass: Tensor, velocity: Tensor, affine: Tensor, spacing: float) -> Tensor:
    """Compute the gradient [P, 3, 3] 1/s, at each point, of the velocity that all points together have on the grid.

    Args:
        nodes: nodes of the points.
        mass: [P, 1] kg.
        velocity: [P, 3] m/s.
        affine: [P, 3, 3] 1/s, velocity gradient at each point, derived from the mesh.
        spacing: grid spacing [m].
    """
    momentum = affine_momentum(nodes, mass, velocity, affine, spacing)
    return (sum_on_nodes(nodes.node, momentum) * nodes.inverse_mass.unsqueeze(-1)).mT @ nodes.weight_gradient


def affine_momentum(nodes: Stencil, mass: Tensor, velocity: Tensor, affine: Tensor, spacing: float) -> Tensor:
    """Compute what each point gives to its nodes, [P, 27, 3] kg m/s: its mass times the affine velocity around it."""
    per_spacing = spacing * affine
    at_lowest = velocity - (per_spacing @ nodes.offset.unsqueeze(-1)).squeeze(-1)
    at_nodes = at_lowest.unsqueeze(-2) + stencil_nodes(velocity) @ per_spacing.mT
    return (mass * nodes.weight).unsqueeze(-1) * at_nodes


def stencil_nodes(like: Tensor) -> Tensor:
    """Return the nodes of a stencil relative to its lowest one, [27, 3] in grid spacings."""
    step = torch.arange(3, dtype=like.dtype, device=like.device)
    return torch.cartesian_prod(step, step, step)


def sum_on_nodes(node: Tensor, field: Tensor) -> Tensor:
    """Sum over all points that share a node, and return the sums at every point: [P, 27, ...] -> [P, 27, ...]."""
    flat = field.flatten(0, 1)
    return torch.zeros_like(flat).index_add(0, node, flat).index_select(0, node).view(field.shape)


def _splines(offset: Tensor, spacing: float) -> tuple[Tensor, Tensor]:
    """Return weights [P, 27] and their gradients [P, 27, 3] 1/m from the offsets [P, 3] to the lowest node."""
    w = torch.stack([0.5 * (1.5 - offset) ** 2, 0.75 - (offset - 1) ** 2, 0.5 * (offset - 0.5) ** 2], dim=-2)
    d = torch.stack([offset - 1.5, 2 - 2 * offset, offset - 0.5], dim=-2) / spacing

    def outer(x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        xy = x[..., :, None] * y[..., None, :]
        return (xy[..., None] * z[..., None, None, :]).flatten(-3)

    (wx, wy, wz), (dx, dy, dz) = w.unbind(-1), d.unbind(-1)
    gradient = torch.stack([outer(dx, wy, wz), outer(wx, dy, wz), outer(wx, wy, dz)], dim=-1)
    return outer(wx, wy, wz), gradient


def _node_index(base: Tensor, scene: Tensor, nodes: int) -> Tensor:
    """Return the number of each of the 27 nodes of each point, [P, 27]; wrapped, and different for each scene."""
    x, y, z = ((base.unsqueeze(-1) + torch.arange(3, device=base.device)) % nodes).unbind(-2)
    plane = (scene[:, None] * nodes + x) * nodes
    return (((plane.unsqueeze(-1) + y.unsqueeze(-2)) * nodes).unsqueeze(-1) + z[:, None, None, :]).flatten(-3)


def _compact(node: Tensor, node_scratch: Tensor) -> Tensor:
    """Return rows [N] of a grid that holds only the nodes with points; equal nodes share a row.

    Each slot holds the number of the last entry that was written there, whichever that was: no sorting, no clearing.
    """
    node_scratch[node] = torch.arange(len(node), dtype=node_scratch.dtype, device=node.device)
    return node_scratch[node].long()
