"""What the robot and its grippers may do other than they say."""

from __future__ import annotations

import numpy as np

from ..boundaries import Coulomb, Grasp, Plane
from ..effects import GripSlip
from .world import Hypothesis, World

HOLD = 0.3  # N, above which a loose grip yields


def _grasps(world: World) -> dict[str, Grasp]:
    return {name: part for name, part in world.cloth.boundaries.items() if isinstance(part, Grasp)}


def _slip(world: World, mobility: float) -> World:
    return world.with_cloth({f"slip_{name}": GripSlip(name, mobility, HOLD) for name in _grasps(world)})


def _regrasped(world: World, wider: float = 0.0, along: float = 0.0) -> World:
    """Patches of another radius, or further along u, where they are known by their place."""
    parts = {}
    for name, grasp in _grasps(world).items():
        if grasp._uv is not None:
            uv = np.asarray(grasp._uv, float) + np.array([along, 0.0])
            parts[name] = Grasp(uv=uv, radius=grasp.radius + wider)
    return world.with_cloth(boundaries=parts) if parts else world


def _planes(world: World, change) -> World:
    parts = {}
    for name, part in world.cloth.boundaries.items():
        if isinstance(part, Plane):
            parts[name] = change(part)
    return world.with_cloth(boundaries=parts) if parts else world


def _friction(world: World, more: float) -> World:
    def changed(plane: Plane) -> Plane:
        law: Coulomb = plane.friction  # type: ignore[assignment]
        return Plane(plane.point.tolist(), plane.normal.tolist(), max(0.0, float(law.value) + more))

    return _planes(world, changed)


HYPOTHESES = (
    Hypothesis("grip.slip", "m/(N s)", 0.05, _slip),
    Hypothesis("grip.width", "m", 0.02, lambda w, a: _regrasped(w, wider=a)),
    Hypothesis("robot.regrasp", "m", 0.017, lambda w, a: _regrasped(w, along=a), signed=True),
    Hypothesis("contact.mu", "-", 0.2, _friction, signed=True, needs=lambda r: bool(r.colliders)),
)
