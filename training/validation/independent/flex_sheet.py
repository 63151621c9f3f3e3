"""The sheet of the independent engine: its mesh, its masses, its MuJoCo model and still air around it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_matrix

from torchcloth._utils.constants import STANDARD_AIR_DENSITY_KG_PER_M3, STANDARD_GRAVITY_M_PER_S2

Array = np.ndarray
STEP_SAFETY_FACTOR = 0.8  # of the stability limit


@dataclass(frozen=True)
class SheetSpec:
    """A rectangular cloth and the air around it.

    Attributes:
        width: m, extent along u (warp).
        height: m, extent along v (weft).
        nodes: numbers of vertices along u and v.
        areal_density: kg/m^2.
        membrane_stiffness: N/m, Young's modulus times thickness, at small strain.
        poisson_ratio: -, in [0, 0.5).
        bending_stiffness: N m, plate rigidity; 0 leaves bending out.
        damping_time: s, Rayleigh coefficient (the damping matrix is this times the stiffness matrix).
        drag_normal: -, C_n of the drag -1/2 rho_air C_n A |v_n| v_n n of each triangle.
        air_density: kg/m^3.
        gravity: m/s^2, along the world's z.
        diagonals: "alternating" (union jack) or "parallel".
        shrink_u: -, fraction by which the cloth at rest is shorter than its pattern along u.
        shrink_v: -, likewise along v.
        skew: rad, by which the angle between u and v at rest is less than a right one.
        lines_u: m, positions of the vertices along u, both ends included; empty: evenly spaced.
        lines_v: m, likewise along v.
    """

    width: float = 0.40
    height: float = 0.40
    nodes: tuple[int, int] = (25, 25)
    areal_density: float = 0.20
    membrane_stiffness: float = 113.0
    poisson_ratio: float = 0.30
    bending_stiffness: float = 0.0
    damping_time: float = 0.0
    drag_normal: float = 0.0
    air_density: float = STANDARD_AIR_DENSITY_KG_PER_M3
    gravity: float = -STANDARD_GRAVITY_M_PER_S2
    diagonals: str = "alternating"
    shrink_u: float = 0.0
    shrink_v: float = 0.0
    skew: float = 0.0
    lines_u: tuple[float, ...] = ()
    lines_v: tuple[float, ...] = ()

    @property
    def grid_lines(self) -> tuple[Array, Array]:
        """Positions of the vertices along u and along v [m]."""
        u = np.asarray(self.lines_u) if self.lines_u else np.linspace(0, self.width, self.nodes[0])
        v = np.asarray(self.lines_v) if self.lines_v else np.linspace(0, self.height, self.nodes[1])
        return u, v

    @property
    def evenly_spaced(self) -> SheetSpec:
        """The same sheet with evenly spaced vertices."""
        return replace(self, lines_u=(), lines_v=())

    @property
    def min_spacing(self) -> float:
        """Least distance of neighbouring vertices along an axis [m]."""
        return float(min(np.diff(line).min() for line in self.grid_lines))


def sheet_mesh(spec: SheetSpec) -> tuple[Array, Array]:
    """Return material coordinates [V, 2] m (v varies slowest) and triangles [F, 3] of the sheet."""
    nu, nv = spec.nodes
    v, u = np.meshgrid(*reversed(spec.grid_lines), indexing="ij")
    faces = []
    for j in range(nv - 1):
        for i in range(nu - 1):
            a, b, c, d = j * nu + i, j * nu + i + 1, (j + 1) * nu + i + 1, (j + 1) * nu + i
            forward = spec.diagonals == "parallel" or (i + j) % 2 == 0
            faces += [(a, b, c), (a, c, d)] if forward else [(a, b, d), (b, c, d)]
    return np.stack([u.ravel(), v.ravel()], 1), np.array(faces)


def rest_positions(spec: SheetSpec) -> Array:
    """Return the positions [V, 2] m of the relaxed cloth in its plane: the pattern itself without shrinkage."""
    uv, _ = sheet_mesh(spec)
    shear = np.array([[1.0, np.sin(spec.skew)], [0.0, np.cos(spec.skew)]])
    return (uv * [1 - spec.shrink_u, 1 - spec.shrink_v]) @ shear.T


def interpolate_bilinear(sheet: SheetSpec, values: Array, uv: Array) -> tuple[Array, Array, Array]:
    """Interpolate values [V, C] of a sheet's vertices at material points [N, 2] m.

    Returns:
        The values [N, C], and their differences across the cell along u and along v, [N, C] each.
    """
    nu, nv = sheet.nodes
    table = values.reshape(nv, nu, -1)
    (i, a), (j, b) = (_locate(line, place) for line, place in zip(sheet.grid_lines, uv.T, strict=True))
    p, q, r, s = table[j, i], table[j, i + 1], table[j + 1, i], table[j + 1, i + 1]
    along_u, along_v = (q - p) * (1 - b) + (s - r) * b, (r - p) * (1 - a) + (s - q) * a
    return (1 - b) * ((1 - a) * p + a * q) + b * ((1 - a) * r + a * s), along_u, along_v


def _locate(line: Array, place: Array) -> tuple[Array, Array]:
    """Return the index of the grid line before each place [N], and the fraction of the way to the next [N, 1]."""
    i = np.clip(np.searchsorted(line, place, side="right") - 1, 0, len(line) - 2)
    return i, ((place - line[i]) / (line[i + 1] - line[i]))[:, None]


def vertex_masses(spec: SheetSpec) -> Array:
    """Return the lumped masses [V] kg: a third of every adjacent triangle."""
    uv, faces = sheet_mesh(spec)
    edge = uv[faces[:, 1:]] - uv[faces[:, :1]]
    area = 0.5 * np.abs(edge[:, 0, 0] * edge[:, 1, 1] - edge[:, 0, 1] * edge[:, 1, 0])
    return spec.areal_density * np.bincount(faces.ravel(), np.repeat(area / 3, 3), len(uv))


def max_stable_step(spec: SheetSpec) -> float:
    """Return a safe step [s] of explicit integration: 0.8 of the limit of the stiffest mode, damping included.

    A pressure wave from vertex to vertex has omega^2 = 8 c^2 / h^2, a plate wave 64 D / (rho h^4).
    """
    h = spec.min_spacing
    membrane = 8 * spec.membrane_stiffness / (1 - spec.poisson_ratio**2) / (spec.areal_density * h**2)
    bending = 64 * spec.bending_stiffness / (spec.areal_density * h**4)
    omega = np.sqrt(membrane + bending)
    zeta = 0.5 * spec.damping_time * omega
    return STEP_SAFETY_FACTOR * 2 / omega * (np.sqrt(1 + zeta**2) - zeta)


def flex_xml(
    rest: Array,
    faces: Array,
    dt: float,
    *,
    membrane_stiffness: float,
    poisson_ratio: float,
    bending_stiffness: float,
    damping_time: float,
    gravity: float,
) -> str:
    """Return a cloth as a MuJoCo model.

    Args:
        rest: [V, 3] m, vertices of the unstrained cloth.
        faces: [F, 3].
        dt: time step [s].
        membrane_stiffness: N/m.
        poisson_ratio: -.
        bending_stiffness: N m; 0: none.
        damping_time: s.
        gravity: m/s^2, along z.
    """
    points = " ".join(f"{value:.17g}" for value in rest.ravel())
    elements = " ".join(map(str, faces.ravel()))
    bends = bending_stiffness > 0
    # the thickness and modulus that give both stiffnesses: Y = E t, D = E t^3 / (12 (1 - nu^2))
    plate = 12 * (1 - poisson_ratio**2) * bending_stiffness
    t = np.sqrt(plate / membrane_stiffness) if bends else 1e-3
    return f"""<mujoco>
      <option timestep="{dt:.17g}" integrator="Euler" gravity="0 0 {gravity}">
        <flag contact="disable" constraint="disable"/>
      </option>
      <size memory="64M"/>
      <worldbody>
        <flexcomp name="cloth" type="direct" dim="2" dof="full" mass="1" radius="0.001"
          point="{points}" element="{elements}">
          <contact selfcollide="none" contype="0" conaffinity="0"/>
          <elasticity young="{membrane_stiffness / t:.17g}" poisson="{poisson_ratio}" thickness="{t:.17g}"
            damping="{damping_time}" elastic2d="{"both" if bends else "stretch"}"/>
        </flexcomp>
      </worldbody>
    </mujoco>"""


class StillAir:
    """Drag of still air along the normal of every triangle, shared equally by its vertices."""

    def __init__(self, spec: SheetSpec, faces: Array, vertices: int) -> None:
        self.faces = faces
        self.half_rho_c = 0.5 * spec.air_density * spec.drag_normal
        third = np.full(faces.size, 1 / 3)
        rows, columns = faces.ravel(), np.repeat(np.arange(len(faces)), 3)
        self.to_vertices = csr_matrix((third, (rows, columns)), shape=(vertices, len(faces)))
        self.to_faces = csr_matrix((third, (columns, rows)), shape=(len(faces), vertices))

    def force(self, x: Array, v: Array) -> Array:
        """Return the force [V, 3] N at positions [V, 3] m and velocities [V, 3] m/s."""
        a, b, c = (x[self.faces[:, k]] for k in range(3))
        (px, py, pz), (qx, qy, qz) = (b - a).T, (c - a).T
        normal = np.stack([py * qz - pz * qy, pz * qx - px * qz, px * qy - py * qx], 1)  # length: twice the area
        length = np.sqrt(np.einsum("ij,ij->i", normal, normal)) + 1e-30
        speed = np.einsum("ij,ij->i", self.to_faces @ v, normal) / length
        return self.to_vertices @ ((-0.5 * self.half_rho_c * np.abs(speed) * speed)[:, None] * normal)
