"""Find the vertices that were seen in a frame."""

from __future__ import annotations

from math import ceil

import torch
from torch import Tensor

from ..episodes.observed import Episode
from ..losses import find_closest_points
from ..meshes import Mesh

MAX_POINT_TO_SURFACE_M = 0.02  # points farther from the surface are not of this cloth


def find_seen_vertices(frames: Tensor, episode: Episode, mesh: Mesh) -> Tensor:
    """Return whether a measured point or a marker lies on a triangle of each vertex, [T, V] bool.

    Where points are sparser than vertices, the triangle may be as many edges away as the points are apart.

    Args:
        frames: [T, V, 3] m.
        episode: with its clouds and markers.
        mesh: of the cloth.
    """
    faces, seen = torch.as_tensor(mesh.faces), torch.zeros(frames.shape[:2], dtype=torch.bool)
    for t, (cloud, x) in enumerate(zip(episode.clouds, frames, strict=True)):
        if len(cloud):
            hits = find_closest_points(cloud, x, faces)
            is_near = (cloud - hits.interpolate(x)).norm(dim=-1) < MAX_POINT_TO_SURFACE_M
            seen[t, hits.corners[is_near].flatten()] = True
        if episode.markers is not None and episode.marker_places is not None:
            seen[t, episode.marker_places.corners[episode.markers[t].isfinite().all(-1)].flatten()] = True
    for _ in range(edges_between_points(episode, mesh) - 1):
        corners = seen[:, faces].any(-1, keepdim=True).expand(-1, -1, 3)
        wider = torch.zeros_like(seen, dtype=torch.int64)
        wider.scatter_add_(1, faces.flatten().expand(len(seen), -1), corners.flatten(1).long())
        seen = wider > 0
    return seen


def edges_between_points(episode: Episode, mesh: Mesh) -> int:
    """Return the number of mesh edges between neighbouring points, at least one."""
    counts = [len(cloud) for cloud in episode.clouds if len(cloud)]
    if not counts:
        return 1
    spacing = (float(mesh.area.sum()) / sorted(counts)[len(counts) // 2]) ** 0.5
    return max(1, ceil(spacing / mesh.mean_edge))
