"""The sheet of the independent simulation: its mesh, its masses, its MuJoCo model and the air around it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_matrix

Array = np.ndarray


@dataclass(frozen=True)
class SheetSpec:
    """A rectangular cloth and the air around it.

    Attributes:
        width, height: m, extent in u (warp) and v.
        nodes: vertices along u and v.
        areal_density: kg/m^2.
        membrane_stiffness: N/m, Young's modulus times thickness, at small strain.
        poisson_ratio: -, in [0, 0.5).
        bending_stiffness: N m, plate rigidity; 0 leaves bending out.
        damping_time: s, Rayleigh coefficient (the damping matrix is this times the stiffness matrix).
        drag_normal: -, C_n of the drag -1/2 rho_air C_n A |v_n| v_n n of each triangle.
        air_density: kg/m^3.
        gravity: m/s^2, world z.
        diagonals: "alternating" (union jack) or "parallel".
        shrink_u, shrink_v: -, share by which the cloth at rest is shorter than its pattern.
        skew: rad, by which the angle between u and v at rest is less than a right one.
        lines_u, lines_v: m, where the vertices lie along either axis, both ends included; empty: at even distances.
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
    air_density: float = 1.204
    gravity: float = -9.81
    diagonals: str = "alternating"
    shrink_u: float = 0.0
    shrink_v: float = 0.0
    skew: float = 0.0
    lines_u: tuple[float, ...] = ()
    lines_v: tuple[float, ...] = ()

    @property
    def lines(self) -> tuple[Array, Array]:
        """Places of the vertices along u and along v, m."""
        even = (np.linspace(0, size, n) for size, n in zip((self.width, self.height), self.nodes, strict=True))
        u, v = (np.asarray(own) if own else line for own, line in zip((self.lines_u, self.lines_v), even, strict=True))
        return u, v

    @property
    def even(self) -> SheetSpec:
        """The same, its vertices at even distances."""
        return replace(self, lines_u=(), lines_v=())

    @property
    def shortest(self) -> float:
        """Least distance of neighbours along an axis, m."""
        return float(min(np.diff(line).min() for line in self.lines))


def grid(spec: SheetSpec) -> tuple[Array, Array]:
    """Material coordinates [V, 2] m (v varies slowest) and triangles [F, 3] of the sheet's mesh."""
    nu, nv = spec.nodes
    v, u = np.meshgrid(*reversed(spec.lines), indexing="ij")
    faces = []
    for j in range(nv - 1):
        for i in range(nu - 1):
            a, b, c, d = j * nu + i, j * nu + i + 1, (j + 1) * nu + i + 1, (j + 1) * nu + i
            forward = spec.diagonals == "parallel" or (i + j) % 2 == 0
            faces += [(a, b, c), (a, c, d)] if forward else [(a, b, d), (b, c, d)]
    return np.stack([u.ravel(), v.ravel()], 1), np.array(faces)


def rest_points(spec: SheetSpec) -> Array:
    """Where the vertices [V, 2] m of the relaxed cloth lie in its plane; the pattern itself without shrinkage."""
    uv, _ = grid(spec)
    lean = np.array([[1.0, np.sin(spec.skew)], [0.0, np.cos(spec.skew)]])
    return (uv * [1 - spec.shrink_u, 1 - spec.shrink_v]) @ lean.T


def bilinear(sheet: SheetSpec, values: Array, uv: Array) -> tuple[Array, Array, Array]:
    """Values [V, C] of a sheet's grid at material points [N, 2]: [N, C], and their differences along u and along v."""
    nu, nv = sheet.nodes
    table = values.reshape(nv, nu, -1)
    (i, a), (j, b) = (_between(line, place) for line, place in zip(sheet.lines, uv.T, strict=True))
    p, q, r, s = table[j, i], table[j, i + 1], table[j + 1, i], table[j + 1, i + 1]
    along_u, along_v = (q - p) * (1 - b) + (s - r) * b, (r - p) * (1 - a) + (s - q) * a
    return (1 - b) * ((1 - a) * p + a * q) + b * ((1 - a) * r + a * s), along_u, along_v


