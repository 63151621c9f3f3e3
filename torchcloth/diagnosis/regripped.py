"""Patches whose edge lies between a mesh's vertices.

What is held are whole vertices, so a patch that is found a few millimetres further along would be either none or one
by a whole edge. Here the same vertices are held, and the mesh's pattern is stretched so that they lie where the patch
ends. What comes out is carried back to where the vertices were: nobody sees another mesh.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from torch import Tensor

from ..boundaries import Grasp
from ..errors import InvalidInput
from ..identification.carried import between
from ..identification.episodes import Episode
from ..identification.replays import Frames
from ..meshes import Mesh
from ..meshes.mesh import signed_area
from .world import World, rebuilt

TAPER = 1.0  # radii, over which the pattern around a patch makes room for it: farther out, meshes differ by more
SQUEEZED = 0.1  # of a triangle's area, the least that may be left


def regripped(world: World, wider: float = 0.0, along: float = 0.0) -> World:
    """Patches that end ``wider`` [m] farther out and lie ``along`` [m] further along u, where their place is known.

    Raises:
        InvalidInput: more than the pattern around the patches has room for.
    """
    before = world.cloth.mesh
    grasps = {name: part for name, part in world.cloth.boundaries.items() if isinstance(part, Grasp)}
    placed = {name: part for name, part in grasps.items() if part.uv is not None}
    if before.uv is None or not placed:
        return world
    mesh = _stretched(before, list(placed.values()), wider, along)
    there, back = between(before, mesh.uv), between(mesh, before.uv)
    parts = {name: part.moved(wider, along) for name, part in placed.items()}
    cloth = rebuilt(world.cloth, {}, None, parts, mesh)
    motion = lambda e: _begun(e, there)  # noqa: E731
    view = lambda frames, _: _carried(frames, back)  # noqa: E731
    return World(cloth, (*world.motions, motion), (view, *world.views))


def _begun(episode: Episode, there: Tensor) -> Episode:
    return replace(episode, initial=there.to(episode.initial) @ episode.initial)


def _carried(frames: Frames, back: Tensor) -> Frames:
    back = back.to(frames.x)
    return frames._replace(x=back @ frames.x, v=back @ frames.v)


def _stretched(mesh: Mesh, grasps: list[Grasp], wider: float, along: float) -> Mesh:
    """Vertices within a patch go with its edge, those around it less and less; the rim stays the rim."""
    uv: np.ndarray = mesh.uv  # type: ignore[assignment]
    move = np.zeros_like(uv)
    beside = np.minimum(uv[:, 0] - uv[:, 0].min(), uv[:, 0].max() - uv[:, 0])  # to the nearer end of the fabric
    for k, grasp in enumerate(grasps):
        centres, radius = np.atleast_2d(grasp.uv), grasp.radius
        room = min([TAPER * radius, *(_gap(grasp, other) for other in grasps[:k] + grasps[k + 1 :])])
        offset = uv - centres[np.linalg.norm(uv[:, None] - centres, axis=-1).argmin(1)]
        far = np.linalg.norm(offset, axis=1)
        share = np.clip(1 - (far - radius) / room, 0.0, 1.0)[:, None]
        outwards = offset / np.maximum(far, radius)[:, None]
        sideways = np.stack([np.minimum(beside / radius, 1.0), np.zeros(len(uv))], 1)
        move += share * (wider * outwards + along * sideways)
    placed = uv + _along_rim(mesh, uv, move)
    if (signed_area(placed[mesh.faces]) / signed_area(uv[mesh.faces])).min() < SQUEEZED:
        got = f"patches {1e3 * wider:g} mm wider and {1e3 * along:g} mm further along"
        raise InvalidInput("grip", got=got, expected="as much as the pattern around them has room for")
    return Mesh.build(between(mesh, placed).numpy() @ mesh.vertices, mesh.faces, placed, mesh.places)


def _gap(one: Grasp, other: Grasp) -> float:
    """Of the pattern between two patches [m]; without bound where there is none."""
    between_centres = np.linalg.norm(np.atleast_2d(one.uv)[:, None] - np.atleast_2d(other.uv), axis=-1).min()
    gap = float(between_centres) - one.radius - other.radius
    return gap if gap > 0 else np.inf


def _along_rim(mesh: Mesh, uv: np.ndarray, move: np.ndarray) -> np.ndarray:
    """The same displacements [V, 2], those of the rim along it; where it turns, none."""
    edges = mesh.boundary_edges
    side = uv[edges[:, 1]] - uv[edges[:, 0]]
    normal = np.stack([-side[:, 1], side[:, 0]], 1) / np.linalg.norm(side, axis=1, keepdims=True)
    across = np.zeros((len(uv), 2, 2))
    for end in edges.T:
        np.add.at(across, end, normal[:, :, None] * normal[:, None, :])
    size, axes = np.linalg.eigh(across)  # along an axis of size 0 a vertex is free
    free = np.einsum("vik,vk,vjk->vij", axes, size < 1e-6, axes)
    return np.einsum("vij,vj->vi", free, move)
