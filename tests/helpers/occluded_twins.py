"""An episode of ``twins`` whose cloth is partly occluded, with its truth.

The library simulated it on another mesh with another substep (an inverse crime). The study ``pose`` measures the errors
against the truth of another engine.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

import torchcloth as tc
from helpers import twins
from torchcloth import recordings as rec
from torchcloth.robots import replay

WRONG_FABRIC = replace(twins.TRUE_FABRIC, membrane=0.5 * twins.TRUE_FABRIC.membrane, drag=0.5 * twins.TRUE_FABRIC.drag)
BAR_WIDTH_FRACTION = 0.3  # of the sheet, occluded by a bar


@dataclass(frozen=True, eq=False)
class OccludedTwin:
    """An episode with its truth.

    Attributes:
        recording: the episode.
        truth: [T, V, 3] m.
        hidden: [T, V] bool, behind the bar.
    """

    recording: rec.Recording
    truth: Tensor
    hidden: Tensor


def make_occluded_twin() -> OccludedTwin:
    """Return a shaken sheet behind a bar that moves once from one side to the other."""
    recording, t = twins.make_twin(), np.arange(twins.FRAME_COUNT) / twins.FRAME_RATE_HZ
    x = _simulate_truth(t)
    uv = np.asarray(tc.meshes.rectangle(twins.SIDE_M, twins.SIDE_M, resolution=twins.FIT_RESOLUTION).uv)
    truth = np.stack([twins.interpolate_bilinear(frame, twins.TRUTH_RESOLUTION, uv) for frame in x])
    left = (1 - BAR_WIDTH_FRACTION) * twins.SIDE_M * t / t[-1]  # of the bar, along the pattern's v
    clouds, visible = np.split(recording.points.xyz, np.cumsum(recording.points.counts)[:-1]), []
    for frame, cloud, start in zip(x, clouds, left, strict=True):
        v = _pattern_v(frame, cloud)
        visible.append(cloud[(v < start) | (v > start + BAR_WIDTH_FRACTION * twins.SIDE_M)])
    points = rec.PointClouds(t, np.concatenate(visible), np.array([len(cloud) for cloud in visible]))
    hidden = (uv[:, 1] > left[:, None]) & (uv[:, 1] < left[:, None] + BAR_WIDTH_FRACTION * twins.SIDE_M)
    return OccludedTwin(replace(recording, points=points), torch.as_tensor(truth), torch.as_tensor(hidden))


def build_cloth(scene: OccludedTwin, fabric: twins.Fabric) -> tc.Cloth:
    """Return the cloth on the mesh of the fit, with a fabric's values."""
    values = {
        "youngs_modulus": fabric.membrane / twins.THICKNESS_M,
        "poisson_ratio": fabric.poisson,
        "bending.stiffness": fabric.bending,
        "air.normal": fabric.drag,
    }
    return twins.build_cloth_at(scene.recording, **values)


def _simulate_truth(t: np.ndarray) -> np.ndarray:
    """Return positions [T, V, 3] m on the true mesh, as in ``twins.make_twin``."""
    truth, motion = twins.make_cloth(twins.TRUE_FABRIC, twins.TRUTH_RESOLUTION), twins.make_shaking_motion()
    empty = rec.Recording(cloth=rec.ClothInfo(areal_density=1.0), provenance="synthetic: twins.py", grippers=motion)
    with torch.no_grad():
        trajectories = replay(empty)
        state = truth.settle(truth.state(twins.flat_positions(truth)), trajectories, duration=1.0, rate=15.0)
        return truth(state, trajectories, t.tolist(), dt=0.6 * truth.stable_step()).x.numpy()


def _pattern_v(frame: np.ndarray, cloud: np.ndarray) -> np.ndarray:
    """Return the pattern coordinate v [N] m of the vertex nearest to each point."""
    near = np.linalg.norm(cloud[:, None] - frame, axis=-1).argmin(1)
    return twins.SIDE_M * (near % twins.TRUTH_RESOLUTION[1]) / (twins.TRUTH_RESOLUTION[1] - 1)
