"""Where the cloth shall be at the end."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..errors import InvalidInput
from ..losses.shapes import check_triangles
from ..meshes import load
from ..recordings import Recording, read

EXPECTED = (
    "an episode (its last points), .npy [N, 3] of points, .obj or .ply of a mesh, pose.npz, or .npz with x [N, 3] and "
    "uv [N, 2]"
)


@dataclass(frozen=True, eq=False)
class Goal:
    """Where the cloth shall be: its surface, or, with ``uv`` or ``vertices``, each of some pieces of it.

    Attributes:
        points: [N, 3] m, in the world.
        faces: [F, 3], triangles of the points where the whole cloth is known; None: what a camera sees of it.
        uv: [N, 2] m, which point of the pattern shall be at each of these.
        vertices: [N], which vertex of the cloth's mesh; with ``faces`` the mesh must have the same triangles.

    Raises:
        InvalidInput: other shapes, numbers that are not finite, no points, or pieces told in both ways.
    """

    points: Tensor
    faces: Tensor | None = None
    uv: Tensor | None = None
    vertices: Tensor | None = None

    def __post_init__(self) -> None:
        points, uv = _numbers(self.points, "points of the goal"), _numbers(self.uv, "uv of the goal")
        faces = _numbers(self.faces, "faces of the goal", whole=True)
        vertices = _numbers(self.vertices, "vertices of the goal", whole=True)
        if points is None or points.ndim != 2 or points.shape[1] != 3 or not len(points) or not _finite(points):
            raise InvalidInput("points of the goal", got=_told(points), expected="[N, 3] finite metres, N >= 1")
        if faces is not None:
            check_triangles(faces, len(points))
        if uv is not None and vertices is not None:
            raise InvalidInput("goal", got="uv and vertices", expected="one of them")
        if uv is not None and (uv.shape != (len(points), 2) or not _finite(uv)):
            raise InvalidInput(
                "uv of the goal", got=_told(uv), expected=f"[{len(points)}, 2] finite metres on the pattern"
            )
        if vertices is not None and vertices.shape != (len(points),):
            raise InvalidInput(
                "vertices of the goal", got=_told(vertices), expected=f"[{len(points)}], one for each point"
            )
        for name, value in (("points", points), ("faces", faces), ("uv", uv), ("vertices", vertices)):
            object.__setattr__(self, name, value)


def _numbers(given: Any, name: str, whole: bool = False) -> Tensor | None:
    """Tensor of the default dtype, or of int64 of what is ``whole``."""
    try:
        if given is None:
            return None
        found = torch.as_tensor(given if isinstance(given, Tensor) else np.array(given)).detach()
        if whole and (found.is_floating_point() or found.dtype == torch.bool):
            raise TypeError
        return found.to(torch.int64 if whole else torch.get_default_dtype())
    except (TypeError, ValueError, RuntimeError):
        expected = "whole numbers" if whole else "numbers in metres"
        remedy = "of a file or an episode: planning.read_goal(path)"
        raise InvalidInput(
            name, got=f"{given!r:.60}", expected=f"{expected}, a tensor or an array", remedy=remedy
        ) from None


def _told(numbers: Tensor | None) -> str:
    if numbers is None:
        return "none"
    return f"shape {tuple(numbers.shape)}" + ("" if _finite(numbers) else ", not all finite")


def _finite(numbers: Tensor) -> bool:
    return bool(numbers.isfinite().all())


def read_goal(path: str | Path, pieces: bool = False) -> Goal:
    """A goal from a file or an episode's folder.

    Args:
        path: see ``EXPECTED``.
        pieces: it says where each piece of the cloth shall be: a mesh by its pattern coordinates, one without and a
            pose by vertices, which are those of the cloth's mesh; an episode by its last markers. Of ``.npz`` files
            with ``uv`` always.

    Raises:
        InvalidInput: nothing that shows where a cloth, or each piece of it, is.
        RecordingError: an episode that cannot be read, or without what is asked for.
    """
    path = Path(path)
    if path.is_dir():
        return _of_markers(read(path)) if pieces else _of_points(read(path))
    kind = path.suffix.lower()
    if not path.is_file() or kind not in (".npy", ".npz", ".obj", ".ply"):
        what = "file of an unknown kind" if path.is_file() else "no such file or folder"
        raise InvalidInput("goal", got=f"{path}, {what}", expected=EXPECTED)
    if kind == ".npy" and pieces:
        got, expected = (
            f"{path}, points of which nobody knows the piece",
            "a mesh, a pose, markers, or .npz with x and uv",
        )
        raise InvalidInput("goal", got=got, expected=expected)
    own = lambda x: torch.arange(len(x)) if pieces else None  # noqa: E731
    if kind in (".obj", ".ply"):
        mesh = load(path)
        if pieces and mesh.uv is not None:  # vertices of the cloth's mesh may have been moved to where a grasp ends
            return Goal(torch.as_tensor(mesh.vertices), uv=torch.as_tensor(mesh.uv))
        return Goal(torch.as_tensor(mesh.vertices), torch.as_tensor(mesh.faces), vertices=own(mesh.vertices))
    try:
        found = np.load(path, allow_pickle=False)
        if kind == ".npy":
            return Goal(torch.as_tensor(np.asarray(found, dtype=float)))
        x = np.asarray(found["x"], dtype=float)
        x = x[-1] if x.ndim == 3 else x
        if "uv" in found:
            return Goal(torch.as_tensor(x), uv=torch.as_tensor(np.asarray(found["uv"], dtype=float)))
        return Goal(torch.as_tensor(x), torch.as_tensor(found["faces"]), vertices=own(x))
    except InvalidInput:
        raise
    except Exception as error:  # a damaged archive can raise almost anything
        raise InvalidInput("goal", got=f"{path} ({type(error).__name__})", expected=EXPECTED) from None


def _of_points(seen: Recording) -> Goal:
    points = seen.require("points", by="a goal")
    return Goal(torch.as_tensor(points.frame(len(points) - 1)))


def _of_markers(seen: Recording) -> Goal:
    markers = seen.require("markers", by="a goal of pieces")
    there = np.isfinite(markers.xyz[-1]).all(-1)
    if markers.uv is None or not there.any():
        got = "markers of which nobody knows the piece" if markers.uv is None else "no marker in the last frame"
        raise InvalidInput("goal", got=got, expected="markers with uv, of which some are seen at the end")
    return Goal(torch.as_tensor(markers.xyz[-1][there]), uv=torch.as_tensor(markers.uv[there]))
