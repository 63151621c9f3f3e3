"""Bending of the sheet as a Kirchhoff plate, by finite differences on its grid.

Second differences x_uu and x_vv are taken at the grid's nodes, x_uv in its cells. The energy per area is B/2 (x_uu^2 +
weft x_vv^2 + 2 sqrt(weft) x_uv^2). Unlike hinges it converges to the plate as the mesh is refined, for all diagonals.
Rows next to the rim also stand for the rim, so that a uniformly bent sheet stores its exact energy.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.sparse import csr_matrix, diags, identity, kron, vstack

from .flex_sheet import SheetSpec
from .force_terms import ForceTerm, advance_dahl_friction

if TYPE_CHECKING:
    from .mujoco_cloth import MujocoCloth

Array = np.ndarray


@dataclass(frozen=True)
class PlateSpec:
    """Bending law of the sheet.

    Attributes:
        stiffness: N m, B along u.
        weft: -, stiffness along v over that along u, less 1.
        damping_time: s, viscous over elastic moment.
        curl: 1/m, rest curvature along u, towards the side of the normal u x v.
        curl_weft: 1/m, likewise along v.
        friction: N, Dahl's limit HB of the moment per width.
        threshold: 1/m, curvature over which the friction builds up.
        crease: 1/s, mobility of the rest curvature where the elastic one exceeds ``crease_yield``.
        crease_yield: 1/m, see ``crease``.
        layer: -, stiffness of a second layer on the middle ninth of the sheet, over the sheet's own.
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


class CurvatureStencils:
    """Second differences of a sheet's grid.

    Attributes:
        rows: [R, V] sparse, 1/m^2: x_uu, x_vv and sqrt 2 x_uv, one after the other.
        area: [R] m^2 that each row stands for.
        kind: [R], 0 for x_uu, 1 for x_vv, 2 for x_uv.
        mean: [R, V] sparse, interpolates a nodal field to the rows' places.
    """

    def __init__(self, sheet: SheetSpec) -> None:
        nu, nv = sheet.nodes
        shrinkage = (sheet.shrink_u, sheet.shrink_v)
        hu, hv = (np.diff(line) * (1 - s) for line, s in zip(sheet.grid_lines, shrinkage, strict=True))
        one_u, one_v = identity(nu), identity(nv)
        twist = np.sqrt(2) * kron(_first_difference(hv), _first_difference(hu))
        blocks = [kron(one_v, _second_difference(hu)), kron(_second_difference(hv), one_u), twist]
        means = [
            kron(one_v, _inner_selection(nu)),
            kron(_inner_selection(nv), one_u),
            kron(_midpoint_mean(nv), _midpoint_mean(nu)),
        ]
        areas = [
            np.kron(_node_lengths(hv), _inner_node_lengths(hu)),
            np.kron(_inner_node_lengths(hv), _node_lengths(hu)),
            np.kron(hv, hu),
        ]
        self.rows, self.mean = csr_matrix(vstack(blocks)), csr_matrix(vstack(means))
        self.area, self.kind = np.concatenate(areas), np.repeat([0, 1, 2], [len(a) for a in areas])


def _banded(diagonals: list[Any], offsets: list[int], shape: tuple[int, int]) -> csr_matrix:
    return csr_matrix(diags(diagonals, offsets, shape=shape))  # type: ignore[arg-type]


def _second_difference(h: Array) -> csr_matrix:
    left, right = h[:-1], h[1:]
    mean = 0.5 * (left + right)
    weights = [1 / (left * mean), -2 / (left * right), 1 / (right * mean)]
    return _banded(weights, [0, 1, 2], (len(h) - 1, len(h) + 1))


def _first_difference(h: Array) -> csr_matrix:
    return _banded([-1 / h, 1 / h], [0, 1], (len(h), len(h) + 1))


def _inner_selection(n: int) -> csr_matrix:
    return _banded([1.0], [1], (n - 2, n))


def _midpoint_mean(n: int) -> csr_matrix:
    return _banded([0.5, 0.5], [0, 1], (n - 1, n))


def _node_lengths(h: Array) -> Array:
    return 0.5 * (np.append(h, 0.0) + np.append(0.0, h))


