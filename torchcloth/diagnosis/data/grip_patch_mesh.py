"""Patches whose edge lies between a mesh's vertices.

What is held are whole vertices, so a patch that is found a few millimetres further along would be either none or one
by a whole edge. Here the same vertices are held, and the mesh's pattern is stretched so that they lie where the patch
ends. What comes out is carried back to where the vertices were: nobody sees another mesh.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from ...boundaries import Grasp
from ...episodes.observed import Episode
from ...episodes.pattern_interpolation import interpolation_weights, interpolate_on_pattern
from ...episodes.replay import Frames
from ...episodes.world import World, rebuilt
from ...errors import InvalidInput
from ...meshes import Mesh
from ...meshes.mesh import signed_area
from ...meshes.patches import Patch, along_rim

TAPER = 1.0  # radii, over which the pattern around a patch makes room for it: farther out, meshes differ by more
SQUEEZED = 0.1  # of a triangle's area, the least that may be left


def move_grip_patches(world: World, wider: float = 0.0, along: float = 0.0) -> World:
    """Patches that end ``wider`` [m] farther out and lie ``along`` [m] further along u, where their place is known.

    Raises:
        InvalidInput: more than the pattern around the patches has room for.
    """
    before, parts, patches = world.cloth.mesh, {}, []
    for name, part in world.cloth.boundaries.items():
        if isinstance(part, Grasp) and part.uv is not None:
            parts[name] = part.shifted(wider, along)
            patches.append(Patch(part.uv, part.radius))
    if before.uv is None or not patches:
        return world
    uv = _stretched(before, before.uv, patches, wider, along)
    there = interpolation_weights(before, uv)
    vertices = interpolate_on_pattern(there, torch.as_tensor(before.vertices)).numpy()
    mesh = Mesh.build(vertices, before.faces, uv, before.places)
    back = interpolation_weights(mesh, before.uv)
    cloth = rebuilt(world.cloth, {}, None, parts, mesh)
    motion = lambda e: _begun(e, there)  # noqa: E731
    view = lambda frames, _: _seen(frames, back)  # noqa: E731
    return World(cloth, (*world.motions, motion), (view, *world.views))


def _begun(episode: Episode, there: Tensor) -> Episode:
    return replace(episode, initial=interpolate_on_pattern(there, episode.initial))


def _seen(frames: Frames, back: Tensor) -> Frames:
    return frames._replace(x=interpolate_on_pattern(back, frames.x), v=interpolate_on_pattern(back, frames.v))


def _stretched(mesh: Mesh, uv: np.ndarray, patches: list[Patch], wider: float, along: float) -> np.ndarray:
    """[V, 2] m: vertices in a patch go with its edge, those around it less and less; the rim stays the rim."""
    move = np.zeros_like(uv)
    beside = np.minimum(uv[:, 0] - uv[:, 0].min(), uv[:, 0].max() - uv[:, 0])  # to the nearer end of the fabric
    for k, patch in enumerate(patches):
        radius, offset = patch.radius, patch.offset(uv)
        room = min([TAPER * radius, *(_gap(patch, other) for other in patches[:k] + patches[k + 1 :])])
        far = np.linalg.norm(offset, axis=1)
        share = np.clip(1 - (far - radius) / room, 0.0, 1.0)[:, None]
        outwards = offset / np.maximum(far, radius)[:, None]
        sideways = np.stack([np.minimum(beside / radius, 1.0), np.zeros(len(uv))], 1)
        move += share * (wider * outwards + along * sideways)
    placed = uv + np.einsum("vij,vj->vi", along_rim(mesh, uv), move)
    if (signed_area(placed[mesh.faces]) / signed_area(uv[mesh.faces])).min() < SQUEEZED:
        got = f"patches {1e3 * wider:g} mm wider and {1e3 * along:g} mm further along"
        raise InvalidInput("grip", got=got, expected="as much as the pattern around them has room for")
    return placed


def _gap(one: Patch, other: Patch) -> float:
    """Of the pattern between two patches [m]; without bound where there is none."""
    apart = np.linalg.norm(one.centres[:, None] - other.centres, axis=-1).min()
    gap = float(apart) - one.radius - other.radius
    return gap if gap > 0 else np.inf
