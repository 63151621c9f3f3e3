"""Triangle meshes of solids, so that robots and furniture can occlude cloth from a camera."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from typing import Any, Protocol

import numpy as np

from ..errors import InvalidInput

Array = np.ndarray

_BOX_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
_BOX_FACES = np.array(
    [0, 1, 3, 0, 3, 2, 4, 6, 7, 4, 7, 5, 0, 4, 5, 0, 5, 1, 2, 3, 7, 2, 7, 6, 0, 2, 6, 0, 6, 4, 1, 5, 7, 1, 7, 3]
).reshape(-1, 3)


class Solid(Protocol):
    """A solid at its place, for example one of ``robots.Scene.geometry(q)``."""

    @property
    def kind(self) -> str:
        """Kind of the solid: box, cylinder, sphere or mesh."""
        ...

    @property
    def size(self) -> tuple[float, ...]:
        """Size in m, as in ``build_solid_mesh``."""
        ...

    @property
    def pose(self) -> Any:
        """Pose [..., 4, 4] m of the centre in the world; of a mesh, the origin of its vertices."""
        ...


def build_solid_meshes(solids: Iterable[Solid], at: int | None = None) -> list[tuple[Array, Array]]:
    """Build meshes of a robot's solids: ``build_solid_meshes(scene.geometry(q), at=k)``.

    Args:
        solids: with kind, size (see ``build_solid_mesh``) and pose, a tensor or array [4, 4], or [K, 4, 4] at K times;
            one of kind "mesh" has ``mesh``, its vertices [V, 3] m and triangles [F, 3].
        at: index of the time; None if there is only one.
    """
    placed = []
    for solid in solids:
        pose = solid.pose.detach().cpu().numpy() if hasattr(solid.pose, "detach") else np.asarray(solid.pose)
        pose = pose if at is None else pose[at]
        mesh = getattr(solid, "mesh", None)
        if mesh is None:
            placed.append(build_solid_mesh(solid.kind, solid.size, pose))
        else:
            vertices, faces = mesh
            placed.append(_place(vertices, faces, pose))
    if not placed:
        warnings.warn(
            "no solid: an arm without solids hides nothing, and where a camera sees it, it is taken for cloth; add "
            "boxes, cylinders, spheres or meshes to its URDF",
            stacklevel=2,
        )
    return placed


def build_solid_mesh(kind: str, size: tuple[float, ...], pose: Array, segments: int = 24) -> tuple[Array, Array]:
    """Build vertices [V, 3] m in the world and triangles [F, 3] of a box, a cylinder or a sphere.

    Args:
        kind: "box", "cylinder" or "sphere".
        size: m; box: edges x, y, z; cylinder: radius, length along z; sphere: radius.
        pose: [4, 4] m, of the centre in the world, at one time.
        segments: corners of a circle. The mesh lies inside the true solid by up to radius * (1 - cos(pi / segments));
            for a sphere, by twice that.

    Raises:
        InvalidInput: an unknown kind, sizes that do not fit it, or poses at several times.
    """
    size_counts = {"box": 3, "cylinder": 2, "sphere": 1}
    if kind not in size_counts:
        raise InvalidInput("kind", got=repr(kind), expected=f"one of {', '.join(size_counts)}")
    if len(size) != size_counts[kind] or not all(0 < length < np.inf for length in size) or segments < 3:
        raise InvalidInput(
            "size", got=size, expected=f"{size_counts[kind]} positive lengths in m", remedy="segments >= 3"
        )
    if kind == "box":
        vertices, faces = _BOX_CORNERS * np.asarray(size, float), _BOX_FACES
    else:
        vertices, faces = _revolve(*_outline(kind, size, segments), segments)
    return _place(vertices, faces, pose)


def _place(vertices: Array, faces: Array, pose: Array) -> tuple[Array, Array]:
    pose = np.asarray(pose, dtype=float)
    if pose.shape != (4, 4):
        got = f"shape {pose.shape}"
        raise InvalidInput(
            "pose", got=got, expected="[4, 4] at one time", remedy="for several times: build_solid_meshes(..., at=k)"
        )
    if not np.isfinite(pose).all():
        raise InvalidInput("pose", got="NaN or infinite entries", expected="a rigid pose [R p; 0 1]")
    return vertices @ pose[:3, :3].T + pose[:3, 3], faces


def _outline(kind: str, size: tuple[float, ...], segments: int) -> tuple[Array, Array]:
    """Radius and height [N] of the curve that is revolved about z; it starts and ends on the axis."""
    if kind == "cylinder":
        return np.array([0, size[0], size[0], 0]), size[1] * np.array([-0.5, -0.5, 0.5, 0.5])
    angle = np.linspace(0, np.pi, max(2, (segments + 1) // 2) + 1)
    return size[0] * np.sin(angle), -size[0] * np.cos(angle)


def _revolve(radius: Array, height: Array, segments: int) -> tuple[Array, Array]:
    angle = 2 * np.pi * np.arange(segments) / segments
    ring = np.stack([np.cos(angle), np.sin(angle)], -1)
    flat = radius[:, None, None] * ring
    vertices = np.concatenate([flat, np.broadcast_to(height[:, None, None], (*flat.shape[:2], 1))], -1).reshape(-1, 3)
    here = np.arange(segments)
    after = (here + 1) % segments
    faces = []
    for k in range(len(radius) - 1):
        a, b = k * segments, (k + 1) * segments
        faces += [np.stack([a + here, a + after, b + after], 1), np.stack([a + here, b + after, b + here], 1)]
    return vertices, np.concatenate(faces)
