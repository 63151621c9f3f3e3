"""The air around the sheet: drag, draughts and added mass."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from torchcloth._utils.constants import STANDARD_AIR_DENSITY_KG_PER_M3

from .force_terms import ForceTerm, TriangleOperators

if TYPE_CHECKING:
    from .mujoco_cloth import MujocoCloth

Array = np.ndarray


@dataclass(frozen=True)
class AirSpec:
    """Amplitudes of what the air does.

    Attributes:
        normal: -, coefficient C_n of the quadratic drag along the normal.
        tangential: -, coefficient C_t of the quadratic drag along the sheet; it counts both sides.
        wind: m/s, speed of a uniform steady wind towards ``heading``.
        heading: degrees, direction of the wind and the jet (0: +x, 90: +y).
        jet: m/s, peak speed of a jet towards ``heading``. Its profile is a Gaussian about a line.
        jet_width: m, standard deviation of the jet's profile.
        jet_across: m, distance of the jet's line from the origin, across ``heading``.
        jet_height: m, height of the jet's line.
        added_depth: m, depth of the air that moves with the sheet along its normal.
        linear: 1/s, rate of a drag that is proportional to mass and velocity.
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
    added_depth: float = 0.0
    linear: float = 0.0
    density: float = STANDARD_AIR_DENSITY_KG_PER_M3


class QuadraticDrag(ForceTerm):
    """Quadratic drag against air that may move, with a normal and a tangential part."""

    def __init__(self, spec: AirSpec) -> None:
        self.spec = spec
        angle = np.deg2rad(spec.heading)
        self.downwind = np.array([np.cos(angle), np.sin(angle), 0.0])
        self.crosswind = np.array([-np.sin(angle), np.cos(angle), 0.0])

    def reset(self, cloth: MujocoCloth, x: Array) -> None:
        """Prepare the operators of the cloth's triangles."""
        self.triangles = TriangleOperators(cloth)

    def force(self, t: float, x: Array, v: Array) -> Array:
        """Return the drag [V, 3] N, a third of each triangle's at each of its corners."""
        spec, triangles = self.spec, self.triangles
        normal = triangles.area_normals(x)
        area = np.sqrt(np.einsum("fc,fc->f", normal, normal)) + 1e-30
        n = normal / area[:, None]
        relative = triangles.mean @ v - self.wind_velocity(triangles.mean @ x)
        normal_speed = np.einsum("fc,fc->f", relative, n)
        tangential = relative - normal_speed[:, None] * n
        half = 0.5 * spec.density * area
        force = -(half * spec.normal * np.abs(normal_speed) * normal_speed)[:, None] * n
        tangential_speed = np.sqrt(np.einsum("fc,fc->f", tangential, tangential))
        force -= (half * spec.tangential * tangential_speed)[:, None] * tangential
        return triangles.distribute_to_vertices(force)

    def wind_velocity(self, positions: Array) -> Array:
        """Return the velocity of the air [F, 3] m/s at positions [F, 3] m."""
        spec = self.spec
        squared = (positions @ self.crosswind - spec.jet_across) ** 2 + (positions[:, 2] - spec.jet_height) ** 2
        return (spec.wind + spec.jet * np.exp(-squared / (2 * spec.jet_width**2)))[:, None] * self.downwind


class LinearDrag(ForceTerm):
    """Drag -rate m v, proportional to mass and velocity."""

    def __init__(self, rate: float) -> None:
        self.rate = rate

    def reset(self, cloth: MujocoCloth, x: Array) -> None:
        """Take the cloth, whose masses may change."""
        self.cloth = cloth

    def force(self, t: float, x: Array, v: Array) -> Array:
        """Return the drag [V, 3] N."""
        return -self.rate * self.cloth.mass[:, None] * v


class AddedMass(ForceTerm):
    """Air of a given depth moves along the normal: force -m_a n d(n . v)/dt, lumped on the vertices.

    The acceleration along the normal is solved for. The air's mass follows the present area: a vertex that is folded
    up has none, and its normal has no meaning.
    """

    has_inertia = True

    def __init__(self, depth: float, density: float) -> None:
        self.depth, self.density = depth, density

    def reset(self, cloth: MujocoCloth, x: Array) -> None:
        """Take the cloth, and prepare the operators of its triangles."""
        self.cloth, self.triangles = cloth, TriangleOperators(cloth)

    def force(self, t: float, x: Array, v: Array) -> Array:
        """Return the force [V, 3] N that turning normals cause."""
        n, _ = self.vertex_normals(x)
        # area normals are quadratic in positions, so this central difference is their exact rate but for rounding
        difference = self.triangles.area_normals(x + v) - self.triangles.area_normals(x - v)
        rate = self.triangles.distribute_to_vertices(difference) / 2
        tangential = v - np.einsum("vc,vc->v", n, v)[:, None] * n
        return -self.density * self.depth * np.einsum("vc,vc->v", tangential, rate)[:, None] * n

    def inertial_force(self, x: Array, total: Array) -> Array:
        """Return the force [V, 3] N by which the air slows the acceleration along the normal.

        It follows from (m + m_a n n') a = f: a differs from f / m by m_a / (m + m_a) n n' f / m.
        """
        n, area = self.vertex_normals(x)
        air_mass = self.density * self.depth * area
        fraction = air_mass / (self.cloth.mass + air_mass)
        return -(fraction * np.einsum("vc,vc->v", n, total))[:, None] * n

    def vertex_normals(self, x: Array) -> tuple[Array, Array]:
        """Return unit normals [V, 3] and areas [V] m^2 of the vertices."""
        normal = self.triangles.distribute_to_vertices(self.triangles.area_normals(x))
        area = np.sqrt(np.einsum("vc,vc->v", normal, normal)) + 1e-30
        return normal / area[:, None], area
