"""Signed distances to solids, in their own coordinates."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from ...boundaries import AbstractCollider, Box, Capsule, Cylinder, MeshSolid, Plane, Sphere
from ..fields import Field
from ..loops import Loop
from ..lowering import Lowering

Distance = Callable[[Loop, list[int]], list[int]]  # registers of a place -> of the distance and the normal


def distance(low: Lowering, solid: AbstractCollider) -> Distance:
    """Of a solid without places: what it calls in a loop."""
    return _SOLIDS[type(solid)](low, solid)


def steepness(solid: AbstractCollider) -> float:
    """How much the distance may change along a way of length 1: interpolated ones not quite as they should."""
    return 3.0 if isinstance(solid, MeshSolid) else 1.0


def _plane(low: Lowering, plane: Plane) -> Distance:
    return _formula("plane", _row(low, plane.point, plane.normal))


def _sphere(low: Lowering, sphere: Sphere) -> Distance:
    return _formula("sphere", low.parameter(sphere.radius.field), _row(low, sphere.centre, sphere.up))


def _box(low: Lowering, box: Box) -> Distance:
    return _formula("box", low.parameter(box.size.value.unsqueeze(-2)))


def _capsule(low: Lowering, capsule: Capsule) -> Distance:
    constants = _row(low, capsule.start, capsule.end - capsule.start, capsule.perpendicular)
    return _formula("capsule", low.parameter(capsule.radius.field), constants)


def _cylinder(low: Lowering, bar: Cylinder) -> Distance:
    length = (bar.end - bar.start).norm(dim=-1, keepdim=True)
    constants = ((bar.start + bar.end) / 2, (bar.end - bar.start) / length, length / 2, bar.perpendicular)
    return _formula("cylinder", low.parameter(bar.radius.field), _row(low, *constants))


def _mesh_solid(low: Lowering, solid: MeshSolid) -> Distance:
    values = low.program.constant(solid.values.reshape(-1, 1))
    cell = solid.cell.reshape(1)
    grid = _row(low, solid.origin, solid.count - 1, cell)
    rest = _row(low, cell, solid.up)

    def within(loop: Loop, p: list[int]) -> list[int]:
        place = loop.call("grid_place", p, loop.load(grid))
        fractions, corners = loop.lookup(values, solid.count.tolist(), place[:3])
        return loop.call("grid_distance", fractions, corners, place[3:], loop.load(rest))

    return within


def _formula(kernel: str, *fields: Field) -> Distance:
    return lambda loop, p: loop.call(kernel, p, *(loop.load(field) for field in fields))


def _row(low: Lowering, *parts: Tensor) -> Field:
    return low.program.constant(torch.cat([part.to(low.program.dtype) for part in parts]).reshape(1, -1))


_SOLIDS: dict[type, Callable[[Lowering, Any], Distance]] = {
    Box: _box,
    Capsule: _capsule,
    Cylinder: _cylinder,
    MeshSolid: _mesh_solid,
    Plane: _plane,
    Sphere: _sphere,
}
