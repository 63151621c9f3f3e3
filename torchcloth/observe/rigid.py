"""Rigid registration of a mesh to a point cloud from many starts, by iterated closest points (ICP)."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

START_TURNS = 8  # start rotations about the cloud's normal, for either side up
ICP_ITERATIONS = 40
ICP_POINTS = 400
SCORING_POINTS = 1500  # points by which the resulting poses are compared
PAIR_DISTANCE_SCALE_M = 0.03  # pairs that are much farther apart hardly count
MISFIT_TIE_RATIO = 1.08  # poses with misfits within this factor fit equally well
MAX_CANDIDATE_POSES = 4
MIN_POSE_SEPARATION_RAD = 0.35  # poses that are nearer to each other are one
UPPER_SIDE_BONUS_RAD = 0.3  # of two equally good poses, the one that keeps the upper side up may turn this much more
TIE_RANK_OFFSET = -10.0  # ranks tied poses before all others


class Pose(NamedTuple):
    """A rigid motion x -> R x + t.

    Attributes:
        R: [..., 3, 3].
        t: [..., 3] m.
    """

    R: Tensor
    t: Tensor

    def transform(self, x: Tensor) -> Tensor:
        """Transform points [..., N, 3] m."""
        return x @ self.R.mT + self.t.unsqueeze(-2)


def register_rigidly(x: Tensor, faces: Tensor, points: Tensor) -> list[Pose]:
    """Compute rigid motions that lay a mesh on points of one side of it, the most likely first.

    Distances count both ways, from points to their nearest vertices and from vertices to their nearest points: points
    alone would also fit into the middle of a larger cloth. Garments look the same from the front and from behind. Of
    poses that fit equally well, the one that turns the vertices least comes first.

    Args:
        x: [V, 3] m, vertices of the mesh.
        faces: [F, 3], its triangles.
        points: [N, 3] m.
    """
    mesh_sample, point_sample = _sample(x, ICP_POINTS), _sample(points, ICP_POINTS)
    pose = _starts(mesh_sample, point_sample)
    for _ in range(ICP_ITERATIONS):
        placed = pose.transform(mesh_sample)
        (to_point, point), (to_vertex, vertex) = _nearest(placed, point_sample)
        source = torch.cat([mesh_sample.expand_as(placed), mesh_sample[vertex]], dim=-2)
        target = torch.cat([point_sample[point], point_sample.expand(len(placed), -1, -1)], dim=-2)
        weights = [
            d.new_full(d.shape, 1 / d.shape[-1]) / (1 + (d / PAIR_DISTANCE_SCALE_M) ** 2) for d in (to_point, to_vertex)
        ]
        pose = fit_pose(source, target, torch.cat(weights, dim=-1))
    surface, scoring_sample = torch.cat([x, x[faces].mean(1)]), _sample(points, SCORING_POINTS)
    score = torch.stack([_misfit(one.transform(surface), scoring_sample) for one in map(Pose, *pose)])
    return _shortlist(pose, score, _axes(x)[:, 2])


def _nearest(placed: Tensor, points: Tensor):
    """((distance, point) of every placed vertex, (distance, vertex) of every point)."""
    distance = torch.cdist(placed, points.expand(*placed.shape[:-2], -1, -1))
    return distance.min(-1), distance.min(-2)


def _misfit(placed: Tensor, points: Tensor) -> Tensor:
    """Misfit [] m, both ways; distances beyond twice the scale count as that."""
    (to_point, _), (to_surface, _) = _nearest(placed, points)
    return torch.stack(
        [d.clamp(max=2 * PAIR_DISTANCE_SCALE_M).square().mean().sqrt() for d in (to_point, to_surface)]
    ).sum()


def _shortlist(pose: Pose, score: Tensor, normal: Tensor) -> list[Pose]:
    """Different poses: first those that fit about as well as the best, the least turned one leading; then by misfit."""
    turn = _angle(pose.R) - UPPER_SIDE_BONUS_RAD * (pose.R @ normal) @ normal
    close = score <= MISFIT_TIE_RATIO * score.min()
    order = torch.where(close, turn + TIE_RANK_OFFSET, score / score.min()).argsort().tolist()
    chosen: list[int] = []
    for k in order:
        if len(chosen) < MAX_CANDIDATE_POSES and all(
            _angle(pose.R[k] @ pose.R[other].mT) > MIN_POSE_SEPARATION_RAD for other in chosen
        ):
            chosen.append(k)
    return [Pose(pose.R[k], pose.t[k]) for k in chosen]


def _angle(R: Tensor) -> Tensor:
    """Rotation angles [...] rad of rotations [..., 3, 3]."""
    return ((R.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2).clamp(-1, 1).acos()


def _starts(x: Tensor, points: Tensor) -> Pose:
    """Start poses: principal axes aligned and turned about the last; and the vertices as they lie, only moved."""
    mine, theirs = _axes(x), _axes(points)
    rotations = [torch.eye(3, dtype=x.dtype)]
    for k in range(START_TURNS):
        c, s = math.cos(2 * math.pi * k / START_TURNS), math.sin(2 * math.pi * k / START_TURNS)
        turn = x.new_tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        flip = torch.diag(x.new_tensor([1.0, -1.0, -1.0]))
        rotations += [theirs @ turn @ mine.mT, theirs @ turn @ flip @ mine.mT]
    R = torch.stack(rotations)
    return Pose(R, points.mean(0) - R @ x.mean(0))


def _axes(x: Tensor) -> Tensor:
    """[3, 3] right-handed principal axes as columns, the longest extent first."""
    axes = torch.linalg.svd(x - x.mean(0), full_matrices=False).Vh.mT
    return axes * x.new_tensor([1.0, 1.0, float(torch.linalg.det(axes).sign())])


def fit_pose(source: Tensor, target: Tensor, weight: Tensor) -> Pose:
    """Compute the rigid motions [S] of weighted least squares from source to target points (Kabsch 1976).

    Args:
        source: [S, N, 3] m.
        target: [S, N, 3] m.
        weight: [S, N].
    """
    weight = (weight / weight.sum(-1, keepdim=True)).unsqueeze(-1)
    a, b = (weight * source).sum(-2, keepdim=True), (weight * target).sum(-2, keepdim=True)
    U, _, Vh = torch.linalg.svd((weight * (target - b)).mT @ (source - a))
    sign = torch.ones_like(a.squeeze(-2))
    sign[..., 2] = torch.linalg.det(U @ Vh)
    R = (U * sign.unsqueeze(-2)) @ Vh
    return Pose(R, (b - a @ R.mT).squeeze(-2))


def _sample(x: Tensor, count: int) -> Tensor:
    """At most ``count`` of the rows, drawn the same way every time."""
    order = torch.randperm(len(x), generator=torch.Generator().manual_seed(0))
    return x[order[:count]]
