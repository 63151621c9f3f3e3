"""Residuals of the rim: where the cloud ends, compared with the end of the simulated sheet.

Points show the place of the surface along its normal, and nothing of what lies within it; only the rim shows that. The
mean of the points beyond the rim would not do: noise alone puts some of them there, without a counterpart inside. So
the rim is estimated from all points in a band along it, which are taken as evenly spread up to an end at s. With
weights that grow linearly from 0 at the band's inner side, w = (d + h) / h, the mean of d is 2 (s + h) / 3 - h. Noise
of standard deviation e moves the end by 2 e^2 / h, which is some 0.1 mm, and erosion by the sensor moves it more. An
offset that all frames share is a nuisance of its own (``nuisances.RimOffset``).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ..._utils.linalg import cross, dot
from ...episodes.observed_surface import RIM_BAND_M, Rim
from ...losses import ClosestPoints
from .rows import ResidualRows, SimulatedEpisode, concatenate_rows

MIN_POINTS_PER_RIM_PIECE = 4  # points in a band that show an end
MAX_DISTANCE_BEYOND_RIM_M = 0.05  # farther points belong to something else


class _Pairs(NamedTuple):
    """Points and the edges of the rim that they lie near.

    Attributes:
        edge: [P] int64.
        distance: [P] m, across the edge, positive outside.
        place: [P] from the edge's first vertex (0) to its second (1).
    """

    edge: Tensor
    distance: Tensor
    place: Tensor


def edge_rows(scene: SimulatedEpisode) -> ResidualRows | None:
    """Compute how much farther out the cloud ends than the sheet, for every piece of the rim [m].

    The residual is 0 where the piece's end cannot be seen.
    """
    rim, frames, derivatives = scene.surface.rim, scene.frames, scene.derivatives
    if rim.piece_count == 0:
        return None
    parts = []
    for t, hits in scene.hits.items():
        x = frames.x[t]
        pairs = _pair_points_with_edges(scene.episode.clouds[t], hits, x, rim)
        piece, weight = rim.piece[pairs.edge], (pairs.distance + RIM_BAND_M) / RIM_BAND_M
        ones = torch.ones_like(weight)
        total, weighted_distance, count = weight.new_zeros(3, rim.piece_count).index_add(
            1, piece, torch.stack([weight, weight * pairs.distance, ones])
        )
        is_shown = count >= MIN_POINTS_PER_RIM_PIECE
        total = torch.where(is_shown, total, 1.0)
        end = 1.5 * weighted_distance / total + 0.5 * RIM_BAND_M
        residual = torch.where(is_shown, end - frames.rim_offset[t], 0.0)
        jacobian = None
        if derivatives is not None:
            ends = derivatives.x[:, t].index_select(-2, rim.edges[pairs.edge].reshape(-1)).unflatten(-2, (-1, 2))
            foot = ends[..., 0, :] + pairs.place[:, None] * (ends[..., 1, :] - ends[..., 0, :])
            slope = weight * dot(foot, _outward_normals(x, rim)[pairs.edge]).squeeze(-1)
            slope = slope.new_zeros(len(slope), rim.piece_count).index_add(1, piece, slope)
            jacobian = torch.where(is_shown, -slope / total - derivatives.rim_offset[:, t, None], 0.0).mT
        parts.append(ResidualRows(residual, jacobian, torch.full((rim.piece_count,), t), rim.labels))
    return concatenate_rows(parts)


def _outward_normals(x: Tensor, rim: Rim) -> Tensor:
    """[B, 3] unit vectors in the plane of the rim's triangles, across the edges."""
    a, b, c = x[rim.edges[:, 0]], x[rim.edges[:, 1]], x[rim.opposite]
    out = cross(b - a, cross(b - a, c - a))
    return out / dot(out, out).sqrt()


def _pair_points_with_edges(cloud: Tensor, hits: ClosestPoints, x: Tensor, rim: Rim) -> _Pairs:
    """Points in the band of an edge, with their foot on it. Near a corner a point may belong to two pieces."""
    rest_distance = (hits.weights.unsqueeze(-1) * rim.distance[hits.corners]).sum(-2)  # [N, B] m, of the hits
    near = (rest_distance.amin(1) < 2 * RIM_BAND_M).nonzero().squeeze(-1)
    points, rest_distance = cloud[near], rest_distance[near]
    a, along = x[rim.edges[:, 0]], x[rim.edges[:, 1]] - x[rim.edges[:, 0]]
    outward = _outward_normals(x, rim)
    offset = points[:, None] - a
    place = (dot(offset, along) / dot(along, along)).squeeze(-1)
    distance = dot(offset, outward).squeeze(-1)
    height = (offset - place[..., None] * along - distance[..., None] * outward).norm(dim=-1)
    is_beside_edge = (place >= 0) & (place < 1)
    is_in_band = (distance > -RIM_BAND_M) & (distance < MAX_DISTANCE_BEYOND_RIM_M) & (height < RIM_BAND_M)
    is_same_layer = rest_distance < 2 * RIM_BAND_M
    point, edge = (is_beside_edge & is_in_band & is_same_layer).nonzero(as_tuple=True)
    return _Pairs(edge, distance[point, edge], place[point, edge])
