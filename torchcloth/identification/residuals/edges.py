"""Where the rim of a cloud is, against the rim of the simulated sheet.

Points show the surface's place along its normal, and nothing of what lies within it; only the rim shows that. The mean
of the points beyond the rim would not do: noise alone puts some of them there, and there is no counterpart inside. So
the rim is estimated from all points in a band along it, taken as evenly spread up to an end at s. With weights that
grow linearly from 0 at the band's inner side, w = (d + h) / h, the mean of d is 2 (s + h) / 3 - h. Noise of standard
deviation e moves the end by 2 e^2 / h, which is some 0.1 mm, and erosion by the sensor more: an offset that all frames
share is a nuisance of its own (``nuisances.Rim``).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ..._utils.linalg import cross, dot
from ...episodes.observed_surface import BAND, Rim
from ...losses import Hits
from .rows import Rows, Scene, joined

FEWEST = 4  # points in a band that show an end
FARTHEST = 0.05  # m beyond the rim; farther points belong to something else


class _Pairs(NamedTuple):
    """Points and the rim's edges beside which they lie."""

    edge: Tensor  # [P]
    distance: Tensor  # [P] m, across the edge, positive outside
    place: Tensor  # [P] from the edge's first vertex (0) to its second (1)


def edge_rows(scene: Scene) -> Rows | None:
    """How much farther out the cloud ends than the sheet, for every piece of the rim; 0 where it cannot be seen."""
    rim, (seen, moved) = scene.sheet.rim, (scene.seen, scene.moved)
    if rim.count == 0:
        return None
    parts = []
    for t, hits in scene.hits.items():
        x = seen.x[t]
        pairs = _pairs(scene.episode.clouds[t], hits, x, rim)
        piece, weight = rim.piece[pairs.edge], (pairs.distance + BAND) / BAND
        ones = torch.ones_like(weight)
        total, mean, count = weight.new_zeros(3, rim.count).index_add(
            1, piece, torch.stack([weight, weight * pairs.distance, ones])
        )
        shown = count >= FEWEST
        total = torch.where(shown, total, 1.0)
        value = torch.where(shown, 1.5 * mean / total + 0.5 * BAND - seen.edge[t], 0.0)
        jacobian = None
        if moved is not None:
            ends = moved.x[:, t].index_select(-2, rim.edges[pairs.edge].reshape(-1)).unflatten(-2, (-1, 2))
            foot = ends[..., 0, :] + pairs.place[:, None] * (ends[..., 1, :] - ends[..., 0, :])
            pull = weight * dot(foot, _outward(x, rim)[pairs.edge]).squeeze(-1)
            pull = pull.new_zeros(len(pull), rim.count).index_add(1, piece, pull)
            jacobian = torch.where(shown, -pull / total - moved.edge[:, t, None], 0.0).mT
        parts.append(Rows(value, jacobian, torch.full((rim.count,), t), rim.label))
    return joined(parts)


def _outward(x: Tensor, rim: Rim) -> Tensor:
    """[B, 3], unit vectors in the plane of the rim's triangles, across the edges."""
    a, b, c = x[rim.edges[:, 0]], x[rim.edges[:, 1]], x[rim.opposite]
    out = cross(b - a, cross(b - a, c - a))
    return out / dot(out, out).sqrt()


def _pairs(cloud: Tensor, hits: Hits, x: Tensor, rim: Rim) -> _Pairs:
    """Points in the band of an edge, with their foot on it. Near a corner a point may belong to two pieces."""
    material = (hits.weights.unsqueeze(-1) * rim.distance[hits.corners]).sum(-2)  # [N, B] m, of the hits at rest
    near = (material.amin(1) < 2 * BAND).nonzero().squeeze(-1)
    points, material = cloud[near], material[near]
    a, along = x[rim.edges[:, 0]], x[rim.edges[:, 1]] - x[rim.edges[:, 0]]
    outward = _outward(x, rim)
    offset = points[:, None] - a
    place = (dot(offset, along) / dot(along, along)).squeeze(-1)
    distance = dot(offset, outward).squeeze(-1)
    height = (offset - place[..., None] * along - distance[..., None] * outward).norm(dim=-1)
    inside = (place >= 0) & (place < 1) & (distance > -BAND) & (distance < FARTHEST) & (height < BAND)
    point, edge = (inside & (material < 2 * BAND)).nonzero(as_tuple=True)  # no other layer's points
    return _Pairs(edge, distance[point, edge], place[point, edge])
