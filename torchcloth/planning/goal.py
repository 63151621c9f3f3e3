"""Where the cloth shall be at the end, and how far it is from there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..errors import InvalidInput
from ..losses import Hits, chamfer_to_surface, closest
from ..losses.shapes import check_triangles
from ..meshes import load
from ..recordings import read

EXPECTED = "an episode (its last points), .npy [N, 3] of points, .obj or .ply of a mesh, or pose.npz"
ALONG = 0.1  # of the stiffness across a surface, that a place on it is asked for along it: cloth may slide there


class Pull(NamedTuple):
    """Mean square distance from the goal, and what a change of the cloth does to it."""

    value: Tensor  # m^2
    gradient: Tensor  # [N] m^2 for each unit of N directions
    curvature: Tensor  # [N, N], never negative: slopes alone, places on the surfaces held along them by ``ALONG``


def mean(pulls: Sequence[Pull]) -> Pull:
    """Of several."""
    return Pull(*(torch.stack(parts).mean(0) for parts in zip(*pulls, strict=True)))


@dataclass(frozen=True, eq=False)
class Goal:
    """Where the cloth shall be.

    Attributes:
        points: [N, 3] m, in the world.
        faces: [F, 3], triangles of the points where the whole cloth is known; None: what a camera sees of it.

    Raises:
        InvalidInput: other shapes, numbers that are not finite, or no points.
    """

    points: Tensor
    faces: Tensor | None = None

    def __post_init__(self) -> None:
        try:
            points = torch.as_tensor(self.points, dtype=torch.get_default_dtype()).detach()
            faces = None if self.faces is None else torch.as_tensor(self.faces).long()
        except (TypeError, ValueError, RuntimeError):
            expected, remedy = (
                "[N, 3] metres, a tensor or an array",
                "of a file or an episode: planning.read_goal(path)",
            )
            raise InvalidInput("goal", got=f"{self.points!r:.60}", expected=expected, remedy=remedy) from None
        if points.ndim != 2 or points.shape[1] != 3 or not len(points) or not bool(points.isfinite().all()):
            got = f"shape {tuple(points.shape)}" + ("" if bool(points.isfinite().all()) else ", not all finite")
            raise InvalidInput("points of the goal", got=got, expected="[N, 3] finite metres, N >= 1")
        if faces is not None:
            check_triangles(faces, len(points))
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "faces", faces)

    def distance(self, x: Tensor, faces: Tensor) -> Tensor:
        """m, between the goal and a cloth [V, 3] m with triangles [F, 3]; differentiable in ``x``.

        The mean distance of the goal's points from the cloth's surface (one-sided Chamfer, as in reports of fits);
        where the goal's surface is known, the mean of that and of the distance of the cloth's vertices from it. What a
        camera does not see says nothing of where the cloth may not be, so its points are asked for one way only.
        """
        points = self.points.to(x)
        there = chamfer_to_surface(points, x, faces)
        if self.faces is None:
            return there
        return 0.5 * (there + chamfer_to_surface(x, points, self.faces))

    def square(self, x: Tensor, faces: Tensor) -> float:
        """m^2, as ``distance`` with squares; what ``pull`` is about."""
        points = self.points.to(x)
        there = _offsets(points, x, faces)[0].square().sum(1).mean()
        if self.faces is None:
            return float(there)
        return 0.5 * float(there + _offsets(x, points, self.faces)[0].square().sum(1).mean())

    def pull(self, x: Tensor, faces: Tensor, moved: Tensor) -> Pull:
        """What the cloth's changes ``moved`` [N, V, 3] m, along N directions, do to its mean square distance.

        The gradient is exact (nearest places are held, by the envelope theorem); the curvature is Gauss and Newton's.
        """
        points = self.points.to(x)
        offset, stiff, hits = _offsets(points, x, faces)
        shifts = (hits.weights[:, :, None] * moved[:, hits.corners]).sum(2)
        there = _pull(offset, stiff, shifts)
        if self.faces is None:
            return there
        offset, stiff, _ = _offsets(x, points, self.faces)
        return mean([there, _pull(-offset, stiff, moved)])


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


def read_goal(path: str | Path) -> Goal:
    """A goal from a file or an episode's folder.

    Raises:
        InvalidInput: nothing that shows where a cloth is.
        RecordingError: an episode that cannot be read, or without points.
    """
    path = Path(path)
    if path.is_dir():
        points = read(path).require("points", by="a goal")
        return Goal(torch.as_tensor(points.frame(len(points) - 1)))
    if not path.is_file() or path.suffix.lower() not in (".npy", ".npz", ".obj", ".ply"):
        what = "file of an unknown kind" if path.is_file() else "no such file or folder"
        raise InvalidInput("goal", got=f"{path}, {what}", expected=EXPECTED)
    if path.suffix.lower() in (".obj", ".ply"):
        mesh = load(path)
        return Goal(torch.as_tensor(mesh.vertices), torch.as_tensor(mesh.faces))
    try:
        found = np.load(path, allow_pickle=False)
        if path.suffix.lower() == ".npy":
            return Goal(torch.as_tensor(np.asarray(found, dtype=float)))
        return Goal(torch.as_tensor(np.asarray(found["x"][-1], dtype=float)), torch.as_tensor(found["faces"]))
    except InvalidInput:
        raise
    except Exception as error:  # a damaged archive can raise almost anything
        raise InvalidInput("goal", got=f"{path} ({type(error).__name__})", expected=EXPECTED) from None
