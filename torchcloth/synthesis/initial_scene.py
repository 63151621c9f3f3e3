"""Where the cloth starts on the rig, and what the grippers then do with it.

Sizes are chosen for cloth of 0.4 to 0.7 m on the table of ``robots.bimanual_rig``: x away from the arms, z up.
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
from .episode_spec import Order
from .garments import DAMPING, GARMENTS, Garment, material, numbers, sewn

ARMS = ("right", "left")  # who takes a garment's first and second grip: the arm at -y, the arm at +y
LAYERS = 1e-3  # m between front and back at the start
GAP = 0.012  # m between layers that touch
PAD = 0.026  # m, radius of what the fingers hold: a finger pad of 15 x 38 mm across its diagonal
ABOVE = 0.015  # m, the tool's centre over the cloth that it holds on the table: fingers have a thickness
FRICTION = 0.4
HANGING = ("fling", "swing", "shake", "stretch")
LOWEST = 0.12  # m, over the table, of hanging cloth
ROLL = 0.7  # rad, by which the hands turn when they lay cloth over; more would bring them to the table


class Staged(NamedTuple):
    """Cloth in its place, and what is done with it."""

    mesh: Mesh  # with the vertices where they start
    cloth: Cloth
    action: Action
    rest: np.ndarray  # [V, 3] m, the vertices in the garment's own frame
    held: dict[str, np.ndarray]  # arm -> indices of the vertices in its grip
    hangs: bool


def stage(order: Order, rng: np.random.Generator) -> Staged:
    """Cloth, grasps, table and path of the grippers for an order; ``rng`` moves the cloth by a few millimetres."""
    garment, hangs = GARMENTS[order.garment], order.motion in HANGING
    made = sewn(garment, order.triangles)
    start = _hung(made) if hangs else _laid(made, order.motion)
    start[:, :2] += rng.normal(0.0, 0.003, 2)
    mesh = Mesh.build(start, made.faces, made.pattern, made.places)
    action = _action(order, garment, mesh, float(np.ptp(made.vertices[:, 1])))
    radius = max(PAD, mesh.mean_edge)
    held = {arm: mesh.around(place, radius) for arm, place in zip(ARMS, garment.grips, strict=True)}
    return Staged(mesh, _cloth(order, mesh, held), action, made.vertices, held, hangs)


def _laid(mesh: Mesh, motion: str) -> np.ndarray:
    """[V, 3] m: flat on the table, the gripped end towards the arms (for a drag, with room behind it)."""
    x, y, z = mesh.vertices.T
    near = 0.46 if motion == "drag" else 0.36
    z = (z - z.min()) * (LAYERS / max(float(np.ptp(z)), LAYERS))
    return np.stack([near + y.max() - y, x, z + LAYERS], axis=-1)


def _hung(mesh: Mesh) -> np.ndarray:
    """[V, 3] m: hanging over the table, the gripped end up."""
    x, y, z = mesh.vertices.T
    z = (z - z.mean()) * (LAYERS / max(float(np.ptp(z)), LAYERS))
    return np.stack([0.5 + z, x, LOWEST + y - y.min()], axis=-1)


def _cloth(order: Order, mesh: Mesh, held: dict[str, np.ndarray]) -> Cloth:
    values = numbers(order.cloth_fabric)
    grasps = {arm: Grasp(vertices.tolist()) for arm, vertices in held.items()}
    return Cloth(
        mesh,
        material(order.cloth_fabric),
        values["areal_density"],
        {
            "gravity": Gravity(),
            "air": AirDrag(),
            "bending": Bending(values["bending_stiffness"], damping_time=DAMPING),
        },
        {**grasps, "table": Plane(friction=FRICTION, offset=LAYERS / 2)},
        Contact.with_gap(GAP),
    )


def _action(order: Order, garment: Garment, mesh: Mesh, length: float) -> Action:
    grips = {}
    for arm, place in zip(ARMS, garment.grips, strict=True):
        x, y, z = mesh.vertices[mesh.places[place]].mean(0).tolist()
        grips[arm] = (x, y, z if order.motion in HANGING else z + ABOVE)
    limits, away = GripperLimits(order.speed, order.acceleration), 0.0
    match order.motion:
        case "cover":
            return primitives.cover(grips, 0.75 * length, heading=away, landing=0.04, roll=ROLL, limits=limits)
        case "fold":
            return primitives.fold(grips, 0.45 * length, heading=away, landing=0.04, roll=ROLL, limits=limits)
        case "drag":
            return primitives.drag(grips, 0.15, heading=math.pi, landing=0.02, limits=limits)
        case "hang":
            return primitives.hang(grips, length + LOWEST, limits=limits)
        case "fling":
            return primitives.fling(grips, 0.18, heading=away, pull=0.25, landing=0.04, limits=limits)
        case "swing":
            return primitives.swing(grips, heading=away, limits=limits)
        case "shake":
            return primitives.shake(grips, limits=limits)
    return primitives.stretch(grips, 0.01, cycles=2, limits=limits)
