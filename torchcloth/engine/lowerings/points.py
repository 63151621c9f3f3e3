"""Contact points on edges and triangles: ``boundaries/points.py``, for those points alone that may touch.

A pass takes stock of what touches, then shares out impulses; both look at the body anew, which costs less than to
remember what they saw at every point.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch

from ...boundaries.collider import PASSES
from ...boundaries.points import TrianglePoints
from ..fields import Field
from ..loops import Loop
from ..lowering import Lowering
from ..shared_loops import Velocities
from ..stages import PointTables
from .body import Body


class Points(NamedTuple):
    """Constants of the points, and the air around them."""

    corners: list[int]  # three tables [P]
    weight: Field  # [P, 3]
    tables: PointTables
    air: Field | None  # [V, 6] that moves along, over the vertices' own mass


def collide(low: Lowering, given: TrianglePoints, body: Body, velocity: Velocities) -> None:
    """Stop the points that approach, some times over."""
    if not given.weight.numel():
        return
    points, field = _points(low, given), velocity.store()
    for _ in range(PASSES):
        field = _pass(low, points, body, field)
    velocity.resume(field)


def _pass(low: Lowering, points: Points, body: Body, before: Field) -> Field:
    reach = low.program.temporary(low.vertices, 2)
    loop = low.program.loop(low.vertices, flat=True)
    v, (contact, own) = loop.load(before), body.seen(loop, loop.load(low.x.now))
    own = loop.load(low.program.constant(torch.zeros(1, 3))) if own is None else own
    loop.put(loop.call("reach", contact[:1], loop.load(body.limits), v, own), reach)
    near = low.program.sieve(low.x.now, reach, low.dt, points.tables, body.steep)

    claims = low.program.temporary(low.vertices, 1)
    loop = low.program.among(near, flat=True)
    claimed = loop.call("claim", _change(low, loop, points, body, before), loop.load(points.weight))
    for corner, claim in zip(points.corners, claimed, strict=True):
        loop.add([claim], claims, corner)

    after = low.program.temporary(low.vertices, 3)
    loop = low.loop(low.vertices)
    loop.put(loop.load(before), after)
    loop = low.program.among(near)
    load = [reg for corner in points.corners for reg in loop.load(claims, corner)]
    masses = [reg for corner in points.corners for reg in loop.load(low.mass, corner)]
    light = loop.call("light", loop.load(points.weight), masses)
    shares = loop.call("shared", _change(low, loop, points, body, before), light, load)
    for k, corner in enumerate(points.corners):
        loop.add(shares[3 * k : 3 * k + 3], after, corner)
    return after


def _change(low: Lowering, loop: Loop, points: Points, body: Body, v: Field) -> list[int]:
    """Wanted change of the points' velocities."""
    weight = loop.load(points.weight)
    corners = lambda field: [loop.load(field, corner) for corner in points.corners]  # noqa: E731
    x, now = (loop.call("at_point", *corners(field), weight) for field in (low.x.now, v))
    if points.air is None:
        return body.change(loop, x, now, [])
    around = corners(points.air)
    halves = [loop.call("at_point", *(b[k : k + 3] for b in around), weight) for k in (0, 3)]
    return body.change(loop, x, now, [*halves[0], *halves[1]])


def _air(low: Lowering) -> Field | None:
    if low.resistance is None:
        return None
    loop, air = low.loop(low.vertices), low.program.temporary(low.vertices, 6)
    loop.put(low.air_per_own(loop), air)
    return air


def _points(low: Lowering, given: TrianglePoints) -> Points:
    index, weight = given.index.view(3, -1).cpu().numpy(), given.weight[..., 0].cpu().numpy()
    faces = low.model.geometry.corners.view(3, -1).cpu().numpy()
    owner = _owners(index, weight, faces, low.vertices)
    order = np.argsort(owner, kind="stable")
    index, weight = index[:, order], weight[:, order]
    starts = np.searchsorted(owner[order], np.arange(faces.shape[1] + 1))
    table, constant = low.program.table, low.program.constant
    return Points(
        [table(corner) for corner in index],
        constant(weight.T),
        PointTables(table(faces), table(starts), faces.shape[1]),
        _air(low),
    )


def _owners(index: np.ndarray, weight: np.ndarray, faces: np.ndarray, vertices: int) -> np.ndarray:
    """The triangle on which each point is; one of the two for those on edges."""
    sides = np.sort(np.stack([faces, np.roll(faces, -1, axis=0)]), axis=0)  # [2, 3, E]
    keys, first = np.unique((sides[0] * vertices + sides[1]).ravel(), return_index=True)
    ends = np.sort(index[:2], axis=0)
    on_edge = first[np.searchsorted(keys, ends[0] * vertices + ends[1])] % faces.shape[1]
    triples, which = np.unique((faces[0] * vertices + faces[1]) * vertices + faces[2], return_index=True)
    inner = (index[0] * vertices + index[1]) * vertices + index[2]
    return np.where(weight[2] > 0, which[np.searchsorted(triples, inner).clip(max=len(which) - 1)], on_edge)
