"""Initial scene: the cloth's start on the rig, and the motion of the grippers.

Sizes suit cloth of 0.4 to 0.7 m on the table of ``robots.bimanual_rig``, with x away from the arms and z up.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..boundaries import Grasp, Plane
from ..cloth import Cloth
from ..dynamics.contact import Contact
from ..effects import AirDrag, Bending, Gravity
from ..meshes import Mesh
from ..robots import primitives  # pyright: ignore[reportMissingImports] - mapped from robots/ at installation
from ..robots.primitives import Action, GripperLimits  # pyright: ignore[reportMissingImports]
from .episode_spec import EpisodeSpec
from .garments import BENDING_DAMPING_TIME_S, GARMENTS, Garment, build_garment_mesh, build_material, cloth_properties

ARM_OF_GRIP = ("right", "left")  # arms at -y and +y, which take a garment's first and second grip
INITIAL_LAYER_DISTANCE_M = 1e-3  # between front and back
GARMENT_LAYER_GAP_M = 0.012  # between layers that touch
GRIP_RADIUS_M = 0.026  # of the gripped cloth: a finger pad of 15 x 38 mm across its diagonal
TOOL_HEIGHT_M = 0.015  # of the tool's centre above gripped cloth on the table, because fingers have a thickness
TABLE_FRICTION = 0.4
HANGING_MOTIONS = ("fling", "swing", "shake", "stretch")
MIN_HANGING_HEIGHT_M = 0.12  # of hanging cloth above the table
LAYING_ROLL_RAD = 0.7  # of the hands when they lay cloth over; with more they would hit the table


class InitialScene(NamedTuple):
    """The cloth at its start, and the action.

    Attributes:
        mesh: with the vertices where they start.
        cloth: with grasps and table.
        action: motion of the grippers.
        rest: [V, 3] m, vertices in the garment's frame.
        gripped_vertices: indices of the vertices in each arm's grip.
        hangs: whether the cloth hangs at the start; else it lies on the table.
    """

    mesh: Mesh
    cloth: Cloth
    action: Action
    rest: np.ndarray
    gripped_vertices: dict[str, np.ndarray]
    hangs: bool


def build_initial_scene(spec: EpisodeSpec, rng: np.random.Generator) -> InitialScene:
    """Build cloth, grasps, table and gripper paths of a specification; ``rng`` shifts the cloth by a few mm."""
    garment, hangs = GARMENTS[spec.garment], spec.motion in HANGING_MOTIONS
    garment_mesh = build_garment_mesh(garment, spec.triangles)
    start = _hang(garment_mesh) if hangs else _lay_flat(garment_mesh, spec.motion)
    start[:, :2] += rng.normal(0.0, 0.003, 2)
    mesh = Mesh.build(start, garment_mesh.faces, garment_mesh.pattern, garment_mesh.places)
    action = _action(spec, garment, mesh, float(np.ptp(garment_mesh.vertices[:, 1])))
    radius = max(GRIP_RADIUS_M, mesh.mean_edge)
    gripped_vertices = {
        arm: mesh.vertices_at_place(place, radius) for arm, place in zip(ARM_OF_GRIP, garment.grips, strict=True)
    }
    return InitialScene(
        mesh, _cloth(spec, mesh, gripped_vertices), action, garment_mesh.vertices, gripped_vertices, hangs
    )


def _lay_flat(mesh: Mesh, motion: str) -> np.ndarray:
    """Return vertices [V, 3] m flat on the table, with the gripped end towards the arms (a drag needs room there)."""
    x, y, z = mesh.vertices.T
    nearest_x = 0.46 if motion == "drag" else 0.36
    z = (z - z.min()) * (INITIAL_LAYER_DISTANCE_M / max(float(np.ptp(z)), INITIAL_LAYER_DISTANCE_M))
    return np.stack([nearest_x + y.max() - y, x, z + INITIAL_LAYER_DISTANCE_M], axis=-1)


def _hang(mesh: Mesh) -> np.ndarray:
    """Return vertices [V, 3] m hanging over the table, with the gripped end up."""
    x, y, z = mesh.vertices.T
    z = (z - z.mean()) * (INITIAL_LAYER_DISTANCE_M / max(float(np.ptp(z)), INITIAL_LAYER_DISTANCE_M))
    return np.stack([0.5 + z, x, MIN_HANGING_HEIGHT_M + y - y.min()], axis=-1)


def _cloth(spec: EpisodeSpec, mesh: Mesh, gripped_vertices: dict[str, np.ndarray]) -> Cloth:
    values = cloth_properties(spec.cloth_fabric)
    grasps = {arm: Grasp(vertices.tolist()) for arm, vertices in gripped_vertices.items()}
    return Cloth(
        mesh,
        build_material(spec.cloth_fabric),
        values["areal_density"],
        {
            "gravity": Gravity(),
            "air": AirDrag(),
            "bending": Bending(values["bending_stiffness"], damping_time=BENDING_DAMPING_TIME_S),
        },
        {**grasps, "table": Plane(friction=TABLE_FRICTION, offset=INITIAL_LAYER_DISTANCE_M / 2)},
        Contact.with_gap(GARMENT_LAYER_GAP_M),
    )


def _action(spec: EpisodeSpec, garment: Garment, mesh: Mesh, length: float) -> Action:
    grips = {}
    for arm, place in zip(ARM_OF_GRIP, garment.grips, strict=True):
        x, y, z = mesh.vertices[mesh.places[place]].mean(0).tolist()
        grips[arm] = (x, y, z if spec.motion in HANGING_MOTIONS else z + TOOL_HEIGHT_M)
    limits, heading_away = GripperLimits(spec.speed, spec.acceleration), 0.0
    match spec.motion:
        case "cover":
            return primitives.cover(
                grips, 0.75 * length, heading=heading_away, landing=0.04, roll=LAYING_ROLL_RAD, limits=limits
            )
        case "fold":
            return primitives.fold(
                grips, 0.45 * length, heading=heading_away, landing=0.04, roll=LAYING_ROLL_RAD, limits=limits
            )
        case "drag":
            return primitives.drag(grips, 0.15, heading=math.pi, landing=0.02, limits=limits)
        case "hang":
            return primitives.hang(grips, length + MIN_HANGING_HEIGHT_M, limits=limits)
        case "fling":
            return primitives.fling(grips, 0.18, heading=heading_away, pull=0.25, landing=0.04, limits=limits)
        case "swing":
            return primitives.swing(grips, heading=heading_away, limits=limits)
        case "shake":
            return primitives.shake(grips, limits=limits)
    return primitives.stretch(grips, 0.01, cycles=2, limits=limits)
