"""The air around the sheet: drag, draughts, and the mass that moves along."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from .force_terms import Hook, Triangles

if TYPE_CHECKING:
    from .mujoco_cloth import MujocoCloth

Array = np.ndarray


@dataclass(frozen=True)
class AirSpec:
    """What the air does.

    Attributes:
        normal, tangential: -, C_n and C_t of the quadratic drag; C_t counts both sides.
        wind: m/s, speed of a uniform steady draught towards ``heading`` degrees (0: +x, 90: +y).
        jet: m/s, peak speed of a draught along the same heading that is a Gaussian of ``jet_width`` m about a line at
            (``jet_across``, ``jet_height``) m: nothing of it is felt elsewhere.
        added: m, depth of the air that moves with the sheet along its normal.
        linear: 1/s, drag in proportion to mass and velocity.
        density: kg/m^3.
    """

    normal: float = 0.0
    tangential: float = 0.0
    wind: float = 0.0
    heading: float = 0.0
    jet: float = 0.0
    jet_width: float = 0.08
    jet_across: float = 0.10
    jet_height: float = 0.25
    added: float = 0.0
    linear: float = 0.0
    density: float = 1.204


class Drag(Hook):
    """Quadratic drag against the air, which may move; half of it normal, half along the sheet."""

    def __init__(self, spec: AirSpec) -> None:
        self.spec = spec
        angle = np.deg2rad(spec.heading)
        self.toward = np.array([np.cos(angle), np.sin(angle), 0.0])
        self.across = np.array([-np.sin(angle), np.cos(angle), 0.0])

    def start(self, cloth: MujocoCloth, x: Array) -> None:
        self.triangles = Triangles(cloth)

    def force(self, t: float, x: Array, v: Array) -> Array:
        spec, triangles = self.spec, self.triangles
        normal = triangles.area_normals(x)
        area = np.sqrt(np.einsum("fc,fc->f", normal, normal)) + 1e-30
        n = normal / area[:, None]
        relative = triangles.mean @ v - self.wind(triangles.mean @ x)
        speed = np.einsum("fc,fc->f", relative, n)
        along = relative - speed[:, None] * n
        half = 0.5 * spec.density * area
        push = -(half * spec.normal * np.abs(speed) * speed)[:, None] * n
        push -= (half * spec.tangential * np.sqrt(np.einsum("fc,fc->f", along, along)))[:, None] * along
        return triangles.shared(push)

    def wind(self, place: Array) -> Array:
        """Velocity of the air [F, 3] m/s at places [F, 3] m."""
        spec = self.spec
        off = (place @ self.across - spec.jet_across) ** 2 + (place[:, 2] - spec.jet_height) ** 2
        return (spec.wind + spec.jet * np.exp(-off / (2 * spec.jet_width**2)))[:, None] * self.toward


class LinearDrag(Hook):
    """-rate m v."""

    def __init__(self, rate: float) -> None:
        self.rate = rate

    def start(self, cloth: MujocoCloth, x: Array) -> None:
        self.cloth = cloth

    def force(self, t: float, x: Array, v: Array) -> Array:
        return -self.rate * self.cloth.mass[:, None] * v


class AddedMass(Hook):
    """Air of a depth moves along the normal: -m_a n d(n . v)/dt, lumped on the vertices, where n . a is solved for.

    As much as the present area has: where a vertex is folded up it has none, and its normal no meaning.
    """

    reacts = True

    def __init__(self, depth: float, density: float) -> None:
        self.depth, self.density = depth, density

    def start(self, cloth: MujocoCloth, x: Array) -> None:
        self.cloth, self.triangles = cloth, Triangles(cloth)

    def force(self, t: float, x: Array, v: Array) -> Array:
        n, _ = self.normals(x)
        # area normals are quadratic in positions: this difference is their rate, but for rounding
        rate = self.triangles.shared(self.triangles.area_normals(x + v) - self.triangles.area_normals(x - v)) / 2
        along = v - np.einsum("vc,vc->v", n, v)[:, None] * n
        return -self.density * self.depth * np.einsum("vc,vc->v", along, rate)[:, None] * n

    def reaction(self, x: Array, total: Array) -> Array:
        n, area = self.normals(x)
        air = self.density * self.depth * area
        # (m + m_a n n') a = f: what a misses of f / m is m_a / (m + m_a) n n' f / m
        return -(air / (self.cloth.mass + air) * np.einsum("vc,vc->v", n, total))[:, None] * n

    def normals(self, x: Array) -> tuple[Array, Array]:
        """([V, 3] of unit length, areas [V] m^2)."""
        normal = self.triangles.shared(self.triangles.area_normals(x))
        area = np.sqrt(np.einsum("vc,vc->v", normal, normal)) + 1e-30
        return normal / area[:, None], area
