"""How far a cloth is from its goal, and what pulls it there."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ..episodes.streams import on_pattern
from ..errors import InvalidInput
from ..losses import Hits, chamfer_to_surface, closest
from ..meshes import Mesh
from .goal import Goal

ALONG = 0.1  # of the stiffness across a surface, that a place on it is asked for along it: cloth may slide there


class Pull(NamedTuple):
    """Mean square distance from the goal, and what a change of the cloth does to it."""

    value: Tensor  # m^2
    gradient: Tensor  # [N] m^2 for each unit of N directions
    curvature: Tensor  # [N, N], never negative: slopes alone, places on the surfaces held along them by ``ALONG``


def mean(pulls: Sequence[Pull]) -> Pull:
    """Of several."""
    return Pull(*(torch.stack(parts).mean(0) for parts in zip(*pulls, strict=True)))


class AbstractAim(ABC):
    """A goal, of the cloth on one mesh."""

    @abstractmethod
    def distance(self, x: Tensor) -> Tensor:
        """m, between the goal and a cloth [V, 3] m; differentiable."""

    @abstractmethod
    def square(self, x: Tensor) -> float:
        """m^2, as ``distance`` with squares; what ``pull`` is about."""

    @abstractmethod
    def pull(self, x: Tensor, moved: Tensor) -> Pull:
        """What the cloth's changes ``moved`` [N, V, 3] m, along N directions, do to its mean square distance."""


class SurfaceAim(AbstractAim):
    """The cloth's surface shall be at the goal.

    What a camera does not see says nothing of where the cloth may not be, so its points are asked for one way only.
    """

    def __init__(self, points: Tensor, faces: Tensor | None, of: Tensor) -> None:
        self.points, self.faces, self.of = points, faces, of

    def distance(self, x: Tensor) -> Tensor:
        """The mean distance of the goal's points from the cloth's surface (one-sided Chamfer, as in reports of fits).

        Where the goal's surface is known, the mean of that and of the distance of the cloth's vertices from it.
        """
        points = self.points.to(x)
        there = chamfer_to_surface(points, x, self.of)
        if self.faces is None:
            return there
        return 0.5 * (there + chamfer_to_surface(x, points, self.faces))

    def square(self, x: Tensor) -> float:
        """Likewise, of squares."""
        points = self.points.to(x)
        there = _offsets(points, x, self.of)[0].square().sum(1).mean()
        if self.faces is None:
            return float(there)
        return 0.5 * float(there + _offsets(x, points, self.faces)[0].square().sum(1).mean())

    def pull(self, x: Tensor, moved: Tensor) -> Pull:
        """The gradient is exact (nearest places are held: envelope theorem); the curvature is Gauss and Newton's."""
        points = self.points.to(x)
        offset, stiff, hits = _offsets(points, x, self.of)
        there = _pull(offset, stiff, hits.on(moved))
        if self.faces is None:
            return there
        offset, stiff, _ = _offsets(x, points, self.faces)
        return mean([there, _pull(-offset, stiff, moved)])


class PiecesAim(AbstractAim):
    """Each of some pieces of the cloth shall be at its point: mean distances."""

    def __init__(self, points: Tensor, places: Hits) -> None:
        self.points, self.places = points, places

    def distance(self, x: Tensor) -> Tensor:
        """The mean distance of the pieces from where they shall be."""
        return self._offsets(x).norm(dim=1).mean()

    def square(self, x: Tensor) -> float:
        """Likewise, of squares."""
        return float(self._offsets(x).square().sum(1).mean())

    def pull(self, x: Tensor, moved: Tensor) -> Pull:
        """No piece slides."""
        stiff = torch.eye(3).to(x).expand(len(self.points), 3, 3)
        return _pull(self._offsets(x), stiff, self._on(moved))

    def _offsets(self, x: Tensor) -> Tensor:
        return self.points.to(x) - self._on(x)

    def _on(self, x: Tensor) -> Tensor:
        return self.places._replace(weights=self.places.weights.to(x)).on(x)


def aim_at(goal: Goal, mesh: Mesh) -> AbstractAim:
    """The goal of a cloth on this mesh.

    Raises:
        InvalidInput: pieces that this cloth has not.
    """
    if goal.uv is not None:
        return PiecesAim(goal.points, on_pattern(mesh, goal.uv.cpu().numpy(), "uv of the goal"))
    if goal.vertices is None:
        return SurfaceAim(goal.points, goal.faces, torch.as_tensor(mesh.faces))
    if goal.faces is not None and not torch.equal(goal.faces, torch.as_tensor(mesh.faces).long()):
        got, expected = f"a mesh of {len(goal.faces)} triangles, which are not the cloth's", "the cloth's mesh, moved"
        raise InvalidInput("goal", got=got, expected=expected, remedy="ask for its surface, or give x and uv of pieces")
    count = len(mesh.vertices)
    if int(goal.vertices.min()) < 0 or int(goal.vertices.max()) >= count:
        got = f"{int(goal.vertices.min())} to {int(goal.vertices.max())}"
        raise InvalidInput("vertices of the goal", got=got, expected=f"vertices of the cloth, 0 to {count - 1}")
    corners = goal.vertices[:, None].expand(-1, 3)
    weights = torch.tensor([1.0, 0.0, 0.0]).expand(len(corners), 3)
    return PiecesAim(goal.points, Hits(corners, weights, torch.zeros(len(corners), dtype=torch.bool)))


def _offsets(points: Tensor, vertices: Tensor, faces: Tensor) -> tuple[Tensor, Tensor, Hits]:
    """(from the nearest places of a surface to points [N, 3] m, how each is asked for [N, 3, 3], these places)."""
    hits = closest(points, vertices, faces)
    a, b, c = vertices[hits.corners].unbind(1)
    normal = torch.linalg.cross(b - a, c - a)
    normal = normal / normal.norm(dim=1, keepdim=True).clamp(min=1e-30)
    across, eye = normal[:, :, None] * normal[:, None, :], torch.eye(3).to(points)
    along = torch.where(hits.beyond, 1.0, ALONG)[:, None, None].to(points)
    return points - hits.on(vertices), across + along * (eye - across), hits


def _pull(offset: Tensor, stiff: Tensor, shifts: Tensor) -> Pull:
    """Of offsets [M, 3] m that ``shifts`` [N, M, 3] shorten."""
    count = len(offset)
    gradient = -2 * torch.einsum("nmi,mi->n", shifts, offset) / count
    stiffer = torch.einsum("mij,nmj->nmi", stiff, shifts).flatten(1)
    curvature = 2 * stiffer @ shifts.flatten(1).mT / count
    return Pull(offset.square().sum(1).mean(), gradient, curvature)
