"""What the robot and its grippers may do other than they say."""

from __future__ import annotations

import torch

from ...boundaries import Coulomb, Elliptic, Grasp, Plane, Stribeck
from ...cloth import Cloth
from ...effects import Adhesion, GripSlip
from ...episodes.world import Hypothesis, World
from ...recordings import Recording
from ..data.grip_patch_mesh import move_grip_patches

LEAST = 1e-3  # -, of friction
HOLD = 0.3  # N, above which a loose grip yields
SLOW = 0.01  # m/s, of slip at which the excess of friction has fallen to 1 / e
REACH = 1e-3  # m, of a sticky table's pull
STEEP = 0.99  # cosine, of a normal that is the world's x


def _grasps(world: World) -> dict[str, Grasp]:
    return {name: part for name, part in world.cloth.boundaries.items() if isinstance(part, Grasp)}


def _slip(world: World, mobility: float) -> World:
    return world.with_cloth({f"slip_{name}": GripSlip(name, mobility, HOLD) for name in _grasps(world)})


def _planes(world: World, change) -> World:
    parts = {}
    for name, part in world.cloth.boundaries.items():
        if isinstance(part, Plane):
            parts[name] = change(part)
    return world.with_cloth(boundaries=parts) if parts else world


def _friction(world: World, more: float = 0.0, along: float = 0.0, excess: float = 0.0) -> World:
    """By so much (across, times the ratio that the table has); along one axis by a share; before it slips by an excess.

    No law has both a direction and an excess: with the one, the other changes nothing.
    """

    def changed(plane: Plane) -> Plane:
        law: Coulomb = plane.friction  # type: ignore[assignment]
        mu = max(law.value.item() + more, LEAST)
        ratio = law.ratio.value.item() if isinstance(law, Elliptic) else 1.0
        sticky = excess + (law.excess.value.item() if isinstance(law, Stribeck) else 0.0)
        if (along or ratio != 1.0) and sticky:
            return plane
        new = Elliptic(mu * (1 + along), mu * ratio, _axis(plane)) if along or ratio != 1.0 else mu
        return Plane(plane.point.tolist(), plane.normal.tolist(), Stribeck(mu, mu + sticky, SLOW) if sticky else new)

    return _planes(world, changed)


def least_change(cloth: Cloth) -> float:
    """Of friction, at which the least of the planes' is none."""
    every = [part.friction.value.item() for part in cloth.boundaries.values() if isinstance(part, Plane)]
    return LEAST - min(every, default=0.0)


def _axis(plane: Plane) -> list[float]:
    """Of a direction-dependent friction that is there, else the world's x within the plane; of walls along x its y."""
    if isinstance(plane.friction, Elliptic):
        return plane.friction.axis.tolist()
    normal = plane.normal.double()
    x, y, _ = torch.eye(3, dtype=torch.float64)
    aside = x if abs(float(normal[0])) < STEEP else y
    return (aside - (aside @ normal) * normal).tolist()


def _sticky(world: World, stress: float) -> World:
    """Every table pulls."""
    tables = {name: part for name, part in world.cloth.boundaries.items() if isinstance(part, Plane)}
    pulls = {f"{name}_pull": Adhesion(stress, REACH, t.point.tolist(), t.normal.tolist()) for name, t in tables.items()}
    return world.with_cloth(pulls)


def _has_table(recording: Recording) -> bool:
    return bool(recording.colliders)


HYPOTHESES = (
    Hypothesis("grip.slip", "m/(N s)", 0.05, _slip),
    Hypothesis("grip.width", "m", 0.02, lambda w, a: move_grip_patches(w, wider=a), high=0.05),
    Hypothesis("robot.regrasp", "m", 0.017, lambda w, a: move_grip_patches(w, along=a), signed=True, low=-0.04, high=0.04),
    Hypothesis("contact.mu", "-", 0.2, lambda w, a: _friction(w, more=a), signed=True, needs=_has_table),
    Hypothesis("contact.aniso", "-", -0.5, lambda w, a: _friction(w, along=a), signed=True, needs=_has_table, low=-0.9),
    Hypothesis("contact.stick", "-", 0.3, lambda w, a: _friction(w, excess=a), needs=_has_table),
    Hypothesis("contact.adhesion", "Pa", 1.5, _sticky, needs=_has_table),
)
