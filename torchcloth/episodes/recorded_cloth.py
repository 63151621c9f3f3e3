"""The cloth that a recording describes: mesh, material, effects and boundaries, and where its vertices begin."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..boundaries import Grasp, Plane
from ..cloth import Cloth
from ..dynamics.contact import Contact
from ..effects import AbstractEffect, AirDrag, Bending, Gravity
from ..errors import InvalidInput, RecordingError
from ..materials import AEP, AbstractMaterial
from ..meshes import Mesh, rectangle
from ..meshes.patches import Patch
from ..recordings import Recording
from ..recordings.initial_shape import check_initial_shape
from ..recordings.scene import DEFAULT_TABLE_FRICTION, DEFAULT_THICKNESS_M
from ..simulation.argument_checks import EXPECTED_PART_NAME, is_name
from .pattern_interpolation import interpolate_on_pattern, interpolation_weights, move_vertices_to_patches

DEFAULT_MEMBRANE_STIFFNESS_N_PER_M = 300.0  # middle of the published fabrics, where an episode names none
DEFAULT_POISSON_RATIO = 0.2
DEFAULT_CONTACT_STIFFNESS_N_PER_M = 100.0  # k h; more shortens the stable step, and layers at rest hardly notice
DEFAULT_LAYER_FRICTION = 0.3
DEFAULT_SHEET_TRIANGLES = 288
SAME_PATTERN_PLACE_M = 1e-6  # distance on the pattern within which two places are one


def build_cloth(
    recording: Recording,
    material: AbstractMaterial | None = None,
    effects: Mapping[str, AbstractEffect] | None = None,
    contact: Contact | None = None,
) -> Cloth:
    """Build the cloth that an episode describes, with its grasps and colliders.

    Args:
        recording: names mesh or sheet, density, grasps, colliders, gravity, air.
        material: None: A-EP at the episode's nominal values, or at a start in the middle of published fabrics.
        effects: None: gravity; bending where the episode has a nominal value; air drag where it states a density.
        contact: between layers; None: as the episode's ``layer_gap`` says, without which layers do not touch.

    Raises:
        RecordingError: the episode has neither mesh nor sheet, or layers cannot meet at its ``layer_gap``.
        InvalidInput: parts that do not fit each other.
    """
    mesh = build_mesh(recording)
    if effects is None:
        effects = build_effects(recording)
    if both := recording.colliders.keys() & recording.grasps.keys():
        raise InvalidInput(
            f"{recording.path}: names", got=f"a grasp and a collider {min(both)!r}", expected="a name for each"
        )
    for name in (*recording.colliders, *recording.grasps):
        if not is_name(name):
            raise RecordingError(
                f"{recording.path}: name of a grasp or collider",
                got=repr(name),
                expected=EXPECTED_PART_NAME,
                remedy="rename it in episode.json and motion.npz",
            )
    boundaries = {}
    for name, collider in recording.colliders.items():
        friction = DEFAULT_TABLE_FRICTION if collider.friction is None else collider.friction
        boundaries[name] = Plane(collider.point.tolist(), collider.normal.tolist(), friction)
    for name, grasp in recording.grasps.items():
        vertices = None if grasp.vertices is None else grasp.vertices.tolist()
        boundaries[name] = Grasp(vertices) if grasp.uv is None else Grasp(uv=grasp.uv, radius=grasp.radius)
    density = recording.cloth.areal_density
    gap = recording.cloth.layer_gap if contact is None else None
    contact = contact if gap is None else Contact.with_gap(gap)
    cloth = Cloth(mesh, material or build_material(recording), density, effects, boundaries, contact)
    grid = cloth.contact_grid()
    if gap is not None and grid is not None and not grid.can_act:
        raise RecordingError(
            f"{recording.path}: cloth.layer_gap",
            got=f"{1e3 * gap:g} mm, at which layers of this cloth cannot meet ({grid.summary})",
            expected="a gap at which they can",
            remedy="give a smaller gap, a mesh of smaller triangles, or leave it out",
        )
    return cloth


def build_mesh(recording: Recording) -> Mesh:
    """Build the episode's rest mesh or rectangular sheet, with vertices at the edges of patches that have a radius.

    Raises:
        RecordingError: neither mesh nor sheet is given.
    """
    cloth = recording.cloth
    if cloth.vertices is not None and cloth.faces is not None:
        mesh = Mesh.build(cloth.vertices, cloth.faces, cloth.uv)
    elif cloth.sheet is not None:
        mesh = rectangle(*cloth.sheet, triangles=DEFAULT_SHEET_TRIANGLES)
    else:
        raise RecordingError(
            f"{recording.path}: cloth",
            got="neither mesh nor sheet",
            expected="cloth.mesh or cloth.sheet in episode.json",
        )
    patches = [Patch(np.atleast_2d(g.uv), g.radius) for g in recording.grasps.values() if g.uv is not None]
    return move_vertices_to_patches(mesh, patches)


def build_effects(recording: Recording) -> dict[str, AbstractEffect]:
    """Return gravity; bending at its data-sheet value, if there is one; drag of a flat plate, if there is air."""
    effects: dict[str, AbstractEffect] = {"gravity": Gravity(recording.gravity.tolist())}
    nominal = recording.cloth.nominal
    if "bending_stiffness" in nominal:
        damping = _nominal_number(nominal, "bending_damping_time", 0.0) or None  # nothing to learn where none is stated
        effects["bending"] = Bending(_nominal_number(nominal, "bending_stiffness", 0.0), damping)
    if recording.air_density is not None:
        effects["air"] = AirDrag(normal=AirDrag.amplitudes["normal"].typical, density=recording.air_density)
    return effects


def build_material(recording: Recording) -> AEP:
    """Return a material at the episode's nominal values, or at a start in the middle of published fabrics."""
    nominal, thickness = recording.cloth.nominal, recording.cloth.thickness or DEFAULT_THICKNESS_M
    stiffness = _nominal_number(nominal, "membrane_stiffness", DEFAULT_MEMBRANE_STIFFNESS_N_PER_M)
    youngs_modulus = _nominal_number(nominal, "youngs_modulus", stiffness / thickness)
    poisson_ratio = _nominal_number(nominal, "poisson_ratio", DEFAULT_POISSON_RATIO)
    if recording.cloth.layer_gap is None:
        return AEP(youngs_modulus, poisson_ratio, thickness=thickness)
    contact_stiffness = _nominal_number(nominal, "contact_stiffness", DEFAULT_CONTACT_STIFFNESS_N_PER_M / thickness)
    return AEP(
        youngs_modulus,
        poisson_ratio,
        contact_stiffness=contact_stiffness,
        shear_stiffness=_nominal_number(nominal, "shear_stiffness", contact_stiffness / 4),
        cone=_nominal_number(nominal, "cone", DEFAULT_LAYER_FRICTION),
        thickness=thickness,
    )


