"""Bending of the sheet as finite differences on its grid: a Kirchhoff plate, not hinges.

Second differences x_uu and x_vv at the grid's nodes and x_uv in its cells, energy per area B/2 (x_uu^2 + weft x_vv^2 +
2 sqrt(weft) x_uv^2). Unlike hinges it converges to the plate as the mesh is refined, whatever the diagonals. Rows next
to the rim stand for it, too, so that a uniformly bent sheet stores its exact energy.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import csr_matrix, diags, kron, vstack

from .flex_sheet import SheetSpec
from .force_terms import Hook, dahl

if TYPE_CHECKING:
    from .mujoco_cloth import MujocoCloth

Array = np.ndarray


@dataclass(frozen=True)
class PlateSpec:
    """How the sheet bends.

    Attributes:
        stiffness: N m, B along u.
        weft: -, stiffness along v over that along u, less 1.
        damping_time: s, viscous over elastic moment.
        curl: 1/m, rest curvature along u, towards the side of the normal u x v; ``curl_weft`` along v.
        friction: N, Dahl's limit HB of the moment per width, built up over ``threshold`` 1/m.
        crease: 1/s, mobility of the rest curvature where the elastic one exceeds ``crease_yield`` 1/m.
        layer: -, a second layer on the middle ninth of the sheet: this many times its own stiffness more.
    """

    stiffness: float = 0.0
    weft: float = 0.0
    damping_time: float = 0.0
    curl: float = 0.0
    curl_weft: float = 0.0
    friction: float = 0.0
    threshold: float = 5.0
    crease: float = 0.0
    crease_yield: float = 30.0
    layer: float = 0.0


class Stencils:
    """Second differences of a sheet's grid.

    Attributes:
        rows: [R, V] sparse, 1/m^2: x_uu, x_vv and sqrt 2 x_uv, one after the other.
        area: [R] m^2, for which each row stands.
        kind: [R] 0, 1 or 2.
        place: [R, V] sparse: means, of a nodal field at the rows' places.
    """

    def __init__(self, sheet: SheetSpec) -> None:
        nu, nv = sheet.nodes
        hu, hv = (np.diff(own) * (1 - s) for own, s in zip(sheet.lines, (sheet.shrink_u, sheet.shrink_v), strict=True))
        one_u, one_v = diags([np.ones(nu)], [0]), diags([np.ones(nv)], [0])
        blocks = [kron(one_v, _second(hu)), kron(_second(hv), one_u), np.sqrt(2) * kron(_first(hv), _first(hu))]
        means = [kron(one_v, _inner(nu)), kron(_inner(nv), one_u), kron(_middle(nv), _middle(nu))]
        areas = [
            np.kron(_spans(hv), _inner_spans(hu)),
            np.kron(_inner_spans(hv), _spans(hu)),
            np.kron(hv, hu),
        ]
        self.rows, self.place = csr_matrix(vstack(blocks)), csr_matrix(vstack(means))
        self.area, self.kind = np.concatenate(areas), np.repeat([0, 1, 2], [len(a) for a in areas])


def _second(h: Array) -> csr_matrix:
    before, after = h[:-1], h[1:]
    both = 0.5 * (before + after)
    rows = [1 / (before * both), -2 / (before * after), 1 / (after * both)]
    return diags(rows, [0, 1, 2], shape=(len(h) - 1, len(h) + 1))


def _first(h: Array) -> csr_matrix:
    return diags([-1 / h, 1 / h], [0, 1], shape=(len(h), len(h) + 1))


def _inner(n: int) -> csr_matrix:
    return diags([1.0], [1], shape=(n - 2, n))


def _middle(n: int) -> csr_matrix:
    return diags([0.5, 0.5], [0, 1], shape=(n - 1, n))


def _spans(h: Array) -> Array:
    return 0.5 * (np.append(h, 0.0) + np.append(0.0, h))


def _inner_spans(h: Array) -> Array:
    out = _spans(h)
    out[[1, -2]] += out[[0, -1]]
    return out[1:-1]


class Plate(Hook):
    """The linear part: elasticity and damping."""

    def __init__(self, spec: PlateSpec) -> None:
        self.spec = spec

    def start(self, cloth: MujocoCloth, x: Array) -> None:
        stencils = Stencils(cloth.spec)
        weight = stencils.area * _moduli(self.spec, stencils) * _layers(self.spec, cloth, stencils)
        self.matrix = csr_matrix(stencils.rows.T @ diags([weight], [0]) @ stencils.rows)
        tau = self.spec.damping_time
        self.viscous = tau * self.matrix if tau and cloth.implicit else None
        self.explicit = tau if self.viscous is None else 0.0

    def force(self, t: float, x: Array, v: Array) -> Array:
        return -(self.matrix @ (x + self.explicit * v))


class Moments(Hook):
    """What acts on the curvature along the normal: rest curvature, internal friction, creases."""

    def __init__(self, spec: PlateSpec) -> None:
        self.spec = spec
        self.settles = not (spec.friction or spec.crease)

    def start(self, cloth: MujocoCloth, x: Array) -> None:
        self.stencils, self.nodes = Stencils(cloth.spec), cloth.spec.nodes
        self.moduli = _moduli(self.spec, self.stencils) * _layers(self.spec, cloth, self.stencils)
        self.curl = np.choose(self.stencils.kind, [self.spec.curl, self.spec.curl_weft, 0.0])
        self.seen, _ = self._curvature(x)
        self.share, self.crease = np.zeros_like(self.seen), np.zeros_like(self.seen)
        self.dt = cloth.dt

    def force(self, t: float, x: Array, v: Array) -> Array:
        spec = self.spec
        curvature, normal = self._curvature(x)
        self.share = dahl(self.share, curvature - self.seen, spec.threshold)
        self.seen = curvature
        if spec.crease:
            elastic = curvature - self.curl - self.crease
            over = np.maximum(np.abs(elastic) - spec.crease_yield, 0.0)
            self.crease += spec.crease * self.dt * over * np.sign(elastic)
        moment = spec.friction * self.share - self.moduli * (self.curl + self.crease)
        return -(self.stencils.rows.T @ ((self.stencils.area * moment)[:, None] * normal))

    def _curvature(self, x: Array) -> tuple[Array, Array]:
        """Along the normal [R] 1/m, and the normals [R, 3] at the rows' places."""
        nu, nv = self.nodes
        table = x.reshape(nv, nu, 3)
        normal = np.cross(np.gradient(table, axis=1), np.gradient(table, axis=0)).reshape(-1, 3)
        normal = self.stencils.place @ normal
        normal /= np.linalg.norm(normal, axis=1, keepdims=True) + 1e-30
        return np.einsum("rc,rc->r", self.stencils.rows @ x, normal), normal


def _moduli(spec: PlateSpec, stencils: Stencils) -> Array:
    """Bending stiffness [R] N m of each row."""
    ratio = 1 + spec.weft
    return spec.stiffness * np.choose(stencils.kind, [1.0, ratio, np.sqrt(ratio)])


def _layers(spec: PlateSpec, cloth: MujocoCloth, stencils: Stencils) -> Array:
    return 1 + spec.layer * (stencils.place @ patch(cloth.spec, cloth.uv))


def patch(sheet: SheetSpec, uv: Array) -> Array:
    """1 on the vertices of the middle ninth of the sheet, 0 elsewhere [V]."""
    a = np.abs(uv / [sheet.width, sheet.height] - 0.5).max(1)
    return (a <= 1 / 6 + 1e-9).astype(float)
