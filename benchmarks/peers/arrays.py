"""A case as plain arrays, for simulators that know nothing of torch."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from torchcloth._utils.constants import STANDARD_GRAVITY_M_PER_S2

from ..cases import AREAL_DENSITY_KG_PER_M2, CELL_SIZE_M, MATERIAL, SUBSTEP_S, Case

GRID_NODES_PER_AXIS = 44  # of the dense grid, along each axis
THICKNESS_M = 1e-3  # m
GRAVITY_Z_M_PER_S2 = -STANDARD_GRAVITY_M_PER_S2
VERTEX_SHARE, TRIANGLE_SHARE = 0.75, 0.25  # of the mass of vertices; of a triangle's, that it carries itself


class Arrays(NamedTuple):
    """Particles of the usual material point method: vertices, then one element per triangle."""

    x: np.ndarray  # [V, 3] float32 m, moved by ``shift`` whole cells into the dense grid
    shift: np.ndarray  # [3] float32 m
    faces: np.ndarray  # [E, 3] int32
    frame: np.ndarray  # [E, 4] float32 1/m: f1 = a d1 + b d2, f2 = c d1 + d d2
    area: np.ndarray  # [E] float32 m^2
    vertex_mass: np.ndarray  # [V] float32 kg, the whole lumped mass
    element_mass: np.ndarray  # [E] float32 kg, the quarter that is the element's own
    gripped: np.ndarray  # [V] int32, 1: moved by the grippers
    velocity: np.ndarray  # [substeps, 3] float32 m/s, of the grippers during each substep


class Law(NamedTuple):
    """Constants of A-EP, as resultants; the first two per unit of Young's modulus [Pa]."""

    mu: float  # m
    lam: float  # m
    contact: float  # N/m
    shear: float  # N/m
    cone: float


def arrays(case: Case, substeps: int) -> Arrays:
    """Convert a case to the arrays that a peer needs."""
    mesh = case.mesh
    gradient = mesh.shape_gradient
    frame = np.stack([gradient[:, 1, 0], gradient[:, 2, 0], gradient[:, 1, 1], gradient[:, 2, 1]], axis=1)
    middle = (mesh.vertices.min(0) + mesh.vertices.max(0)) / 2
    shift = CELL_SIZE_M * np.round(GRID_NODES_PER_AXIS / 2 - middle / CELL_SIZE_M)
    gripped = np.zeros(len(mesh.vertices), np.int32)
    gripped[case.gripped_vertices] = 1
    return Arrays(
        x=(mesh.vertices + shift).astype(np.float32),
        shift=shift.astype(np.float32),
        faces=mesh.faces.astype(np.int32),
        frame=frame.astype(np.float32),
        area=mesh.area.astype(np.float32),
        vertex_mass=(AREAL_DENSITY_KG_PER_M2 * mesh.vertex_area).astype(np.float32),
        element_mass=(TRIANGLE_SHARE * AREAL_DENSITY_KG_PER_M2 * mesh.area).astype(np.float32),
        gripped=gripped,
        velocity=(case.displacements(substeps) / SUBSTEP_S).astype(np.float32),
    )


def law() -> Law:
    """Compute the plane-stress matrix, as torchcloth's default law does."""
    nu, h = MATERIAL["poisson_ratio"], THICKNESS_M
    director = (MATERIAL["contact_stiffness"] * h, MATERIAL["shear_stiffness"] * h, MATERIAL["cone"])
    return Law(h / (2 * (1 + nu)), h * nu / (1 - nu * nu), *director)
