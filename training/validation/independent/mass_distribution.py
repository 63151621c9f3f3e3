"""Where the sheet is heavier than its areal density says, and where down is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from .flex_sheet import SheetSpec, vertex_masses
from .force_terms import Hook
from .plate import patch

if TYPE_CHECKING:
    from .mujoco_cloth import MujocoCloth

Array = np.ndarray


@dataclass(frozen=True)
class WeightSpec:
    """Masses beyond the sheet's own, and the direction of gravity.

    Attributes:
        density: -, by which the areal density differs, as a share.
        hem: kg/m, along all four edges.
        seam: kg/m, along v at half the width.
        layer: -, a second layer on the middle ninth of the sheet: this many times its own mass more.
        moisture: 1/s, share of the mass that the cloth gains per second.
        tilt: rad, by which gravity leans towards ``heading`` degrees (0: +x, 90: +y).
    """

    density: float = 0.0
    hem: float = 0.0
    seam: float = 0.0
    layer: float = 0.0
    moisture: float = 0.0
    tilt: float = 0.0
    heading: float = 0.0


def masses(spec: WeightSpec, sheet: SheetSpec, uv: Array) -> Array:
    """Lumped masses [V] kg at the start."""
    own = vertex_masses(sheet) * (1 + spec.density) * (1 + spec.layer * patch(sheet, uv))
    nu, nv = sheet.nodes
    table = own.reshape(nv, nu)
    across, down = _lengths(nu, sheet.width), _lengths(nv, sheet.height)
    for row in (0, -1):
        table[row] += spec.hem * across
        table[:, row] += spec.hem * down
    table[:, nu // 2] += spec.seam * down
    return own


def _lengths(n: int, length: float) -> Array:
    out = np.full(n, length / (n - 1))
    out[[0, -1]] /= 2
    return out


class Weight(Hook):
    """Sets the masses, lets them drift, and turns gravity."""

    def __init__(self, spec: WeightSpec) -> None:
        self.spec = spec

    def start(self, cloth: MujocoCloth, x: Array) -> None:
        self.cloth, self.first = cloth, masses(self.spec, cloth.spec, cloth.uv)
        cloth.weigh(self.first.copy())
        g, angle, heading = cloth.spec.gravity, self.spec.tilt, np.deg2rad(self.spec.heading)
        side = -g * np.sin(angle)
        self.turned = np.array([side * np.cos(heading), side * np.sin(heading), g * (np.cos(angle) - 1)])
        self.since = None

    def force(self, t: float, x: Array, v: Array) -> Array:
        self.since = t if self.since is None else self.since
        if self.spec.moisture:
            self.cloth.weigh(self.first * (1 + self.spec.moisture * (t - self.since)))
        return self.cloth.mass[:, None] * self.turned