def _inner_node_lengths(h: Array) -> Array:
    out = _node_lengths(h)
    out[[1, -2]] += out[[0, -1]]
    return out[1:-1]


class PlateBending(ForceTerm):
    """Linear bending: elasticity and damping."""

    def __init__(self, spec: PlateSpec) -> None:
        self.spec = spec

    def reset(self, cloth: MujocoCloth, x: Array) -> None:
        """Assemble the stiffness matrix, and the damping matrix where damping is implicit."""
        stencils = CurvatureStencils(cloth.spec)
        weight = stencils.area * _moduli(self.spec, stencils) * _layer_factor(self.spec, cloth, stencils)
        self.matrix = csr_matrix(stencils.rows.T @ diags(weight) @ stencils.rows)
        tau = self.spec.damping_time
        self.damping_matrix = tau * self.matrix if tau and cloth.has_implicit_damping else None
        self.explicit_damping_time = tau if self.damping_matrix is None else 0.0

    def force(self, t: float, x: Array, v: Array) -> Array:
        """Return the bending forces [V, 3] N."""
        return -(self.matrix @ (x + self.explicit_damping_time * v))


class InelasticBending(ForceTerm):
    """Moments of rest curvature, internal friction and creases, on the curvature along the normal."""

    def __init__(self, spec: PlateSpec) -> None:
        self.spec = spec
        self.acts_while_settling = not (spec.friction or spec.crease)

    def reset(self, cloth: MujocoCloth, x: Array) -> None:
        """Take the cloth's moduli, and start without friction and creases at positions x [V, 3] m."""
        self.stencils, self.nodes = CurvatureStencils(cloth.spec), cloth.spec.nodes
        self.moduli = _moduli(self.spec, self.stencils) * _layer_factor(self.spec, cloth, self.stencils)
        self.curl = np.choose(self.stencils.kind, [self.spec.curl, self.spec.curl_weft, 0.0])
        self.curvature, _ = self._normal_curvature(x)
        self.dahl_state, self.crease = np.zeros_like(self.curvature), np.zeros_like(self.curvature)
        self.dt = cloth.dt

    def force(self, t: float, x: Array, v: Array) -> Array:
        """Return the forces [V, 3] N of the moments, and advance friction and creases."""
        spec = self.spec
        curvature, normal = self._normal_curvature(x)
        self.dahl_state = advance_dahl_friction(self.dahl_state, curvature - self.curvature, spec.threshold)
        self.curvature = curvature
        if spec.crease:
            elastic = curvature - self.curl - self.crease
            excess = np.maximum(np.abs(elastic) - spec.crease_yield, 0.0)
            self.crease += spec.crease * self.dt * excess * np.sign(elastic)
        moment = spec.friction * self.dahl_state - self.moduli * (self.curl + self.crease)
        return -(self.stencils.rows.T @ ((self.stencils.area * moment)[:, None] * normal))

    def _normal_curvature(self, x: Array) -> tuple[Array, Array]:
        """Return curvatures along the normal [R] 1/m, and the normals [R, 3]."""
        nu, nv = self.nodes
        table = x.reshape(nv, nu, 3)
        normal = np.cross(np.gradient(table, axis=1), np.gradient(table, axis=0)).reshape(-1, 3)
        normal = self.stencils.mean @ normal
        normal /= np.linalg.norm(normal, axis=1, keepdims=True) + 1e-30
        return np.einsum("rc,rc->r", self.stencils.rows @ x, normal), normal


def _moduli(spec: PlateSpec, stencils: CurvatureStencils) -> Array:
    """Return the bending stiffness [R] N m of each row."""
    ratio = 1 + spec.weft
    return np.asarray(spec.stiffness * np.choose(stencils.kind, [1.0, ratio, np.sqrt(ratio)]))


def _layer_factor(spec: PlateSpec, cloth: MujocoCloth, stencils: CurvatureStencils) -> Array:
    return np.asarray(1 + spec.layer * (stencils.mean @ central_patch(cloth.spec, cloth.uv)))


def central_patch(sheet: SheetSpec, uv: Array) -> Array:
    """Return 1 on the vertices of the middle ninth of the sheet, 0 elsewhere [V]."""
    a = np.abs(uv / [sheet.width, sheet.height] - 0.5).max(1)
    return (a <= 1 / 6 + 1e-9).astype(float)
