"""The hanging cloth of the IRI rig, simulated along many runs at once, and its distance from the nodes of a camera."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchcloth import effects, materials, meshes
from torchcloth._utils.constants import STANDARD_AIR_DENSITY_KG_PER_M3
from torchcloth.boundaries import Grasp
from torchcloth.cloth import Cloth
from torchcloth.types import Trajectory

from ...validation.realdata.frame_times import TimedRun
from ...validation.realdata.swings import IRI_BENDING_N_M, IRI_DAMPING_TIME_S, SHEET_SIDE_M
from .entrained_air import EntrainedAir
from .swings import ASSUMED_POISSON_RATIO, NOMINAL_DENSITY_KG_PER_M2

RIG_ROWS, RIG_COLUMNS = 9, 5  # of vertices; 13 x 5 at 50 N/m moves a distance by less than 0.2 mm
RIG_STIFFNESS_N_PER_M = 30.0  # assumed: 1.5 % longer under its own weight, 0.7 % of the frequency
OUTPUT_STEP_S = 0.01
SURFACE_REFINEMENT = 4  # points of the surface along a mesh edge

Values = dict[str, float]  # by names such as "air.normal"


class Motion(NamedTuple):
    """A simulated run.

    Attributes:
        t: [T] s, on the tool's clock.
        x: [T, V, 3] m.
    """

    t: np.ndarray
    x: np.ndarray

    def at(self, t: np.ndarray) -> np.ndarray:
        """Return the vertices [F, V, 3] m at times [F] s."""
        k = np.clip(np.searchsorted(self.t, t) - 1, 0, len(self.t) - 2)
        share = ((t - self.t[k]) / (self.t[k + 1] - self.t[k]))[:, None, None]
        return (1 - share) * self.x[k] + share * self.x[k + 1]


def build_cloth(values: Sequence[Values]) -> Cloth:
    """Build the cloth with one set of values for each element of a batch."""

    def number(name: str) -> Tensor:
        return torch.tensor([[v.get(name, 0.0)] for v in values], dtype=torch.float64)

    air, named = STANDARD_AIR_DENSITY_KG_PER_M3, set().union(*values)
    parts: dict[str, effects.AbstractEffect] = {
        "gravity": effects.Gravity(),
        "bending": effects.Bending(IRI_BENDING_N_M, IRI_DAMPING_TIME_S),
    }
    if named & {"air.normal", "air.tangential"}:
        parts["air"] = effects.AirDrag(number("air.normal"), tangential=number("air.tangential"), density=air)
    if "added.length" in named:
        parts["added"] = effects.AddedMass(number("added.length"), air)
    if "damping.rate" in named:
        parts["damping"] = effects.MassDamping(number("damping.rate"))
    if "entrained.length" in named:
        parts["entrained"] = EntrainedAir(number("entrained.length"), number("entrained.time"), air)
    mesh = meshes.rectangle(SHEET_SIDE_M, SHEET_SIDE_M, resolution=(RIG_COLUMNS, RIG_ROWS))
    upper_edge = np.flatnonzero(_pattern(mesh)[:, 1] > SHEET_SIDE_M - 1e-9)
    material = materials.AEP(RIG_STIFFNESS_N_PER_M / 1e-3, ASSUMED_POISSON_RATIO, thickness=1e-3)
    hanger = {"hanger": Grasp(upper_edge.tolist())}
    return Cloth(mesh, material, NOMINAL_DENSITY_KG_PER_M2, parts, hanger, contact=None).double()


def _pattern(mesh: meshes.Mesh) -> np.ndarray:
    return np.asarray(mesh.vertices)[:, :2]


def simulate(runs: Sequence[TimedRun], values: Sequence[Values]) -> list[dict[str, Motion]]:
    """Simulate all runs with each set of values, in one batch; the cloth first hangs flat and at rest.

    Returns:
        For each set of values the motions by the run's name.
    """
    duration = max(run.path.t[-1] - run.path.t[0] for run in runs)
    grid = np.arange(0, duration, OUTPUT_STEP_S)
    cloth = build_cloth([v for v in values for _ in runs])
    pattern = _pattern(cloth.mesh)
    poses, initial = np.tile(np.eye(4), (len(runs), len(grid), 1, 1)), []
    for k, run in enumerate(runs):
        t = np.minimum(run.path.t[0] + grid, run.path.t[-1])
        poses[k, :, :3, :3], poses[k, :, :3, 3] = run.path.rotation_matrix(t), run.path.position(t)
        middle = run.path.carry(t[:1], run.clock.edge_offset)[0]
        along = poses[k, 0, :3, 1] * [1, 1, 0]  # the tool's y axis points along the edge
        along = along / np.linalg.norm(along)
        initial.append(
            middle
            + np.outer(pattern[:, 0] - SHEET_SIDE_M / 2, along)
            + np.outer(pattern[:, 1] - SHEET_SIDE_M, [0.0, 0.0, 1.0])
        )
    pose = torch.as_tensor(np.tile(poses, (len(values), 1, 1, 1)))
    motion = {"hanger": Trajectory(torch.as_tensor(grid), pose, torch.ones(len(grid), dtype=torch.bool))}
    with torch.no_grad():
        state = cloth.state(torch.as_tensor(np.tile(np.stack(initial), (len(values), 1, 1))))
        x = cloth(state, motion, torch.as_tensor(grid)).x.numpy().reshape(len(values), len(runs), len(grid), -1, 3)
    return [{run.name: Motion(run.path.t[0] + grid, x[i, k]) for k, run in enumerate(runs)} for i in range(len(values))]


def carry_rigidly(run: TimedRun) -> Motion:
    """Return the cloth as if it were a board that the tool carries."""
    grid = np.arange(run.path.t[0], run.path.t[-1], OUTPUT_STEP_S)
    pattern = _pattern(build_cloth([{}]).mesh)
    axes, middle = run.path.rotation_matrix(grid), run.path.carry(grid, run.clock.edge_offset)
    along = axes[0, :, 1] * [1, 1, 0]
    flat = np.outer(pattern[:, 0] - SHEET_SIDE_M / 2, along / np.linalg.norm(along))
    flat = flat + np.outer(pattern[:, 1] - SHEET_SIDE_M, [0.0, 0.0, 1.0])
    return Motion(grid, np.einsum("tab,cb,vc->tva", axes, axes[0].T, flat) + middle[:, None])


def normal_distances(x: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Return the distances [F, A, D] m of nodes along the surface's normal at the nearest point; NaN without depth.

    Args:
        x: [F, V, 3] m, vertices of the rig's mesh.
        nodes: [F, A, D, 3] m.
    """
    surface = x.reshape(len(x), RIG_COLUMNS, RIG_ROWS, 3)
    for axis in (1, 2):
        surface = _refine(surface, axis)
    normal = np.cross(np.gradient(surface, axis=1), np.gradient(surface, axis=2))
    normal = (normal / np.linalg.norm(normal, axis=-1, keepdims=True)).reshape(len(x), -1, 3)
    surface, flat = surface.reshape(len(x), -1, 3), nodes.reshape(len(x), -1, 3)
    out = np.full(flat.shape[:2], np.nan)
    for k in range(len(x)):
        seen = np.isfinite(flat[k]).all(-1)
        gap = flat[k, seen][:, None] - surface[k]
        nearest = (gap**2).sum(-1).argmin(1)
        out[k, seen] = (gap[np.arange(len(gap)), nearest] * normal[k, nearest]).sum(-1)
    return out.reshape(nodes.shape[:3])


def _refine(grid: np.ndarray, axis: int) -> np.ndarray:
    """Interpolate linearly along an axis."""
    last = grid.shape[axis] - 1
    at = np.linspace(0, last, last * SURFACE_REFINEMENT + 1)
    before = np.minimum(at.astype(int), last - 1)
    share = (at - before).reshape([-1 if k == axis else 1 for k in range(grid.ndim)])
    return (1 - share) * np.take(grid, before, axis) + share * np.take(grid, before + 1, axis)
