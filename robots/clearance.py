"""Certified lower bounds of the distances between boxes, cylinders and spheres.

Alternating projections between two convex solids approach their nearest points. The plane between the last two points
then separates the solids by a certain distance, even if the iteration has not converged.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchcloth.errors import InvalidInput

from .arm import Primitive

MAX_PROJECTIONS = 200
DISTANCE_TOLERANCE_M = 1e-4  # accuracy of the bounds
MAX_RESOLVED_GAP_M = 0.10  # larger gaps between the bounding spheres of two solids are not refined
PRIMITIVE_KINDS = ("box", "cylinder", "sphere")


class NamedSolid(NamedTuple):
    """A solid with its name for messages.

    Attributes:
        name: for messages.
        primitive: the solid; its pose is [T, 4, 4] m, or [4, 4] if it does not move.
    """

    name: str
    primitive: Primitive


class Gap(NamedTuple):
    """The smallest distance between solids along a motion.

    Attributes:
        distance: m, a lower bound; at 0 or less the solids may overlap.
        first: name of one solid.
        second: name of the other solid.
        time: s, when they are nearest.
    """

    distance: float
    first: str
    second: str
    time: float

    def to_error(self, min_distance: float) -> InvalidInput:
        """Return the error for a distance below ``min_distance`` [m]."""
        return InvalidInput(
            f"{self.first} comes too near to {self.second} at t = {self.time:.3g} s",
            got=f"{self.distance:.3g} m" if self.distance > 0 else "they touch or cross",
            expected=f"at least {min_distance:g} m" if min_distance > 0 else "apart",
            remedy="turn the grippers less (roll), change heading, grips or path, or choose another orientation",
        )


class Solids(NamedTuple):
    """P solids at T times, as arrays.

    Attributes:
        kind: [P], index into ``PRIMITIVE_KINDS``.
        half: [P, 3] m, half extents along the solid's axes.
        pose: [T, P, 4, 4] m.
    """

    kind: Tensor
    half: Tensor
    pose: Tensor

    @classmethod
    def from_primitives(cls, primitives: Sequence[Primitive], count: int) -> Solids:
        """Collect primitives whose poses are [T, 4, 4] m, or [4, 4] m for solids that do not move; ``count`` is T."""
        kind = torch.tensor([PRIMITIVE_KINDS.index(p.kind) for p in primitives])
        half = torch.tensor([_half(p) for p in primitives], dtype=torch.float64)
        pose = torch.stack([p.pose.detach().double().expand(count, 4, 4) for p in primitives], dim=1)
        return cls(kind, half, pose)

    def select(self, time: Tensor, solid: Tensor) -> Solids:
        """Select N solids at one time each, by indices [N]: ``pose`` becomes [N, 4, 4]."""
        return Solids(self.kind[solid], self.half[solid], self.pose[time, solid])


def smallest_gap(
    solids: Sequence[NamedSolid], pairs: Sequence[tuple[int, int]], times: Tensor, min_distance: float = 0.0
) -> Gap:
    """Return the smallest distance among pairs of solids.

    Args:
        solids: with poses at T times.
        pairs: indices of the solids to compare.
        times: [T] s.
        min_distance: m, distance that must be resolved; distances above this and ``MAX_RESOLVED_GAP_M`` are not
            refined.
    """
    max_distance = max(MAX_RESOLVED_GAP_M, min_distance)
    best = Gap(max_distance, "", "", 0.0)
    if not pairs:
        return best
    arrays = Solids.from_primitives([solid.primitive for solid in solids], len(times))
    a, b = torch.tensor(pairs).T
    ball = arrays.half.norm(dim=-1)
    ball_gap = (arrays.pose[:, a, :3, 3] - arrays.pose[:, b, :3, 3]).norm(dim=-1) - ball[a] - ball[b]
    time, pair = torch.nonzero(ball_gap < max_distance, as_tuple=True)
    if not len(time):
        return best
    bound = bound_distances(arrays.select(time, a[pair]), arrays.select(time, b[pair]))
    nearest = int(bound.argmin())
    first, second = (solids[int(index[pair[nearest]])].name for index in (a, b))
    return min(
        best, Gap(float(bound[nearest]), first, second, float(times[time[nearest]])), key=lambda gap: gap.distance
    )


def bound_distances(a: Solids, b: Solids) -> Tensor:
    """Return lower bounds [N] m of the distances of N pairs of solids.

    The bounds are within ``DISTANCE_TOLERANCE_M`` of the distances if the solids do not touch.

    Args:
        a: N solids at one time each, as ``Solids.select`` gives them.
        b: as many.
    """
    x = a.pose[:, :3, 3]
    bound = torch.full((len(x),), -math.inf, dtype=torch.float64)
    for _ in range(MAX_PROJECTIONS):
        y = _project(b, x)
        x = _project(a, y)
        offset = y - x
        length = offset.norm(dim=-1)
        bound = torch.maximum(bound, _separation(a, b, offset, length))
        if bool((length - bound < DISTANCE_TOLERANCE_M).all()):
            break
    return bound


def _separation(a: Solids, b: Solids, offset: Tensor, length: Tensor) -> Tensor:
    """Width [N] m of the slab across ``offset`` [N, 3] that lies between both solids; negative if there is none."""
    d = offset / length.clamp(min=1e-12)[:, None]
    middle = ((b.pose[:, :3, 3] - a.pose[:, :3, 3]) * d).sum(-1)
    return torch.where(length > 1e-9, middle - _support(a, d) - _support(b, d), -1e-9)


def _support(s: Solids, d: Tensor) -> Tensor:
    """How far [N] m the solids reach from their centres along unit vectors ``d`` [N, 3]."""
    local = (s.pose[:, :3, :3].mT @ d[..., None])[..., 0].abs()
    box = (local * s.half).sum(-1)
    cylinder = s.half[:, 0] * local[:, :2].norm(dim=-1) + s.half[:, 2] * local[:, 2]
    return torch.where(s.kind == 0, box, torch.where(s.kind == 1, cylinder, s.half[:, 0]))


def _project(s: Solids, p: Tensor) -> Tensor:
    """Points [N, 3] m of the solids that are nearest to ``p`` [N, 3] m."""
    rotation, centre = s.pose[:, :3, :3], s.pose[:, :3, 3]
    local = (rotation.mT @ (p - centre)[..., None])[..., 0]
    box = local.clamp(-s.half, s.half)
    radius = s.half[:, :1]
    flat = local[:, :2] * (radius / local[:, :2].norm(dim=-1, keepdim=True).clamp(min=1e-12)).clamp(max=1)
    cylinder = torch.cat([flat, box[:, 2:]], dim=-1)
    sphere = local * (radius / local.norm(dim=-1, keepdim=True).clamp(min=1e-12)).clamp(max=1)
    kind = s.kind[:, None]
    nearest = torch.where(kind == 0, box, torch.where(kind == 1, cylinder, sphere))
    return (rotation @ nearest[..., None])[..., 0] + centre


def _half(p: Primitive) -> tuple[float, float, float]:
    match p.kind:
        case "box":
            return p.size[0] / 2, p.size[1] / 2, p.size[2] / 2
        case "cylinder":
            return p.size[0], p.size[0], p.size[1] / 2
        case "sphere":
            return p.size[0], p.size[0], p.size[0]
    raise InvalidInput("kind of a primitive", got=repr(p.kind), expected=f"one of {', '.join(PRIMITIVE_KINDS)}")
