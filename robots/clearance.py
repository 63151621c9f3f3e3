"""How far solids stay apart: certified lower bounds of the distances between boxes, cylinders and spheres.

Alternating projections between two convex solids approach their nearest points; the plane between the last two points
then separates the solids by a distance that is certain, however far the iteration came.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchcloth.errors import InvalidInput

from .arm import Primitive

ROUNDS = 200
EXACT = 1e-4  # m, bounds that close are good enough
FAR = 0.10  # m, gaps of the balls around two solids beyond which nothing finer is asked
KINDS = ("box", "cylinder", "sphere")


class Named(NamedTuple):
    """A solid, and how messages call it."""

    name: str
    primitive: Primitive  # its pose [T, 4, 4] m, or [4, 4] where it stands still


class Gap(NamedTuple):
    """The smallest distance of a motion: what comes nearest, when, and how near."""

    distance: float  # m, a lower bound; 0 or less: the solids may overlap
    first: str
    second: str
    time: float  # s

    def refusal(self, least: float) -> InvalidInput:
        """The error for a distance below ``least`` [m]."""
        return InvalidInput(
            f"{self.first} comes too near to {self.second} at t = {self.time:.3g} s",
            got=f"{self.distance:.3g} m" if self.distance > 0 else "they touch or cross",
            expected=f"at least {least:g} m" if least > 0 else "apart",
            remedy="turn the grippers less (roll), change heading, grips or path, or choose another hold",
        )


class Solids(NamedTuple):
    """P solids at T instants, as arrays."""

    kind: Tensor  # [P] index into KINDS
    half: Tensor  # [P, 3] m, half extents along the own axes
    pose: Tensor  # [T, P, 4, 4] m

    @classmethod
    def of(cls, primitives: Sequence[Primitive], count: int) -> Solids:
        """From primitives whose poses are [T, 4, 4], or [4, 4] of what stands still."""
        kind = torch.tensor([KINDS.index(p.kind) for p in primitives])
        half = torch.tensor([_half(p) for p in primitives], dtype=torch.float64)
        pose = torch.stack([p.pose.detach().double().expand(count, 4, 4) for p in primitives], dim=1)
        return cls(kind, half, pose)

    def pick(self, time: Tensor, solid: Tensor) -> Solids:
        """N of them at one instant each: ``pose`` [N, 4, 4]."""
        return Solids(self.kind[solid], self.half[solid], self.pose[time, solid])


def nearest(solids: Sequence[Named], pairs: Sequence[tuple[int, int]], times: Tensor, least: float = 0.0) -> Gap:
    """The smallest distance among ``pairs`` of solids at ``times`` [T] s.

    ``FAR`` at most, or ``least`` [m] where more is asked for: nothing finer is.
    """
    far = max(FAR, least)
    best = Gap(far, "", "", 0.0)
    if not pairs:
        return best
    every = Solids.of([solid.primitive for solid in solids], len(times))
    a, b = torch.tensor(pairs).T
    ball = every.half.norm(dim=-1)
    apart = (every.pose[:, a, :3, 3] - every.pose[:, b, :3, 3]).norm(dim=-1) - ball[a] - ball[b]
    time, pair = torch.nonzero(apart < far, as_tuple=True)
    if not len(time):
        return best
    bound = distances(every.pick(time, a[pair]), every.pick(time, b[pair]))
    at = int(bound.argmin())
    first, second = (solids[int(index[pair[at]])].name for index in (a, b))
    return min(best, Gap(float(bound[at]), first, second, float(times[time[at]])), key=lambda gap: gap.distance)


def distances(a: Solids, b: Solids) -> Tensor:
    """Lower bounds [N] m of the distances of N pairs, within ``EXACT`` of the truth where solids do not touch.

    Args:
        a: N solids at one instant each (T = 1 is left out of ``pose``: [N, 4, 4]).
        b: as many.
    """
    x = a.pose[:, :3, 3]
    bound = torch.full((len(x),), -math.inf, dtype=torch.float64)
    for _ in range(ROUNDS):
        y = _project(b, x)
        x = _project(a, y)
        way = y - x
        length = way.norm(dim=-1)
        bound = torch.maximum(bound, _separation(a, b, way, length))
        if bool((length - bound < EXACT).all()):
            break
    return bound


def _separation(a: Solids, b: Solids, way: Tensor, length: Tensor) -> Tensor:
    """Width [N] m of the slab across ``way`` [N, 3] that lies between both solids; negative where there is none."""
    d = way / length.clamp(min=1e-12)[:, None]
    middle = ((b.pose[:, :3, 3] - a.pose[:, :3, 3]) * d).sum(-1)
    return torch.where(length > 1e-9, middle - _support(a, d) - _support(b, d), -1e-9)


def _support(s: Solids, d: Tensor) -> Tensor:
    """How far [N] m solids reach from their centres along unit vectors ``d`` [N, 3]."""
    local = (s.pose[:, :3, :3].mT @ d[..., None])[..., 0].abs()
    box = (local * s.half).sum(-1)
    cylinder = s.half[:, 0] * local[:, :2].norm(dim=-1) + s.half[:, 2] * local[:, 2]
    return torch.where(s.kind == 0, box, torch.where(s.kind == 1, cylinder, s.half[:, 0]))


def _project(s: Solids, p: Tensor) -> Tensor:
    """The points of the solids nearest to ``p`` [N, 3] m."""
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
    raise InvalidInput("kind of a primitive", got=repr(p.kind), expected=f"one of {', '.join(KINDS)}")
