"""Rigid registration of a mesh to a point cloud from many starts, by iterated closest points."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

TURNS = 8  # starts about the cloud's normal, for either side up
ROUNDS = 40
SAMPLES, JUDGES = 400, 1500  # points that take part, and that the poses found are compared by
NEAR = 0.03  # m; pairs much farther apart hardly count
TIE = 1.08  # poses whose misfits are within this factor cannot be told apart by them
TRIES, SAME = 4, 0.35  # poses that are handed on; rad, nearer than this they are one
SIDE = 0.3  # rad; of two like poses the one that keeps the upper side up may turn this much more


class Pose(NamedTuple):
    """x -> R x + t."""

    R: Tensor  # [..., 3, 3]
    t: Tensor  # [..., 3] m

    def of(self, x: Tensor) -> Tensor:
        """[..., N, 3] m."""
        return x @ self.R.mT + self.t.unsqueeze(-2)


def register(x: Tensor, faces: Tensor, points: Tensor) -> list[Pose]:
    """Rigid motions that lay a mesh of vertices [V, 3] m on points [N, 3] m of one side of it, the likeliest first.

    Both ways count, point to nearest vertex and vertex to nearest point: points alone would also fit into the middle of
    a cloth larger than they are. Garments look alike from the front and from behind; of poses that fit alike, the one
    that turns the vertices least comes first.
    """
    some, few = _some(x, SAMPLES), _some(points, SAMPLES)
    pose = _starts(some, few)
    for _ in range(ROUNDS):
        placed = pose.of(some)
        (to_point, point), (to_vertex, vertex) = _nearest(placed, few)
        source = torch.cat([some.expand_as(placed), some[vertex]], dim=-2)
        target = torch.cat([few[point], few.expand(len(placed), -1, -1)], dim=-2)
        share = [d.new_full(d.shape, 1 / d.shape[-1]) / (1 + (d / NEAR) ** 2) for d in (to_point, to_vertex)]
        pose = _kabsch(source, target, torch.cat(share, dim=-1))
    surface, many = torch.cat([x, x[faces].mean(1)]), _some(points, JUDGES)
    score = torch.stack([_misfit(one.of(surface), many) for one in map(Pose, *pose)])
    return _shortlist(pose, score, _axes(x)[:, 2])


def _nearest(placed: Tensor, points: Tensor):
    """((distance, point) of every placed vertex, (distance, vertex) of every point)."""
    distance = torch.cdist(placed, points.expand(*placed.shape[:-2], -1, -1))
    return distance.min(-1), distance.min(-2)


def _misfit(placed: Tensor, points: Tensor) -> Tensor:
    """[] m, both ways; what lies far apart counts as far, not how far."""
    (to_point, _), (to_surface, _) = _nearest(placed, points)
    return torch.stack([d.clamp(max=2 * NEAR).square().mean().sqrt() for d in (to_point, to_surface)]).sum()


def _shortlist(pose: Pose, score: Tensor, normal: Tensor) -> list[Pose]:
    """Different poses, first those that fit about as well as the best, the least turned one leading; then by fit."""
    turn = _angle(pose.R) - SIDE * (pose.R @ normal) @ normal
    close = score <= TIE * score.min()
    order = torch.where(close, turn - 10.0, score / score.min()).argsort().tolist()
    kept: list[int] = []
    for k in order:
        if len(kept) < TRIES and all(_angle(pose.R[k] @ pose.R[other].mT) > SAME for other in kept):
            kept.append(k)
    return [Pose(pose.R[k], pose.t[k]) for k in kept]


def _angle(R: Tensor) -> Tensor:
    """[...] rad of rotations [..., 3, 3]."""
    return ((R.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2).clamp(-1, 1).acos()


def _starts(x: Tensor, points: Tensor) -> Pose:
    """Principal axes on principal axes, turned about the last; and the vertices as they lie, only moved."""
    mine, theirs = _axes(x), _axes(points)
    rotations = [torch.eye(3, dtype=x.dtype)]
    for k in range(TURNS):
        c, s = math.cos(2 * math.pi * k / TURNS), math.sin(2 * math.pi * k / TURNS)
        turn = x.new_tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        flip = torch.diag(x.new_tensor([1.0, -1.0, -1.0]))
        rotations += [theirs @ turn @ mine.mT, theirs @ turn @ flip @ mine.mT]
    R = torch.stack(rotations)
    return Pose(R, points.mean(0) - R @ x.mean(0))


def _axes(x: Tensor) -> Tensor:
    """[3, 3] right-handed principal axes as columns, the longest extent first."""
    axes = torch.linalg.svd(x - x.mean(0), full_matrices=False).Vh.mT
    return axes * x.new_tensor([1.0, 1.0, float(torch.linalg.det(axes).sign())])


def _kabsch(source: Tensor, target: Tensor, weight: Tensor) -> Pose:
    """The rigid motions [S] of weighted least squares from source to target [S, N, 3] (Kabsch 1976)."""
    weight = (weight / weight.sum(-1, keepdim=True)).unsqueeze(-1)
    a, b = (weight * source).sum(-2, keepdim=True), (weight * target).sum(-2, keepdim=True)
    U, _, Vh = torch.linalg.svd((weight * (target - b)).mT @ (source - a))
    sign = torch.ones_like(a.squeeze(-2))
    sign[..., 2] = torch.linalg.det(U @ Vh)
    R = (U * sign.unsqueeze(-2)) @ Vh
    return Pose(R, (b - a @ R.mT).squeeze(-2))


def _some(x: Tensor, count: int) -> Tensor:
    """At most ``count`` of the rows, drawn in the same way every time."""
    order = torch.randperm(len(x), generator=torch.Generator().manual_seed(0))
    return x[order[:count]]
