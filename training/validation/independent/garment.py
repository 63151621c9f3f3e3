"""A garment in MuJoCo flex: any triangulated surface, hanging in its grippers, without contact."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from torchcloth._utils.constants import STANDARD_AIR_DENSITY_KG_PER_M3, STANDARD_GRAVITY_M_PER_S2

from .flex_sheet import STEP_SAFETY_FACTOR, StillAir
from .mujoco_cloth import Grip, MujocoCloth, Result, hold_grips, mujoco_version

Array = np.ndarray
SETTLING_S, SETTLING_DAMPING_PER_S = 1.2, 12.0


@dataclass(frozen=True)
class GarmentSpec:
    """A triangulated garment and the air around it.

    Attributes:
        rest: [V, 3] m, vertices of the relaxed garment.
        faces: [F, 3].
        areal_density: kg/m^2.
        membrane_stiffness: N/m, Young's modulus times thickness.
        poisson_ratio: -.
        bending_stiffness: N m, plate rigidity.
        damping_time: s, Rayleigh coefficient of the elastic forces.
        drag_normal: -, drag coefficient of each triangle along its normal.
        air_density: kg/m^3.
        gravity: m/s^2, along the world's z.
    """

    rest: Array = field(repr=False)
    faces: Array = field(repr=False)
    areal_density: float
    membrane_stiffness: float
    poisson_ratio: float
    bending_stiffness: float
    damping_time: float = 0.0
    drag_normal: float = 0.0
    air_density: float = STANDARD_AIR_DENSITY_KG_PER_M3
    gravity: float = -STANDARD_GRAVITY_M_PER_S2

    @property
    def areas(self) -> Array:
        """Areas [F] m^2 of the triangles at rest."""
        a, b, c = (self.rest[self.faces[:, k]] for k in range(3))
        return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)

    @property
    def masses(self) -> Array:
        """Lumped masses [V] kg."""
        share = np.repeat(self.areal_density * self.areas / 3, 3)
        return np.bincount(self.faces.ravel(), share, len(self.rest))

    @property
    def max_stable_step(self) -> float:
        """A safe step [s]: 0.8 of the limit of the stiffest mode by the least altitude of a triangle."""
        corners = self.rest[self.faces]
        longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(1)
        h = float((2 * self.areas / longest).min())
        membrane = 8 * self.membrane_stiffness / (1 - self.poisson_ratio**2) / (self.areal_density * h**2)
        omega = np.sqrt(membrane + 64 * self.bending_stiffness / (self.areal_density * h**4))
        zeta = 0.5 * self.damping_time * omega
        return float(STEP_SAFETY_FACTOR * 2 / omega * (np.sqrt(1 + zeta**2) - zeta))


class MujocoGarment(MujocoCloth):
    """A garment in MuJoCo whose gripped vertices follow grippers; runs as ``MujocoCloth``.

    Layers pass through each other, and there is no table.

    Args:
        spec: the garment and the air.
        step_fraction: of ``GarmentSpec.max_stable_step``; violent motions stretch cloth, which needs shorter steps.

    Raises:
        MissingDependency: a MuJoCo whose 2-D elasticity is not the documented one.
    """

    def __init__(self, spec: GarmentSpec, step_fraction: float = 1.0) -> None:
        mujoco_version()
        self.spec, self.dt = spec, step_fraction * spec.max_stable_step  # pyright: ignore[reportAttributeAccessIssue] - gravity is read
        self.faces, self.mass = spec.faces, spec.masses
        self._load_flex(spec.rest)
        self.force_terms, self.has_implicit_damping = [], True
        has_drag = spec.drag_normal > 0
        self._air = StillAir(spec, spec.faces, len(spec.rest)) if has_drag else None  # pyright: ignore[reportArgumentType]


def simulate_garment(
    spec: GarmentSpec, x0: Array, times: Array, grips: Mapping[str, Grip], step_fraction: float = 1.0
) -> Result:
    """Let the garment hang still in its grippers from x0 [V, 3] m, then move it; return its state at the times [T] s.

    Raises:
        SimulationDiverged: the simulation is unstable; take a smaller fraction of the step.
    """
    garment = MujocoGarment(spec, step_fraction)
    settling = np.array([0.0, SETTLING_S])
    x = garment.run(x0, settling, hold_grips(grips), damping_rate=SETTLING_DAMPING_PER_S).x[-1]
    begin = {name: replace(grip, t=grip.t - times[0]) for name, grip in grips.items()}
    return garment.run(x, times - times[0], begin)
