"""What the simulation makes of a network's answer, compared with the clouds that follow: physics in the loss."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor
from torch.func import functional_call

from torchcloth import Cloth, Trajectory
from torchcloth.errors import SimulationDiverged, UnstableStep
from torchcloth.losses import find_closest_points
from torchcloth.losses.surface import point_distances
from torchcloth.meshes import Mesh

from .data import PoseBatch, PoseSample
from .scenes import FABRIC_THICKNESS_M, Fabric, build_cloth, gripper_names

MAX_DISTANCE_M = 0.03  # of a point that pulls; farther ones are not of the cloth, or the answer is another shape
MAX_CLOTHS = 256  # that are remembered
# About the training's fabrics; a guess of an untrained network must not ask for a step that never ends.
LOG_STIFFNESS_RANGE = (math.log(30.0), math.log(1500.0))
PARAMETERS = ("material.youngs_modulus.raw", "effects.bending.stiffness.raw", "effects.air.normal.raw")


class PhysicsLoss:
    """Mean distance of a cloud and the next ones from a network's answer and its simulated continuation.

    The state (positions and velocities) and the fabric's parameters carry gradients through ``tc.Cloth``.

    Args:
        scenes: largest number of scenes of a batch that are simulated.
    """

    def __init__(self, scenes: int = 4) -> None:
        self.scenes = scenes
        self._cloths: OrderedDict[int, tuple[Cloth, Mapping[str, Any]]] = OrderedDict()

    def __call__(self, x: Tensor, v: Tensor, log_fabric: Tensor, batch: PoseBatch) -> Tensor:
        """Return the mean distance [m]; zero where no scene has clouds that follow.

        Args:
            x: [B, V, 3] m, positions of the vertices in the world of the batch.
            v: [B, V, 3] m/s, their velocities.
            log_fabric: [B, 3], logarithms of membrane stiffness [N/m], bending stiffness [N m] and drag.
            batch: whose clouds are compared.
        """
        distances = []
        for k, sample in enumerate(batch.samples):
            if len(distances) == self.scenes:
                break
            if not bool(batch.next_times[k].isfinite().any()):
                continue
            back, count = batch.world_map[k].to(x), len(sample.rest)
            distance = self.distance_ahead(x[k, :count] @ back, v[k, :count] @ back, log_fabric[k], sample)
            if distance is not None:
                distances.append(distance)
        return torch.stack(distances).mean() if distances else x.sum() * 0.0

    def distance_ahead(self, x: Tensor, v: Tensor, log_fabric: Tensor, sample: PoseSample) -> Tensor | None:
        """Return the mean distance [m] of a sample's cloud and the next ones; None if the simulation diverges."""
        cloth = self._cloth(sample.motion)
        is_there = torch.as_tensor(sample.next_times).isfinite()
        times = [sample.time, *(sample.time + float(t) for t in sample.next_times[is_there.numpy()])]
        stiffness = log_fabric[0].clamp(*LOG_STIFFNESS_RANGE)
        values = (stiffness - math.log(FABRIC_THICKNESS_M), log_fabric[1].exp(), log_fabric[2].exp())
        try:
            frames = functional_call(
                cloth,
                dict(zip(PARAMETERS, values, strict=True)),
                (cloth.state(x, v), read_motion(sample.motion)),
                {"times": times},
            ).x
        except (SimulationDiverged, UnstableStep):
            return None
        faces = torch.as_tensor(sample.motion["faces"]).long()
        clouds = torch.cat([torch.as_tensor(sample.points)[None], torch.as_tensor(sample.next_points)[is_there]]).to(x)
        return torch.stack([_robust_distance(c, f, faces) for c, f in zip(clouds, frames, strict=True)]).mean()

    def _cloth(self, motion: Mapping[str, Any]) -> Cloth:
        """The cloth of a motion; cloths of motions that came lately are remembered."""
        key = id(motion)
        if key not in self._cloths:
            mesh = Mesh.build(motion["vertices"], motion["faces"], motion["pattern"])
            grips = [(motion["grip"] == k).nonzero()[0] for k in (1, 2) if (motion["grip"] == k).any()]
            cloth = build_cloth(mesh, Fabric(*motion["fabric"].tolist()), grips, bool(motion["has_table"]))
            self._cloths[key] = cloth, motion  # the motion too, so that no other takes its identity
            if len(self._cloths) > MAX_CLOTHS:
                self._cloths.popitem(last=False)
        self._cloths.move_to_end(key)
        return self._cloths[key][0]


def read_motion(motion: Mapping[str, Any]) -> dict[str, Trajectory]:
    """Return the paths of the grippers of a motion's file, by boundary."""
    t = torch.as_tensor(motion["motion_times"], dtype=torch.float64)
    closed = torch.ones(len(t), dtype=torch.bool)
    poses = torch.as_tensor(motion["motion_pose"], dtype=torch.get_default_dtype())
    return {
        name: Trajectory(t, pose, closed)
        for k, (name, pose) in enumerate(zip(gripper_names(2), poses, strict=False))
        if (motion["grip"] == k + 1).any()
    }


def _robust_distance(points: Tensor, x: Tensor, faces: Tensor) -> Tensor:
    return point_distances(points, x, find_closest_points(points, x.detach(), faces)).clamp(max=MAX_DISTANCE_M).mean()
