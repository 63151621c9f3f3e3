"""Grasped patches whose edge lies between the vertices of a mesh.

Grippers hold whole vertices. A patch that moves by a few millimetres would hold either the same vertices or others that
lie a whole edge away. Here the same vertices are held, and the pattern of the mesh is stretched so that they lie at the
edge of the patch. Simulated positions are interpolated back to the original pattern, so nobody sees the other mesh.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from ...boundaries import Grasp
from ...episodes.observed import Episode
from ...episodes.pattern_interpolation import interpolate_on_pattern, interpolation_weights
from ...episodes.replay import Frames
from ...episodes.world import World, rebuild_cloth
from ...errors import InvalidInput
from ...meshes import Mesh
from ...meshes.mesh import signed_area
from ...meshes.patches import Patch, project_along_rim

TAPER_RADII = 1.0  # distance over which the pattern around a patch gives way, in radii; farther out meshes differ more
MIN_TRIANGLE_AREA_RATIO = 0.1  # of a stretched triangle to the original one


def move_grip_patches(world: World, wider: float = 0.0, along: float = 0.0) -> World:
    """Return a world whose grasped patches are larger or lie elsewhere along the edge.

    Patches whose place on the pattern is not known stay as they are.

    Args:
        world: the world to change.
        wider: distance by which the patches' edges move outwards [m].
        along: distance by which the patches move along u [m].

    Raises:
        InvalidInput: the pattern around the patches has no room for such a change.
    """
    before, parts, patches = world.cloth.mesh, {}, []
    for name, part in world.cloth.boundaries.items():
        if isinstance(part, Grasp) and part.uv is not None:
            parts[name] = part.shifted(wider, along)
            patches.append(Patch(part.uv, part.radius))
    if before.uv is None or not patches:
        return world
    uv = _stretch_pattern(before, before.uv, patches, wider, along)
    to_stretched = interpolation_weights(before, uv)
    vertices = interpolate_on_pattern(to_stretched, torch.as_tensor(before.vertices)).numpy()
    mesh = Mesh.build(vertices, before.faces, uv, before.places)
    to_original = interpolation_weights(mesh, before.uv)
    cloth = rebuild_cloth(world.cloth, {}, None, parts, mesh)

    def motion(episode: Episode) -> Episode:
        return replace(episode, initial=interpolate_on_pattern(to_stretched, episode.initial))

    def view(frames: Frames, _: Episode) -> Frames:
        return frames._replace(
            x=interpolate_on_pattern(to_original, frames.x), v=interpolate_on_pattern(to_original, frames.v)
        )

    return World(cloth, (*world.motion_transforms, motion), (view, *world.observation_transforms))


def _stretch_pattern(mesh: Mesh, uv: np.ndarray, patches: list[Patch], wider: float, along: float) -> np.ndarray:
    """Return [V, 2] m: a patch's vertices move with its edge, those around it less and less, the rim along itself."""
    displacement = np.zeros_like(uv)
    to_end = np.minimum(uv[:, 0] - uv[:, 0].min(), uv[:, 0].max() - uv[:, 0])  # distance to the nearer end along u
    for k, patch in enumerate(patches):
        radius, offset = patch.radius, patch.offset_from_centre(uv)
        room = min([TAPER_RADII * radius, *(_gap_between(patch, other) for other in patches[:k] + patches[k + 1 :])])
        distance = np.linalg.norm(offset, axis=1)
        weight = np.clip(1 - (distance - radius) / room, 0.0, 1.0)[:, None]
        outwards = offset / np.maximum(distance, radius)[:, None]
        sideways = np.stack([np.minimum(to_end / radius, 1.0), np.zeros(len(uv))], 1)
        displacement += weight * (wider * outwards + along * sideways)
    stretched = uv + np.einsum("vij,vj->vi", project_along_rim(mesh, uv), displacement)
    if (signed_area(stretched[mesh.faces]) / signed_area(uv[mesh.faces])).min() < MIN_TRIANGLE_AREA_RATIO:
        got = f"patches {1e3 * wider:g} mm wider and {1e3 * along:g} mm further along"
        raise InvalidInput("grip", got=got, expected="as much as the pattern around them has room for")
    return stretched


def _gap_between(one: Patch, other: Patch) -> float:
    """Return the width of the pattern between two patches [m]; infinite if they overlap."""
    distance = np.linalg.norm(one.centres[:, None] - other.centres, axis=-1).min()
    gap = float(distance) - one.radius - other.radius
    return gap if gap > 0 else np.inf
