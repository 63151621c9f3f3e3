"""The goal of a motion plan: where the cloth shall be at the end."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .._utils.unpacking import load_arrays
from ..errors import InvalidInput, TorchclothError
from ..losses.shapes import check_triangles
from ..meshes import load
from ..recordings import Recording, read

ACCEPTED_GOALS = (
    "an episode (its last points), .npy [N, 3] of points, .obj or .ply of a mesh, pose.npz, or .npz with x [N, 3] and "
    "uv [N, 2]"
)


@dataclass(frozen=True, eq=False)
class Goal:
    """Where the cloth shall be: its surface or, with ``uv`` or ``vertices``, each of some material points.

    Attributes:
        points: [N, 3] m, in the world.
        faces: [F, 3], triangles of the points if the whole surface is known; None: only points, as a camera sees them.
        uv: [N, 2] m, pattern coordinates of the material points that shall be at ``points``.
        vertices: [N], vertices of the cloth's mesh that shall be at ``points``; with ``faces`` the mesh must have the
            same
            triangles.

    Raises:
        InvalidInput: wrong shapes, numbers that are not finite, no points, or material points given in both ways.
    """

    points: Tensor
    faces: Tensor | None = None
    uv: Tensor | None = None
    vertices: Tensor | None = None

    def __post_init__(self) -> None:
        points, uv = _to_tensor(self.points, "points of the goal"), _to_tensor(self.uv, "uv of the goal")
        faces = _to_tensor(self.faces, "faces of the goal", whole=True)
        vertices = _to_tensor(self.vertices, "vertices of the goal", whole=True)
        if points is None or points.ndim != 2 or points.shape[1] != 3 or not len(points) or not _is_finite(points):
            raise InvalidInput("points of the goal", got=_describe(points), expected="[N, 3] finite metres, N >= 1")
        if faces is not None:
            check_triangles(faces, len(points))
        if uv is not None and vertices is not None:
            raise InvalidInput("goal", got="uv and vertices", expected="one of them")
        if uv is not None and (uv.shape != (len(points), 2) or not _is_finite(uv)):
            raise InvalidInput(
                "uv of the goal", got=_describe(uv), expected=f"[{len(points)}, 2] finite metres on the pattern"
            )
        if vertices is not None and vertices.shape != (len(points),):
            raise InvalidInput(
                "vertices of the goal", got=_describe(vertices), expected=f"[{len(points)}], one for each point"
            )
        for name, value in (("points", points), ("faces", faces), ("uv", uv), ("vertices", vertices)):
            object.__setattr__(self, name, value)


def _to_tensor(given: Any, name: str, whole: bool = False) -> Tensor | None:
    """Tensor of the default dtype, or of int64 if ``whole``."""
    try:
        if given is None:
            return None
        tensor = torch.as_tensor(given if isinstance(given, Tensor) else np.array(given)).detach()
        if whole and (tensor.is_floating_point() or tensor.dtype == torch.bool):
            raise TypeError
        return tensor.to(torch.int64 if whole else torch.get_default_dtype())
    except (TypeError, ValueError, RuntimeError):
        expected = "whole numbers" if whole else "numbers in metres"
        remedy = "of a file or an episode: planning.read_goal(path)"
        raise InvalidInput(
            name, got=f"{given!r:.60}", expected=f"{expected}, a tensor or an array", remedy=remedy
        ) from None


def _describe(numbers: Tensor | None) -> str:
    if numbers is None:
        return "none"
    return f"shape {tuple(numbers.shape)}" + ("" if _is_finite(numbers) else ", not all finite")


def _is_finite(numbers: Tensor) -> bool:
    return bool(numbers.isfinite().all())


def read_goal(path: str | Path, correspondences: bool = False) -> Goal:
    """Read a goal from a file or an episode's folder.

    Args:
        path: see ``ACCEPTED_GOALS``.
        correspondences: match material points instead of the surface. A mesh is matched by its pattern coordinates; a
            mesh without them and a pose by vertices, which are those of the cloth's mesh; an episode by its last
            markers. ``.npz`` files with ``uv`` are always matched by material points.

    Raises:
        InvalidInput: the path shows no cloth, or no material points.
        RecordingError: the episode cannot be read, or lacks what is asked for.
    """
    path = Path(path)
    if path.is_dir():
        return _goal_from_markers(read(path)) if correspondences else _goal_from_points(read(path))
    kind = path.suffix.lower()
    if not path.is_file() or kind not in (".npy", ".npz", ".obj", ".ply"):
        what = "file of an unknown kind" if path.is_file() else "no such file or folder"
        raise InvalidInput("goal", got=f"{path}, {what}", expected=ACCEPTED_GOALS)
    if kind == ".npy" and correspondences:
        got = f"{path}, points without pattern coordinates"
        raise InvalidInput("goal", got=got, expected="a mesh, a pose, markers, or .npz with x and uv")
    if kind in (".obj", ".ply"):
        mesh = load(path)
        if (
            correspondences and mesh.uv is not None
        ):  # vertices of the cloth's mesh may have been moved to where a grasp ends
            return Goal(torch.as_tensor(mesh.vertices), uv=torch.as_tensor(mesh.uv))
        vertices = _vertex_indices(mesh.vertices, correspondences)
        return Goal(torch.as_tensor(mesh.vertices), torch.as_tensor(mesh.faces), vertices=vertices)
    try:
        content = load_arrays(path.read_bytes(), str(path))
        if kind == ".npy":
            return Goal(torch.as_tensor(np.asarray(content, dtype=float)))
        x = np.asarray(content["x"], dtype=float)
        x = x[-1] if x.ndim == 3 else x
        if "uv" in content:
            return Goal(torch.as_tensor(x), uv=torch.as_tensor(np.asarray(content["uv"], dtype=float)))
        return Goal(torch.as_tensor(x), torch.as_tensor(content["faces"]), vertices=_vertex_indices(x, correspondences))
    except TorchclothError:
        raise
    except Exception as error:  # a damaged archive can raise almost anything
        raise InvalidInput("goal", got=f"{path} ({type(error).__name__})", expected=ACCEPTED_GOALS) from None


def _vertex_indices(points: np.ndarray, correspondences: bool) -> Tensor | None:
    return torch.arange(len(points)) if correspondences else None


def _goal_from_points(recording: Recording) -> Goal:
    points = recording.require("points", by="a goal")
    return Goal(torch.as_tensor(points.frame(len(points) - 1)))


def _goal_from_markers(recording: Recording) -> Goal:
    markers = recording.require("markers", by="a goal of correspondences")
    seen_last = np.isfinite(markers.xyz[-1]).all(-1)
    if markers.uv is None or not seen_last.any():
        got = "markers without pattern coordinates" if markers.uv is None else "no marker in the last frame"
        raise InvalidInput("goal", got=got, expected="markers with uv, of which some are seen at the end")
    return Goal(torch.as_tensor(markers.xyz[-1][seen_last]), uv=torch.as_tensor(markers.uv[seen_last]))
