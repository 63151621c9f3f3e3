"""A table under the sheet: a penalty against penetration, and friction by springs that slide at Coulomb's limit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from .force_terms import ForceTerm

if TYPE_CHECKING:
    from .mujoco_cloth import MujocoCloth

Array = np.ndarray
SPRING_FRACTION = 0.05  # of the stiffness m / dt^2 at which the step would be unstable
DAMPING_RATIO = 0.3  # of the contact spring


@dataclass(frozen=True)
class TableSpec:
    """The half-space z < 0 and its friction.

    Attributes:
        friction: -, kinetic coefficient.
        anisotropy: -, fraction by which friction for slip along x differs.
        static_excess: -, static less kinetic coefficient, which falls as exp(-(slip / speed)^2).
        speed: m/s, see ``static_excess``.
        adhesion: Pa, pull on cloth within ``gap`` above the table.
        gap: m, see ``adhesion``.
    """

    friction: float = 0.4
    anisotropy: float = 0.0
    static_excess: float = 0.0
    speed: float = 0.01
    adhesion: float = 0.0
    gap: float = 1e-3


class TableContact(ForceTerm):
    """Contact of the vertices with the table; they stick to anchors that slide when friction is exhausted."""

    def __init__(self, spec: TableSpec) -> None:
        self.spec = spec

    def reset(self, cloth: MujocoCloth, x: Array) -> None:
        """Set springs and dashpots by the vertices' masses, and put the anchors below positions x [V, 3] m."""
        mass = cloth.mass
        self.spring = SPRING_FRACTION * mass / cloth.dt**2
        self.dashpot = 2 * DAMPING_RATIO * np.sqrt(self.spring * mass)
        self.area = mass / mass.sum() * cloth.spec.width * cloth.spec.height
        self.anchor = x[:, :2].copy()

    def force(self, t: float, x: Array, v: Array) -> Array:
        """Return the contact forces [V, 3] N, and move the anchors of sliding vertices."""
        spec, z = self.spec, x[:, 2]
        is_below = z < 0
        pressure = np.where(is_below, np.maximum(-self.spring * z - self.dashpot * v[:, 2], 0.0), 0.0)
        friction = -self.spring[:, None] * (x[:, :2] - self.anchor) - self.dashpot[:, None] * v[:, :2]
        size = np.sqrt((friction**2).sum(1)) + 1e-30
        limit = self._coefficient(friction / size[:, None], np.sqrt((v[:, :2] ** 2).sum(1))) * pressure
        scale = np.minimum(limit / size, 1.0)
        friction *= scale[:, None]
        # a sliding anchor follows at the length to which the friction stretches its spring
        is_sliding = scale < 1
        following = x[:, :2] + friction / self.spring[:, None]
        stuck_or_free = np.where(is_below[:, None], self.anchor, x[:, :2])
        self.anchor = np.where((is_below & is_sliding)[:, None], following, stuck_or_free)
        normal = pressure - np.where(~is_below & (z < spec.gap), spec.adhesion * self.area, 0.0)
        return np.column_stack([friction, normal])

    def _coefficient(self, direction: Array, slip: Array) -> Array:
        spec = self.spec
        ellipse = np.sqrt((direction[:, 0] * (1 + spec.anisotropy)) ** 2 + direction[:, 1] ** 2)
        return (spec.friction + spec.static_excess * np.exp(-((slip / spec.speed) ** 2))) * ellipse
