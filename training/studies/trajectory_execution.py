"""Motions of the trajectories study, carried out by MuJoCo."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from torchcloth.errors import SimulationDiverged
from torchcloth.losses import chamfer_to_surface
from torchcloth.planning import Goal
from torchcloth.synthesis.garments import GARMENTS, cloth_properties
from torchcloth.types import Trajectory

from ..validation.independent.garment import GarmentSpec, simulate_garment
from ..validation.independent.mujoco_cloth import Grip
from .manipulations.scenes import Fabric
from .trajectory_scenes import Scene

STEP_FRACTIONS = (1.0, 0.5)  # of MuJoCo's stable step; the second one is for motions that stretch the cloth
DAMPING_TIME_S = 1e-3  # Rayleigh coefficient; MuJoCo's flex has no damping of bending alone


def execute_in_mujoco(garment: str, scene: Scene, goal: Goal, motion: Mapping[str, Trajectory]) -> float | None:
    """Return the distance [m] from the goal after a motion in MuJoCo; None where its simulation is unstable.

    Only for garments that hang all the time: neither the table nor contact of layers is simulated there.
    """
    spec = garment_spec(garment, scene)
    first, times, grips = scene.run.state.x.numpy(), scene.run.times.numpy(), _grips(scene, motion)
    for step_fraction in STEP_FRACTIONS:
        try:
            x = simulate_garment(spec, first, times[[0, -1]], grips, step_fraction).x[-1]
        except SimulationDiverged:
            continue
        return float(chamfer_to_surface(goal.points, torch.as_tensor(x), torch.as_tensor(spec.faces)))
    return None


def garment_spec(garment: str, scene: Scene) -> GarmentSpec:
    """Return the garment with its true fabric for MuJoCo, on the scene's mesh."""
    fabric, properties = Fabric.true(garment), cloth_properties(GARMENTS[garment].fabric)
    return GarmentSpec(
        rest=np.asarray(scene.rest, dtype=float),
        faces=np.asarray(scene.cloth.mesh.faces),
        areal_density=float(scene.cloth.areal_density.value),
        membrane_stiffness=fabric.youngs_modulus * properties["thickness"],
        poisson_ratio=fabric.poisson_ratio,
        bending_stiffness=fabric.bending,
        damping_time=DAMPING_TIME_S,
        drag_normal=fabric.air,
    )


def _grips(scene: Scene, motion: Mapping[str, Trajectory]) -> dict[str, Grip]:
    grasps: Mapping[str, Any] = scene.recording.grasps
    return {
        name: Grip(np.asarray(grasps[name].vertices), path.t.numpy(), path.pose.numpy())
        for name, path in motion.items()
    }
