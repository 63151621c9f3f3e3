"""Signed distances to solids, in their own coordinates."""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

import torch
from torch import Tensor

from ...boundaries import AbstractCollider, Box, Capsule, Cylinder, MeshSolid, Plane, Sphere
from ..builder import SubstepBuilder, lowering_of, lowers
from ..fields import Field
from ..loops import Loop

MESH_SOLID_LIPSCHITZ = 3.0  # bound on the slope of distances that are interpolated on a grid
DistanceFunction = Callable[[Loop, list[int]], list[int]]  # registers of a place -> of the distance and the normal


def distance_function(builder: SubstepBuilder, solid: AbstractCollider) -> DistanceFunction:
    """Return what adds the distance of a solid to a loop, for places in the solid's coordinates."""
    lower_it = cast("Callable[..., DistanceFunction]", lowering_of(solid))
    return lower_it(builder, solid)


def lipschitz_constant(solid: AbstractCollider) -> float:
    """Return how much the distance may change over a path of length 1: exact distances change by 1 at most."""
    return MESH_SOLID_LIPSCHITZ if isinstance(solid, MeshSolid) else 1.0


@lowers(Plane)
def lower_plane(builder: SubstepBuilder, plane: Plane) -> DistanceFunction:
    """Return the distance function of a plane."""
    return _kernel("plane_distance", _constants(builder, plane.point, plane.normal))


@lowers(Sphere)
def lower_sphere(builder: SubstepBuilder, sphere: Sphere) -> DistanceFunction:
    """Return the distance function of a sphere."""
    radius = builder.parameter(sphere.radius.field)
    return _kernel("sphere_distance", radius, _constants(builder, sphere.centre, sphere.up))


@lowers(Box)
def lower_box(builder: SubstepBuilder, box: Box) -> DistanceFunction:
    """Return the distance function of a box."""
    return _kernel("box_distance", builder.parameter(box.size.value.unsqueeze(-2)))


@lowers(Capsule)
def lower_capsule(builder: SubstepBuilder, capsule: Capsule) -> DistanceFunction:
    """Return the distance function of a capsule."""
    constants = _constants(builder, capsule.start, capsule.end - capsule.start, capsule.perpendicular)
    return _kernel("capsule_distance", builder.parameter(capsule.radius.field), constants)


@lowers(Cylinder)
def lower_cylinder(builder: SubstepBuilder, cylinder: Cylinder) -> DistanceFunction:
    """Return the distance function of a cylinder."""
    length = (cylinder.end - cylinder.start).norm(dim=-1, keepdim=True)
    axis = (cylinder.end - cylinder.start) / length
    constants = ((cylinder.start + cylinder.end) / 2, axis, length / 2, cylinder.perpendicular)
    return _kernel("cylinder_distance", builder.parameter(cylinder.radius.field), _constants(builder, *constants))


@lowers(MeshSolid)
def lower_mesh_solid(builder: SubstepBuilder, solid: MeshSolid) -> DistanceFunction:
    """Return the distance function of a closed mesh, interpolated on a grid."""
    values = builder.program.constant(solid.values.reshape(-1, 1))
    cell = solid.cell.reshape(1)
    grid = _constants(builder, solid.origin, solid.count - 1, cell)
    cell_and_up = _constants(builder, cell, solid.up)

    def distance(loop: Loop, p: list[int]) -> list[int]:
        place = loop.call("grid_coordinates", p, loop.load(grid))
        fractions, corners = loop.lookup(values, solid.count.tolist(), place[:3])
        return loop.call("grid_distance", fractions, corners, place[3:], loop.load(cell_and_up))

    return distance


def _kernel(kernel: str, *fields: Field) -> DistanceFunction:
    return lambda loop, p: loop.call(kernel, p, *(loop.load(field) for field in fields))


def _constants(builder: SubstepBuilder, *parts: Tensor) -> Field:
    """A field of one row with all these numbers."""
    return builder.program.constant(torch.cat([part.to(builder.program.dtype) for part in parts]).reshape(1, -1))
