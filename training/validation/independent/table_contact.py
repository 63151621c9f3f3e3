"""A table under the sheet: penalty against penetration, friction by a spring that slides at Coulomb's limit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from .force_terms import Hook

if TYPE_CHECKING:
    from .mujoco_cloth import MujocoCloth

Array = np.ndarray


@dataclass(frozen=True)
class TableSpec:
    """The half-space z < 0.

    Attributes:
        friction: -, kinetic coefficient.
        along: -, by which friction for slip along x differs, as a share.
        excess: -, static less kinetic coefficient, which falls as exp(-(slip / speed)^2); ``speed`` m/s.
        adhesion: Pa, pull on cloth within ``gap`` m above the table.
    """

    friction: float = 0.4
    along: float = 0.0
    excess: float = 0.0
    speed: float = 0.01
    adhesion: float = 0.0
    gap: float = 1e-3


class Table(Hook):
    """Contact of the vertices with the table; they stick to anchors that slide when friction is exhausted."""

    def __init__(self, spec: TableSpec) -> None:
        self.spec = spec

    def start(self, cloth: MujocoCloth, x: Array) -> None:
        mass = cloth.mass
        self.spring = 0.05 * mass / cloth.dt**2  # a twentieth of what the step would let explode
        self.dashpot = 2 * 0.3 * np.sqrt(self.spring * mass)
        self.area = mass / mass.sum() * cloth.spec.width * cloth.spec.height
        self.anchor = x[:, :2].copy()

    def force(self, t: float, x: Array, v: Array) -> Array:
        spec, z = self.spec, x[:, 2]
        down = z < 0
        push = np.where(down, np.maximum(-self.spring * z - self.dashpot * v[:, 2], 0.0), 0.0)
        drag = -self.spring[:, None] * (x[:, :2] - self.anchor) - self.dashpot[:, None] * v[:, :2]
        size = np.sqrt((drag**2).sum(1)) + 1e-30
        limit = self._coefficient(drag / size[:, None], np.sqrt((v[:, :2] ** 2).sum(1))) * push
        kept = np.minimum(limit / size, 1.0)
        drag *= kept[:, None]
        # a sliding anchor is dragged behind at the length that the friction stretches the spring to
        sliding = kept < 1
        behind = x[:, :2] + drag / self.spring[:, None]
        self.anchor = np.where((down & sliding)[:, None], behind, np.where(down[:, None], self.anchor, x[:, :2]))
        normal = push - np.where(~down & (z < spec.gap), spec.adhesion * self.area, 0.0)
        return np.column_stack([drag, normal])

    def _coefficient(self, direction: Array, slip: Array) -> Array:
        spec = self.spec
        ellipse = np.sqrt((direction[:, 0] * (1 + spec.along)) ** 2 + direction[:, 1] ** 2)
        return (spec.friction + spec.excess * np.exp(-((slip / spec.speed) ** 2))) * ellipse
