"""Contact of sample points on edges and triangles with a body, for those points alone that may touch it.

This is ``boundaries/points.py``. A pass counts what touches, then distributes impulses. Both evaluate the body anew,
which costs less than to store what they saw at every point.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch

from ...boundaries.collider import CONTACT_PASSES
from ...boundaries.points import TrianglePoints
from ..builder import SubstepBuilder, VelocityStage
from ..fields import Field
from ..loops import Loop
from ..stages import PointTables
from .body import BodyLowering


class _PointFields(NamedTuple):
    """Constants of P points, and the added mass around them.

    Attributes:
        corners: numbers of three tables [P] of vertices.
        weight: [P, 3] barycentric coordinates.
        tables: points by triangle.
        added_mass_ratio: [V, 6] added mass over the vertices' own mass; None without.
    """

    corners: list[int]
    weight: Field
    tables: PointTables
    added_mass_ratio: Field | None


def add_point_contact(
    builder: SubstepBuilder, sample: TrianglePoints, body: BodyLowering, velocity: VelocityStage
) -> None:
    """Stop the points that approach the body, in several passes."""
    if not sample.weight.numel():
        return
    points, field = _point_fields(builder, sample), velocity.spill_to_field()
    for _ in range(CONTACT_PASSES):
        field = _add_pass(builder, points, body, field)
    velocity.reload_from_field(field)


def _add_pass(builder: SubstepBuilder, points: _PointFields, body: BodyLowering, before: Field) -> Field:
    # broad phase: distance and relative speed of the vertices, then the points that may touch
    approach = builder.program.temporary(builder.vertices, 2)
    loop = builder.program.loop(builder.vertices, no_derivative=True)
    v = loop.load(before)
    contact, body_velocity = body.distance_and_velocity(loop, loop.load(builder.x.start))
    if body_velocity is None:
        body_velocity = loop.load(builder.program.constant(torch.zeros(1, 3)))
    loop.store(loop.call("approach", contact[:1], loop.load(body.limits), v, body_velocity), approach)
    near = builder.program.broad_phase(builder.x.start, approach, builder.dt, points.tables, body.lipschitz)

    # how much of each vertex's mass the touching points claim
    claims = builder.program.temporary(builder.vertices, 1)
    loop = builder.program.loop_over_points(near, no_derivative=True)
    claimed = loop.call("claim_mass", _velocity_change(builder, loop, points, body, before), loop.load(points.weight))
    for corner, claim in zip(points.corners, claimed, strict=True):
        loop.add([claim], claims, corner)

    # distribution of the impulses to the vertices
    after = builder.program.temporary(builder.vertices, 3)
    loop = builder.loop(builder.vertices)
    loop.store(loop.load(before), after)
    loop = builder.program.loop_over_points(near)
    corner_claims = [reg for corner in points.corners for reg in loop.load(claims, corner)]
    masses = [reg for corner in points.corners for reg in loop.load(builder.mass, corner)]
    inverse_masses = loop.call("weight_per_mass", loop.load(points.weight), masses)
    change = _velocity_change(builder, loop, points, body, before)
    shares = loop.call("distribute_impulse", change, inverse_masses, corner_claims)
    for k, corner in enumerate(points.corners):
        loop.add(shares[3 * k : 3 * k + 3], after, corner)
    return after


def _velocity_change(
    builder: SubstepBuilder, loop: Loop, points: _PointFields, body: BodyLowering, v: Field
) -> list[int]:
    """Registers of the change of the points' velocities that the body demands."""
    weight = loop.load(points.weight)

    def at_corners(field: Field) -> list[list[int]]:
        return [loop.load(field, corner) for corner in points.corners]

    x, v_points = (loop.call("point_value", *at_corners(field), weight) for field in (builder.x.start, v))
    if points.added_mass_ratio is None:
        return body.velocity_change(loop, x, v_points, [])
    ratios = at_corners(points.added_mass_ratio)
    halves = [loop.call("point_value", *(b[k : k + 3] for b in ratios), weight) for k in (0, 3)]
    return body.velocity_change(loop, x, v_points, [*halves[0], *halves[1]])


def _ratio_field(builder: SubstepBuilder) -> Field | None:
    if builder.added_mass is None:
        return None
    loop, ratio = builder.loop(builder.vertices), builder.program.temporary(builder.vertices, 6)
    loop.store(builder.added_mass_ratio(loop), ratio)
    return ratio


def _point_fields(builder: SubstepBuilder, sample: TrianglePoints) -> _PointFields:
    index, weight = sample.index.view(3, -1).cpu().numpy(), sample.weight[..., 0].cpu().numpy()
    faces = builder.model.geometry.corners.view(3, -1).cpu().numpy()
    owner = _owning_triangles(index, weight, faces, builder.vertices)
    order = np.argsort(owner, kind="stable")
    index, weight = index[:, order], weight[:, order]
    starts = np.searchsorted(owner[order], np.arange(faces.shape[1] + 1))
    table, constant = builder.program.table, builder.program.constant
    return _PointFields(
        [table(corner) for corner in index],
        constant(weight.T),
        PointTables(table(faces), table(starts), faces.shape[1]),
        _ratio_field(builder),
    )


def _owning_triangles(index: np.ndarray, weight: np.ndarray, faces: np.ndarray, vertices: int) -> np.ndarray:
    """The triangle of each point; one of the two for a point on an edge."""
    sides = np.sort(np.stack([faces, np.roll(faces, -1, axis=0)]), axis=0)  # [2, 3, E]
    keys, first = np.unique((sides[0] * vertices + sides[1]).ravel(), return_index=True)
    ends = np.sort(index[:2], axis=0)
    on_edge = first[np.searchsorted(keys, ends[0] * vertices + ends[1])] % faces.shape[1]
    triples, which = np.unique((faces[0] * vertices + faces[1]) * vertices + faces[2], return_index=True)
    inner = (index[0] * vertices + index[1]) * vertices + index[2]
    return np.where(weight[2] > 0, which[np.searchsorted(triples, inner).clip(max=len(which) - 1)], on_edge)
