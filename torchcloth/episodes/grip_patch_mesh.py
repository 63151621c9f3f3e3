"""Grasped patches whose edge lies between the vertices of a mesh.

Grippers hold whole vertices. A patch that moves by a few millimetres would hold either the same vertices or others that
lie a whole edge away. Here the same vertices are held, and the pattern of the mesh is stretched so that they lie at the
edge of the patch. Simulated positions are interpolated back to the original pattern, so nobody sees the other mesh.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..boundaries import Grasp
from ..cloth import Cloth
from ..errors import InvalidInput, SimulationDiverged
from ..meshes import Mesh
from ..meshes.mesh import signed_area
from ..meshes.patches import Patch, project_along_rim
from .observed import Episode
from .pattern_interpolation import interpolate_on_pattern, interpolation_weights
from .replay import Frames
from .world import World, rebuild_cloth

MAX_REMEMBERED_CLOTHS = 8  # that are gripped otherwise
TAPER_RADII = 1.0  # distance over which the pattern around a patch gives way, in radii; farther out meshes differ more
MIN_TAPER_RATIO = 1.5  # of this distance to that by which the patch's edge moves outwards, or small triangles fold
MAX_SHRINKAGE_RADII, MAX_GROWTH_RADII = 0.7, 1.5  # of a patch; smaller ones need ever shorter steps
TRIED_FRACTIONS = tuple(0.1 * k for k in range(10, 0, -1))  # of these
MIN_TRIANGLE_AREA_RATIO = 0.08  # of a stretched triangle to the original one


class StretchedCloth(NamedTuple):
    """A cloth on a mesh whose pattern is stretched around the grips.

    Attributes:
        cloth: on the stretched mesh.
        to_stretched: [V, V] sparse weights, from values at the original pattern's vertices.
        to_original: [V, V] sparse weights, back.
    """

    cloth: Cloth
    to_stretched: Tensor
    to_original: Tensor

    def take(self, values: Tensor) -> Tensor:
        """Return values [..., V, C] of the original vertices at the stretched ones."""
        return interpolate_on_pattern(self.to_stretched, values)

    def take_start(self, episode: Episode) -> Episode:
        """Return the episode with its first state at the stretched vertices."""
        velocity = episode.initial_velocity
        velocity = None if velocity is None else self.take(velocity)
        return replace(episode, initial=self.take(episode.initial), initial_velocity=velocity)

    def view(self, frames: Frames) -> Frames:
        """Return frames, or derivatives of them, at the original vertices."""
        x, v = (interpolate_on_pattern(self.to_original, value) for value in (frames.x, frames.v))
        return frames._replace(x=x, v=v)


def grip_patches(cloth: Cloth) -> dict[str, Patch]:
    """Return the grasped patches whose place on the pattern is known, by gripper."""
    grasps = {name: part for name, part in cloth.boundaries.items() if isinstance(part, Grasp)}
    return {
        name: Patch(part.uv, part.radius)
        for name, part in grasps.items()
        if part.uv is not None and cloth.mesh.uv is not None
    }


def stretch_around_grips(cloth: Cloth, wider: Mapping[str, float], along: float = 0.0) -> StretchedCloth:
    """Return the cloth with other patches gripped.

    Args:
        cloth: the original.
        wider: distance by which a patch's edge moves outwards [m], by gripper.
        along: distance by which all patches move along u [m].

    Raises:
        InvalidInput: the pattern around the patches has no room for such a change.
    """
    before, patches = cloth.mesh, grip_patches(cloth)
    uv = _stretch_pattern(before, patches, wider, along)
    to_stretched = interpolation_weights(before, uv)
    vertices = interpolate_on_pattern(to_stretched, torch.as_tensor(before.vertices)).numpy()
    mesh = Mesh.build(vertices, before.faces, uv, before.places)
    parts = {
        name: part.shifted(wider.get(name, 0.0), along)
        for name, part in cloth.boundaries.items()
        if isinstance(part, Grasp) and name in patches
    }
    to_original = interpolation_weights(mesh, np.asarray(before.uv))
    return StretchedCloth(rebuild_cloth(cloth, {}, None, parts, mesh), to_stretched, to_original)


def grip_extent_range(cloth: Cloth) -> tuple[float, float]:
    """Return by how much the pattern lets all patches shrink (negative) and grow, in radii of each."""
    patches = grip_patches(cloth)
    ends = [0.0, 0.0]
    for k, most in enumerate((-MAX_SHRINKAGE_RADII, MAX_GROWTH_RADII)):
        for fraction in TRIED_FRACTIONS:
            wider = {name: fraction * most * patch.radius for name, patch in patches.items()}
            with suppress(InvalidInput):
                _stretch_pattern(cloth.mesh, patches, wider, 0.0)
                ends[k] = fraction * most
                break
    return ends[0], ends[1]


class GrippedCloths:
    """A cloth whose grippers hold more or less than stated; the last few are remembered.

    Args:
        cloth: as stated.
    """

    def __init__(self, cloth: Cloth) -> None:
        self.cloth = cloth
        self._recent: dict[tuple[tuple[str, float], ...], StretchedCloth] = {}

    def grip(self, wider: Mapping[str, float]) -> tuple[Cloth, StretchedCloth | None]:
        """Return the cloth, and the stretched one that it is part of; None where it is gripped as stated.

        Args:
            wider: distance by which each patch's edge lies farther out [m], by gripper.

        Raises:
            SimulationDiverged: the pattern has no room for such grips.
        """
        if not any(wider.values()):
            return self.cloth, None
        key = tuple(wider.items())
        if key not in self._recent:
            try:
                self._recent[key] = stretch_around_grips(self.cloth, wider)
            except InvalidInput as error:
                raise SimulationDiverged(f"the cloth in its grips: {error}") from None
            while len(self._recent) > MAX_REMEMBERED_CLOTHS:
                del self._recent[next(iter(self._recent))]
        return self._recent[key].cloth, self._recent[key]


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
    patches = grip_patches(world.cloth)
    if not patches:
        return world
    stretched = stretch_around_grips(world.cloth, dict.fromkeys(patches, wider), along)

    def view(frames: Frames, _: Episode) -> Frames:
        return stretched.view(frames)

    return World(
        stretched.cloth, (*world.motion_transforms, stretched.take_start), (view, *world.observation_transforms)
    )


def _stretch_pattern(mesh: Mesh, patches: Mapping[str, Patch], wider: Mapping[str, float], along: float) -> np.ndarray:
    """Return [V, 2] m: a patch's vertices move with its edge, those around it less and less, the rim along itself."""
    uv: np.ndarray = mesh.uv  # type: ignore[assignment] - patches have places
    displacement = np.zeros_like(uv)
    to_end = np.minimum(uv[:, 0] - uv[:, 0].min(), uv[:, 0].max() - uv[:, 0])  # distance to the nearer end along u
    for name, patch in patches.items():
        radius, offset = patch.radius, patch.offset_from_centre(uv)
        gaps = [_gap_between(patch, other) for other_name, other in patches.items() if other_name != name]
        distance = np.linalg.norm(offset, axis=1)
        taper = max(TAPER_RADII * radius, MIN_TAPER_RATIO * wider.get(name, 0.0))
        weight = np.clip(1 - (distance - radius) / min([taper, *gaps]), 0.0, 1.0)[:, None]
        outwards = offset / np.maximum(distance, radius)[:, None]
        sideways = np.stack([np.minimum(to_end / radius, 1.0), np.zeros(len(uv))], 1)
        displacement += weight * (wider.get(name, 0.0) * outwards + along * sideways)
    stretched = uv + np.einsum("vij,vj->vi", project_along_rim(mesh, uv), displacement)
    if (signed_area(stretched[mesh.faces]) / signed_area(uv[mesh.faces])).min() < MIN_TRIANGLE_AREA_RATIO:
        sizes = ", ".join(f"{1e3 * w:g}" for w in wider.values())
        got = f"patches {sizes} mm wider and {1e3 * along:g} mm further along"
        raise InvalidInput("grip", got=got, expected="as much as the pattern around them has room for")
    return stretched


def _gap_between(one: Patch, other: Patch) -> float:
    """Return the width of the pattern between two patches [m]; infinite if they overlap."""
    distance = np.linalg.norm(one.centres[:, None] - other.centres, axis=-1).min()
    gap = float(distance) - one.radius - other.radius
    return gap if gap > 0 else np.inf
