"""Which vertices were seen in a frame, and which were hidden."""

from __future__ import annotations

from math import ceil

import torch
from torch import Tensor

from ..episodes.observed import Episode
from ..losses import closest
from ..meshes import Mesh

FAR = 0.02  # m; points farther from the surface are not of this cloth


def seen_vertices(frames: Tensor, episode: Episode, mesh: Mesh) -> Tensor:
    """[T, V] bool, whether a measured point lies on a triangle of the vertex, or a marker does.

    Where points are sparser than vertices: on a triangle as many edges away as the points are apart.
    """
    faces, out = torch.as_tensor(mesh.faces), torch.zeros(frames.shape[:2], dtype=torch.bool)
    for t, (cloud, x) in enumerate(zip(episode.clouds, frames, strict=True)):
        if len(cloud):
            hits = closest(cloud, x, faces)
            near = (cloud - hits.on(x)).norm(dim=-1) < FAR
            out[t, hits.corners[near].flatten()] = True
        if episode.markers is not None and episode.places is not None:
            out[t, episode.places.corners[episode.markers[t].isfinite().all(-1)].flatten()] = True
    for _ in range(rings(episode, mesh) - 1):
        corners = out[:, faces].any(-1, keepdim=True).expand(-1, -1, 3)
        wider = torch.zeros_like(out, dtype=torch.int64)
        wider.scatter_add_(1, faces.flatten().expand(len(out), -1), corners.flatten(1).long())
        out = wider > 0
    return out


def rings(episode: Episode, mesh: Mesh) -> int:
    """Edges of the mesh between neighbouring points, at least one."""
    counts = [len(cloud) for cloud in episode.clouds if len(cloud)]
    if not counts:
        return 1
    apart = (float(mesh.area.sum()) / sorted(counts)[len(counts) // 2]) ** 0.5
    return max(1, ceil(apart / mesh.mean_edge))