def _nominal_number(nominal: Mapping[str, Any], key: str, default: float) -> float:
    try:
        return float(nominal.get(key, default))
    except (TypeError, ValueError):
        raise RecordingError(f"cloth.nominal.{key}", got=repr(nominal[key]), expected="a number in SI units") from None


def compute_initial_vertices(name: str, cloth: Cloth, recording: Recording) -> Tensor:
    """Return the vertex positions [V, 3] m at the first frame.

    Where the cloth has the episode's triangles at other places of the pattern, positions are interpolated there.

    Args:
        name: of the episode, in messages.
        cloth: whose vertices are wanted.
        recording: the episode.

    Raises:
        InvalidInput: initial vertices that do not belong to the cloth's mesh.
    """
    initial = recording.cloth.initial_vertices
    if initial is not None and initial.ndim == 3 and cloth.mesh.uv is not None:
        initial = recording.cloth.interpolate_initial_positions(cloth.mesh.uv)
    vertices = cloth.mesh.vertices if initial is None else initial
    if vertices.shape != cloth.mesh.vertices.shape:
        raise InvalidInput(
            f"{name}: initial_vertices",
            got=f"{len(vertices)} rows",
            expected=f"{len(cloth.mesh.vertices)}, one per vertex",
            remedy="give the mesh that the initial vertices belong to",
        )
    if initial is None:
        return torch.as_tensor(vertices)
    check_initial_shape(recording.cloth, f"{name}: initial_vertices")
    return transfer_vertices(cloth.mesh, recording, torch.as_tensor(initial))


def compute_initial_velocities(cloth: Cloth, recording: Recording) -> Tensor | None:
    """Return the velocities [V, 3] m/s of the vertices at the first frame; None: the cloth is at rest there.

    Args:
        cloth: whose vertices are wanted; they are those of ``compute_initial_vertices``.
        recording: the episode.
    """
    velocities = recording.cloth.initial_velocities
    return None if velocities is None else transfer_vertices(cloth.mesh, recording, torch.as_tensor(velocities))


def transfer_vertices(mesh: Mesh, recording: Recording, initial: Tensor) -> Tensor:
    """Interpolate vertex positions of an episode's mesh to a mesh with the same triangles at other pattern places.

    Args:
        mesh: the mesh.
        recording: the episode.
        initial: [V, 3] m, positions of the vertices of the episode's mesh.

    Returns:
        [V, 3] m, positions of the vertices of ``mesh``.

    Raises:
        InvalidInput: a mesh with other places of the pattern and other triangles.
    """
    info = recording.cloth
    if info.vertices is None or info.faces is None or info.uv is None or mesh.uv is None:
        return initial
    if np.allclose(info.uv, mesh.uv, rtol=0, atol=SAME_PATTERN_PLACE_M):
        return initial
    triangles, recorded = (np.unique(np.sort(faces, axis=1), axis=0) for faces in (mesh.faces, info.faces))
    if not np.array_equal(triangles, recorded):
        raise InvalidInput(
            "initial_vertices",
            got="those of a mesh with other triangles",
            expected="positions of the cloth's vertices, in its order",
            remedy="build the cloth from the episode (build_cloth), or give it the cloth's mesh",
        )
    weights = interpolation_weights(Mesh.build(info.vertices, info.faces, info.uv), mesh.uv)
    return interpolate_on_pattern(weights, initial.double())