def _between(line: Array, place: Array) -> tuple[Array, Array]:
    """(the line before each place [N], how far on to the next [N, 1], from 0 to 1)."""
    i = np.clip(np.searchsorted(line, place, side="right") - 1, 0, len(line) - 2)
    return i, ((place - line[i]) / (line[i + 1] - line[i]))[:, None]


def vertex_masses(spec: SheetSpec) -> Array:
    """Lumped masses [V] kg: a third of every adjacent triangle."""
    uv, faces = grid(spec)
    edge = uv[faces[:, 1:]] - uv[faces[:, :1]]
    area = 0.5 * np.abs(edge[:, 0, 0] * edge[:, 1, 1] - edge[:, 0, 1] * edge[:, 1, 0])
    return spec.areal_density * np.bincount(faces.ravel(), np.repeat(area / 3, 3), len(uv))


def largest_step(spec: SheetSpec) -> float:
    """A safe step in s for the explicit integration: 0.8 of the limit of the mesh's stiffest mode, damping included."""
    h = spec.shortest
    # a pressure wave from vertex to vertex: omega^2 = 8 c^2 / h^2; a plate wave: 64 D / (rho h^4)
    membrane = 8 * spec.membrane_stiffness / (1 - spec.poisson_ratio**2) / (spec.areal_density * h**2)
    bending = 64 * spec.bending_stiffness / (spec.areal_density * h**4)
    omega = np.sqrt(membrane + bending)
    zeta = 0.5 * spec.damping_time * omega
    return 0.8 * 2 / omega * (np.sqrt(1 + zeta**2) - zeta)


def flex_xml(spec: SheetSpec, dt: float) -> str:
    """The sheet, flat in the plane z = 0, as a MuJoCo model with time step ``dt`` s."""
    _, faces = grid(spec)
    points = " ".join(f"{u:.17g} {v:.17g} 0" for u, v in rest_points(spec))
    elements = " ".join(map(str, faces.ravel()))
    bends = spec.bending_stiffness > 0
    # thickness and modulus that give both stiffnesses asked for: Y = E t, D = E t^3 / (12 (1 - nu^2))
    plate = 12 * (1 - spec.poisson_ratio**2) * spec.bending_stiffness
    t = np.sqrt(plate / spec.membrane_stiffness) if bends else 1e-3
    return f"""<mujoco>
      <option timestep="{dt:.17g}" integrator="Euler" gravity="0 0 {spec.gravity}">
        <flag contact="disable" constraint="disable"/>
      </option>
      <size memory="64M"/>
      <worldbody>
        <flexcomp name="cloth" type="direct" dim="2" dof="full" mass="1" radius="0.001"
          point="{points}" element="{elements}">
          <contact selfcollide="none" contype="0" conaffinity="0"/>
          <elasticity young="{spec.membrane_stiffness / t:.17g}" poisson="{spec.poisson_ratio}" thickness="{t:.17g}"
            damping="{spec.damping_time}" elastic2d="{"both" if bends else "stretch"}"/>
        </flexcomp>
      </worldbody>
    </mujoco>"""


class Air:
    """Still air: drag along the normal of every triangle, shared equally by its vertices."""

    def __init__(self, spec: SheetSpec, faces: Array, vertices: int) -> None:
        self.faces = faces
        self.half_rho_c = 0.5 * spec.air_density * spec.drag_normal
        third = np.full(faces.size, 1 / 3)
        rows, columns = faces.ravel(), np.repeat(np.arange(len(faces)), 3)
        self.to_vertices = csr_matrix((third, (rows, columns)), shape=(vertices, len(faces)))
        self.to_faces = csr_matrix((third, (columns, rows)), shape=(len(faces), vertices))

    def force(self, x: Array, v: Array) -> Array:
        """Force [V, 3] N at positions and velocities [V, 3] m, m/s."""
        a, b, c = (x[self.faces[:, k]] for k in range(3))
        (px, py, pz), (qx, qy, qz) = (b - a).T, (c - a).T
        normal = np.stack([py * qz - pz * qy, pz * qx - px * qz, px * qy - py * qx], 1)  # length: twice the area
        length = np.sqrt(np.einsum("ij,ij->i", normal, normal)) + 1e-30
        speed = np.einsum("ij,ij->i", self.to_faces @ v, normal) / length
        return self.to_vertices @ ((-0.5 * self.half_rho_c * np.abs(speed) * speed)[:, None] * normal)
