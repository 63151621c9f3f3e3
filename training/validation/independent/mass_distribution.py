"""Masses beyond the sheet's areal density, and the direction of gravity."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from .flex_sheet import SheetSpec, vertex_masses
from .force_terms import ForceTerm
from .plate import central_patch

if TYPE_CHECKING:
    from .mujoco_cloth import MujocoCloth

Array = np.ndarray


@dataclass(frozen=True)
class MassSpec:
    """Masses beyond the sheet's own, and the direction of gravity.

    Attributes:
        density: -, fraction by which the areal density differs.
        hem: kg/m, along all four edges.
        seam: kg/m, along v at half the width.
        layer: -, mass of a second layer on the middle ninth of the sheet, over the sheet's own mass there.
        moisture: 1/s, fraction of the mass that the cloth gains per second.
        tilt: rad, by which gravity leans towards ``heading``.
        heading: degrees (0: +x, 90: +y).
    """

    density: float = 0.0
    hem: float = 0.0
    seam: float = 0.0
    layer: float = 0.0
    moisture: float = 0.0
    tilt: float = 0.0
    heading: float = 0.0


def initial_masses(spec: MassSpec, sheet: SheetSpec, uv: Array) -> Array:
    """Return the lumped masses [V] kg at the start."""
    mass = vertex_masses(sheet) * (1 + spec.density) * (1 + spec.layer * central_patch(sheet, uv))
    nu, nv = sheet.nodes
    table = mass.reshape(nv, nu)
    lengths_u, lengths_v = _vertex_lengths(nu, sheet.width), _vertex_lengths(nv, sheet.height)
    for row in (0, -1):
        table[row] += spec.hem * lengths_u
        table[:, row] += spec.hem * lengths_v
    table[:, nu // 2] += spec.seam * lengths_v
    return mass


def _vertex_lengths(n: int, length: float) -> Array:
    out = np.full(n, length / (n - 1))
    out[[0, -1]] /= 2
    return out


class MassDistribution(ForceTerm):
    """Sets the vertices' masses, lets them drift, and tilts gravity."""

    def __init__(self, spec: MassSpec) -> None:
        self.spec = spec

    def reset(self, cloth: MujocoCloth, x: Array) -> None:
        """Give the cloth its initial masses."""
        self.cloth, self.initial = cloth, initial_masses(self.spec, cloth.spec, cloth.uv)
        cloth.set_masses(self.initial.copy())
        g, angle, heading = cloth.spec.gravity, self.spec.tilt, np.deg2rad(self.spec.heading)
        side = -g * np.sin(angle)
        self.added_gravity = np.array([side * np.cos(heading), side * np.sin(heading), g * (np.cos(angle) - 1)])
        self.start_time = None

    def force(self, t: float, x: Array, v: Array) -> Array:
        """Return the force [V, 3] N of tilted gravity, and update the masses."""
        self.start_time = t if self.start_time is None else self.start_time
        if self.spec.moisture:
            self.cloth.set_masses(self.initial * (1 + self.spec.moisture * (t - self.start_time)))
        return self.cloth.mass[:, None] * self.added_gravity
