"""Causes in the robot, its grippers and the table."""

from __future__ import annotations

from collections.abc import Callable

import torch

from ...boundaries import Coulomb, Elliptic, Grasp, Plane, Stribeck
from ...cloth import Cloth
from ...effects import Adhesion, GripSlip
from ...episodes.grip_patch_mesh import move_grip_patches
from ...episodes.world import Hypothesis, World
from ...recordings import Recording

MIN_FRICTION = 1e-3
SLIP_THRESHOLD_N = 0.3  # a loose grip yields to larger forces
STRIBECK_SPEED_M_PER_S = 0.01  # static friction has fallen to 1 / e of its excess at this speed
ADHESION_RANGE_M = 1e-3  # of a table's attraction
MAX_NORMAL_COSINE = 0.99  # of a plane's normal with the world's x; a larger one is x itself


def _list_grasps(world: World) -> dict[str, Grasp]:
    return {name: part for name, part in world.cloth.boundaries.items() if isinstance(part, Grasp)}


def _add_slip(world: World, mobility: float) -> World:
    return world.with_cloth(
        {f"slip_{name}": GripSlip(name, mobility, SLIP_THRESHOLD_N) for name in _list_grasps(world)}
    )


def _change_planes(world: World, change: Callable[[Plane], Plane]) -> World:
    parts = {}
    for name, part in world.cloth.boundaries.items():
        if isinstance(part, Plane):
            parts[name] = change(part)
    return world.with_cloth(boundaries=parts) if parts else world


def _change_friction(world: World, more: float = 0.0, along: float = 0.0, excess: float = 0.0) -> World:
    """Add friction, a fraction along one axis, and an excess before the cloth slips.

    No law has both a direction and an excess: with the one, the other changes nothing.
    """

    def change(plane: Plane) -> Plane:
        law: Coulomb = plane.friction  # type: ignore[assignment]
        mu = max(law.value.item() + more, MIN_FRICTION)
        ratio = law.ratio.value.item() if isinstance(law, Elliptic) else 1.0
        static_excess = excess + (law.excess.value.item() if isinstance(law, Stribeck) else 0.0)
        if (along or ratio != 1.0) and static_excess:
            return plane
        if static_excess:
            new: Coulomb | float = Stribeck(mu, mu + static_excess, STRIBECK_SPEED_M_PER_S)
        elif along or ratio != 1.0:
            new = Elliptic(mu * (1 + along), mu * ratio, _friction_axis(plane))
        else:
            new = mu
        return Plane(plane.point.tolist(), plane.normal.tolist(), new)

    return _change_planes(world, change)


def compute_min_friction_change(cloth: Cloth) -> float:
    """Return the change of friction at which the smallest friction of a plane is as small as possible."""
    frictions = [part.friction.value.item() for part in cloth.boundaries.values() if isinstance(part, Plane)]
    return MIN_FRICTION - min(frictions, default=0.0)


def _friction_axis(plane: Plane) -> list[float]:
    """Return the axis of an elliptic friction, else the world's x within the plane; its y for walls normal to x."""
    if isinstance(plane.friction, Elliptic):
        return plane.friction.axis.tolist()
    normal = plane.normal.double()
    x, y, _ = torch.eye(3, dtype=torch.float64)
    aside = x if abs(float(normal[0])) < MAX_NORMAL_COSINE else y
    return (aside - (aside @ normal) * normal).tolist()


def _add_adhesion(world: World, stress: float) -> World:
    tables = {name: part for name, part in world.cloth.boundaries.items() if isinstance(part, Plane)}
    pulls = {
        f"{name}_pull": Adhesion(stress, ADHESION_RANGE_M, point=t.point.tolist(), normal=t.normal.tolist())
        for name, t in tables.items()
    }
    return world.with_cloth(pulls)


def _has_table(recording: Recording) -> bool:
    return bool(recording.colliders)


HYPOTHESES = (
    Hypothesis.from_amplitude(GripSlip, "mobility", _add_slip, effect_name="slip_*"),
    Hypothesis(
        "grip.width",
        "m",
        0.02,
        lambda w, a: move_grip_patches(w, wider=a),
        max_amplitude=0.05,
        title="Width of the grip",
        description="The grippers hold a larger patch than stated.",
    ),
    Hypothesis(
        "robot.regrasp",
        "m",
        0.017,
        lambda w, a: move_grip_patches(w, along=a),
        signed=True,
        min_amplitude=-0.04,
        max_amplitude=0.04,
        title="Place of the grip",
        description="The grippers hold the cloth elsewhere along its edge than stated.",
    ),
    Hypothesis(
        "contact.mu",
        "-",
        0.2,
        lambda w, a: _change_friction(w, more=a),
        signed=True,
        is_applicable=_has_table,
        title="Friction (mu)",
        description="Friction on the table is stronger, or weaker, than stated.",
    ),
    Hypothesis(
        "contact.aniso",
        "-",
        -0.5,
        lambda w, a: _change_friction(w, along=a),
        signed=True,
        is_applicable=_has_table,
        min_amplitude=-0.9,
        title="Anisotropy of friction",
        description="Friction on the table depends on the direction of sliding.",
    ),
    Hypothesis(
        "contact.stick",
        "-",
        0.3,
        lambda w, a: _change_friction(w, excess=a),
        is_applicable=_has_table,
        title="Static friction",
        description="Friction on the table is stronger before the cloth slips than while it does.",
    ),
    Hypothesis.from_amplitude(Adhesion, "stress", _add_adhesion, effect_name="*_pull", is_applicable=_has_table),
)
