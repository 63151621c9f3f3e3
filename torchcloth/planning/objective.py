"""The distance of a cloth from its goal, and a local quadratic model of it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ..episodes.streams import locate_on_pattern
from ..errors import InvalidInput
from ..losses import ClosestPoints, chamfer_to_surface, find_closest_points
from ..meshes import Mesh
from .goal import Goal

TANGENTIAL_STIFFNESS_RATIO = 0.1  # curvature along a surface over that across it: cloth may slide along the goal


class QuadraticModel(NamedTuple):
    """Local quadratic model of the mean square distance along N directions of change.

    Attributes:
        value: m^2, mean square distance.
        gradient: [N], m^2 per unit of each direction.
        curvature: [N, N], positive semi-definite (Gauss-Newton). Offsets along a surface count by
            ``TANGENTIAL_STIFFNESS_RATIO``.
    """

    value: Tensor
    gradient: Tensor
    curvature: Tensor


def average_models(models: Sequence[QuadraticModel]) -> QuadraticModel:
    """Return the mean of several quadratic models."""
    return QuadraticModel(*(torch.stack(parts).mean(0) for parts in zip(*models, strict=True)))


class AbstractObjective(ABC):
    """The distance of a cloth on one mesh from a goal."""

    @abstractmethod
    def distance(self, x: Tensor) -> Tensor:
        """Return the mean distance [m] between the goal and a cloth [V, 3] m; differentiable."""

    @abstractmethod
    def mean_square(self, x: Tensor) -> float:
        """Return the mean square distance [m^2] between the goal and a cloth [V, 3] m."""

    @abstractmethod
    def quadratic_model(self, x: Tensor, directions: Tensor) -> QuadraticModel:
        """Return the quadratic model of ``mean_square`` at a cloth [V, 3] m.

        Args:
            x: [V, 3] m, the cloth.
            directions: [N, V, 3] m, changes of the cloth along N directions.
        """


class SurfaceObjective(AbstractObjective):
    """The cloth's surface shall be at the goal.

    If only points of the goal are known, only their distances from the cloth count: a camera does not show where the
    cloth may not be.
    """

    def __init__(self, points: Tensor, faces: Tensor | None, cloth_faces: Tensor) -> None:
        self.points, self.faces, self.cloth_faces = points, faces, cloth_faces

    def distance(self, x: Tensor) -> Tensor:
        """Return the mean distance [m] of the goal's points from the cloth's surface (one-sided Chamfer).

        If the goal's surface is known, average this with the mean distance of the cloth's vertices from it.
        """
        points = self.points.to(x)
        to_goal = chamfer_to_surface(points, x, self.cloth_faces)
        if self.faces is None:
            return to_goal
        return 0.5 * (to_goal + chamfer_to_surface(x, points, self.faces))

    def mean_square(self, x: Tensor) -> float:
        """Return the same with squared distances [m^2]."""
        points = self.points.to(x)
        to_goal = _offsets(points, x, self.cloth_faces)[0].square().sum(1).mean()
        if self.faces is None:
            return float(to_goal)
        return 0.5 * float(to_goal + _offsets(x, points, self.faces)[0].square().sum(1).mean())

    def quadratic_model(self, x: Tensor, directions: Tensor) -> QuadraticModel:
        """Return the quadratic model with an exact gradient (envelope theorem) and the Gauss-Newton curvature."""
        points = self.points.to(x)
        offset, stiffness, hits = _offsets(points, x, self.cloth_faces)
        to_goal = _quadratic_model(offset, stiffness, hits.interpolate(directions))
        if self.faces is None:
            return to_goal
        offset, stiffness, _ = _offsets(x, points, self.faces)
        return average_models([to_goal, _quadratic_model(-offset, stiffness, directions)])


class MaterialPointObjective(AbstractObjective):
    """Each of some material points of the cloth shall be at its own goal point."""

    def __init__(self, points: Tensor, closest_points: ClosestPoints) -> None:
        self.points, self.closest_points = points, closest_points

    def distance(self, x: Tensor) -> Tensor:
        """Return the mean distance [m] of the material points from their goal points."""
        return self._offsets(x).norm(dim=1).mean()

    def mean_square(self, x: Tensor) -> float:
        """Return the mean square distance [m^2] of the material points from their goal points."""
        return float(self._offsets(x).square().sum(1).mean())

    def quadratic_model(self, x: Tensor, directions: Tensor) -> QuadraticModel:
        """Return the quadratic model; material points do not slide."""
        stiffness = torch.eye(3).to(x).expand(len(self.points), 3, 3)
        return _quadratic_model(self._offsets(x), stiffness, self._interpolate(directions))

    def _offsets(self, x: Tensor) -> Tensor:
        return self.points.to(x) - self._interpolate(x)

    def _interpolate(self, x: Tensor) -> Tensor:
        return self.closest_points._replace(weights=self.closest_points.weights.to(x)).interpolate(x)


def build_objective(goal: Goal, mesh: Mesh) -> AbstractObjective:
    """Build the objective of a goal for the cloth on a mesh.

    Raises:
        InvalidInput: the goal names material points that this cloth does not have.
    """
    if goal.uv is not None:
        return MaterialPointObjective(goal.points, locate_on_pattern(mesh, goal.uv.cpu().numpy(), "uv of the goal"))
    if goal.vertices is None:
        return SurfaceObjective(goal.points, goal.faces, torch.as_tensor(mesh.faces))
    if goal.faces is not None and not torch.equal(goal.faces, torch.as_tensor(mesh.faces).long()):
        got, expected = f"a mesh of {len(goal.faces)} triangles, which are not the cloth's", "the cloth's mesh, moved"
        raise InvalidInput(
            "goal", got=got, expected=expected, remedy="use its surface, or give x and uv of material points"
        )
    count = len(mesh.vertices)
    if int(goal.vertices.min()) < 0 or int(goal.vertices.max()) >= count:
        got = f"{int(goal.vertices.min())} to {int(goal.vertices.max())}"
        raise InvalidInput("vertices of the goal", got=got, expected=f"vertices of the cloth, 0 to {count - 1}")
    corners = goal.vertices[:, None].expand(-1, 3)
    weights = torch.tensor([1.0, 0.0, 0.0]).expand(len(corners), 3)
    return MaterialPointObjective(
        goal.points, ClosestPoints(corners, weights, torch.zeros(len(corners), dtype=torch.bool))
    )


def _offsets(points: Tensor, vertices: Tensor, faces: Tensor) -> tuple[Tensor, Tensor, ClosestPoints]:
    """Offsets [N, 3] m of points from a surface, their stiffness [N, 3, 3], and the closest points."""
    hits = find_closest_points(points, vertices, faces)
    a, b, c = vertices[hits.corners].unbind(1)
    normal = torch.linalg.cross(b - a, c - a)
    normal = normal / normal.norm(dim=1, keepdim=True).clamp(min=1e-30)
    across, eye = normal[:, :, None] * normal[:, None, :], torch.eye(3).to(points)
    along = torch.where(hits.is_beyond_edge, 1.0, TANGENTIAL_STIFFNESS_RATIO)[:, None, None].to(points)
    return points - hits.interpolate(vertices), across + along * (eye - across), hits


def _quadratic_model(offset: Tensor, stiffness: Tensor, shifts: Tensor) -> QuadraticModel:
    """Quadratic model of offsets [M, 3] m, which ``shifts`` [N, M, 3] shorten, weighted by ``stiffness`` [M, 3, 3]."""
    count = len(offset)
    gradient = -2 * torch.einsum("nmi,mi->n", shifts, offset) / count
    stiff_shifts = torch.einsum("mij,nmj->nmi", stiffness, shifts).flatten(1)
    curvature = 2 * stiff_shifts @ shifts.flatten(1).mT / count
    return QuadraticModel(offset.square().sum(1).mean(), gradient, curvature)
