"""The frame in which the pose network looks at a scene: it moves and turns about the vertical with the scene."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..meshes import Mesh

MIN_GRIP_DISTANCE_M = 0.02  # of two grips along the cloth, and horizontally; nearer ones give no direction
REPORTED_GRIP_STD_M, GRIP_LAG_STD_S = 2e-3, 0.010  # of a gripper's reported place, and of its time against the cloud's
GRIP_REACH = 0.25  # of fabric that moves along with a held patch, in the scene's unit of length


class PoseInputs(NamedTuple):
    """What the pose network sees of B scenes, in world coordinates, z up.

    No orientation of the grippers is among it: tool frames have no common convention between robots.

    Attributes:
        points: [B, N, 3] m, the cloud. Points are drawn from the measured ones, with repetition if there are fewer.
        rest: [B, V, 3] m, rest coordinates of the vertices (`rest_coordinates`).
        exists: [B, V] bool, false where a smaller mesh of the batch is padded.
        grip: [B, V] int64, 0: free, k = 1 or 2: held by gripper k.
        grip_position: [B, 2, 3] m, centre of what each gripper holds, as the robot reports it; NaN: no such gripper.
        grip_velocity: [B, 2, 3] m/s.
        previous: [B, V, 3] m, the estimate of the frame before, 1/30 s earlier; NaN where there is none.
    """

    points: Tensor
    rest: Tensor
    exists: Tensor
    grip: Tensor
    grip_position: Tensor
    grip_velocity: Tensor
    previous: Tensor


class SceneFrame(NamedTuple):
    """Frames of B scenes in the world and on the fabric, in which the grips lie alike.

    The world's origin is the mean of the grippers, z is up, and x is horizontal from one gripper to the other. The
    fabric's origin is the mean of what is held, and x the same direction on the fabric, such that most of the fabric
    lies at negative y: a sheet that hangs by its upper edge hangs along z = y.

    Attributes:
        origin: [B, 3] m, in the world.
        axes: [B, 3, 3], rows are the axes in the world.
        rest_origin: [B, 3] m, on the fabric.
        rest_axes: [B, 3, 3], rows are the axes on the fabric.
        scale: [B, 1] m, unit of length: the largest distance along the fabric from its origin.
        spread: [B, 1], distance of the grippers over that of what they hold; 1 with one gripper.
        rise: [B, 1], rise of the line between the grippers over its length on the fabric; 0 with one gripper.
    """

    origin: Tensor
    axes: Tensor
    rest_origin: Tensor
    rest_axes: Tensor
    scale: Tensor
    spread: Tensor
    rise: Tensor

    def to_scene(self, positions: Tensor) -> Tensor:
        """Transform world positions [B, ..., 3] m to the scene's frame and unit."""
        return self.turn_to_scene(positions - _like(self.origin, positions)) / _like(self.scale, positions)

    def to_world(self, positions: Tensor) -> Tensor:
        """Transform positions [B, ..., 3] in the scene's frame and unit to the world [m]."""
        return self.turn_to_world(positions * _like(self.scale, positions)) + _like(self.origin, positions)

    def turn_to_scene(self, vectors: Tensor) -> Tensor:
        """Turn vectors [B, ..., 3] of the world into the scene's axes."""
        return torch.einsum("bij,b...j->b...i", self.axes, vectors)

    def turn_to_world(self, vectors: Tensor) -> Tensor:
        """Turn vectors [B, ..., 3] of the scene into the world's axes."""
        return torch.einsum("bij,b...i->b...j", self.axes, vectors)

    def rest_to_scene(self, rest: Tensor) -> Tensor:
        """Transform rest coordinates [B, V, 3] m to the fabric's frame and the scene's unit."""
        moved = rest - self.rest_origin[:, None]
        return torch.einsum("bij,bvj->bvi", self.rest_axes, moved) / self.scale[:, None]

    def hang(self, rest: Tensor) -> Tensor:
        """Return where fabric places [B, V, 3] (in its frame) lie on a plane that hangs from the grippers."""
        x, y, layer = rest.unbind(-1)
        return torch.stack([x * self.spread, -layer, y + x * self.rise], -1)


def rest_coordinates(mesh: Mesh) -> Tensor:
    """Return coordinates [V, 3] m of a mesh's vertices on the fabric: along it, and the height of the layer.

    A cloth of one panel has its pattern coordinates. Of a garment the rest mesh itself counts, in its main axes: it
    lies flat, with front over back.
    """
    if mesh.uv is not None:
        return torch.as_tensor(np.pad(mesh.uv, ((0, 0), (0, 1))), dtype=torch.get_default_dtype())
    centred = mesh.vertices - mesh.vertices.mean(0)
    axes = np.linalg.svd(centred, full_matrices=False)[2]
    if np.linalg.det(axes) < 0:
        axes[2] *= -1
    return torch.as_tensor(centred @ axes.T, dtype=torch.get_default_dtype())


def build_scene_frame(inputs: PoseInputs) -> SceneFrame:
    """Compute the frames of the scenes."""
    rest, exists = inputs.rest, inputs.exists
    has_grip = inputs.grip_position.isfinite().all(-1)
    held_by = torch.stack([inputs.grip == k for k in (1, 2)], 1) & exists[:, None] & has_grip[..., None]  # [B, 2, V]
    has_grip = held_by.any(-1)
    patches = _masked_mean(rest[:, None], held_by)  # [B, 2, 3]
    grips = inputs.grip_position.nan_to_num()
    middle = _masked_mean(rest, exists)
    rest_origin = torch.where(has_grip.any(-1, keepdim=True), _masked_mean(patches, has_grip), middle)
    origin = torch.where(has_grip.any(-1, keepdim=True), _masked_mean(grips, has_grip), inputs.points.mean(1))

    is_pair = has_grip.all(-1, keepdim=True)
    across_rest, across = patches[:, 1] - patches[:, 0], grips[:, 1] - grips[:, 0]
    is_pair = is_pair & (across_rest[:, :2].norm(dim=-1, keepdim=True) > MIN_GRIP_DISTANCE_M)
    down = (middle - rest_origin)[:, :2]
    # of a single grip: down is where the fabric's middle lies
    alone = torch.stack([-down[:, 1], down[:, 0]], -1)
    rest_x = _unit(torch.where(is_pair, across_rest[:, :2], alone), inputs.rest.new_tensor([1.0, 0.0]))
    height = rest_x[:, 0] * down[:, 1] - rest_x[:, 1] * down[:, 0]
    sign = (1 - 2 * (height > 0).to(rest)).unsqueeze(-1)
    rest_x = sign * rest_x
    zero, one = torch.zeros_like(height), torch.ones_like(height)
    rest_axes = torch.stack(
        [
            torch.stack([rest_x[:, 0], rest_x[:, 1], zero], -1),
            torch.stack([-rest_x[:, 1], rest_x[:, 0], zero], -1),
            torch.stack([zero, zero, one], -1),
        ],
        1,
    )
    local = torch.einsum("bij,bvj->bvi", rest_axes, rest - rest_origin[:, None])
    reach = local[..., :2].norm(dim=-1).where(exists, 0.0)
    scale = reach.amax(-1, keepdim=True).clamp_min(MIN_GRIP_DISTANCE_M)

    is_level_pair = is_pair & (across[:, :2].norm(dim=-1, keepdim=True) > MIN_GRIP_DISTANCE_M)
    seen = _horizontal_direction(inputs, local, origin)
    heading = torch.where(is_level_pair, sign * across[:, :2], seen)
    x = _unit(heading, inputs.rest.new_tensor([1.0, 0.0]))
    axes = torch.stack(
        [
            torch.stack([x[:, 0], x[:, 1], zero], -1),
            torch.stack([-x[:, 1], x[:, 0], zero], -1),
            torch.stack([zero, zero, one], -1),
        ],
        1,
    )
    length = across_rest[:, :2].norm(dim=-1, keepdim=True).clamp_min(MIN_GRIP_DISTANCE_M)
    spread = torch.where(is_pair, across[:, :2].norm(dim=-1, keepdim=True) / length, 1.0)
    rise = torch.where(is_pair, sign * across[:, 2:] / length, 0.0)
    return SceneFrame(origin, axes, rest_origin, rest_axes, scale, spread, rise)


def move_to_grippers(x: Tensor, std: Tensor, inputs: PoseInputs, grip_std: float = REPORTED_GRIP_STD_M) -> Tensor:
    """Return positions [B, V, 3] m, moved smoothly so that what is held comes nearer to its gripper.

    The robot says where its grippers are to ``grip_std`` [m], and earlier or later than the cloud by
    `GRIP_LAG_STD_S`. The network says it with its own standard deviation [B, V] m. The held patch comes to their
    weighted mean, and fabric nearby moves along.
    """
    moved = torch.zeros_like(x)
    share = x.new_zeros(*x.shape[:2], 1)
    reach = build_scene_frame(inputs).scale[..., None] * GRIP_REACH
    for k in (0, 1):
        is_held = (inputs.grip == k + 1) & inputs.exists & inputs.grip_position[:, k].isfinite().all(-1)[:, None]
        offset = inputs.grip_position[:, k].nan_to_num() - _masked_mean(x, is_held)
        speed = inputs.grip_velocity[:, k].nan_to_num().norm(dim=-1)
        variance_grip = grip_std**2 + (GRIP_LAG_STD_S * speed).square()
        variance = _masked_mean(std[..., None], is_held)[:, 0].square()
        weight = variance / (variance + variance_grip) * is_held.any(-1)
        distance = (inputs.rest - _masked_mean(inputs.rest, is_held)[:, None]).norm(dim=-1, keepdim=True)
        kernel = (-0.5 * (distance / reach).square()).exp()
        moved = moved + kernel * (weight[:, None] * offset)[:, None]
        share = share + kernel
    return x + moved / share.clamp_min(1.0)


def _horizontal_direction(inputs: PoseInputs, local: Tensor, origin: Tensor) -> Tensor:
    """[B, 2] horizontal direction of the fabric's x axis, from the frame before, else the cloud's longer axis."""
    before = (inputs.previous - origin[:, None])[..., :2]
    weight = (inputs.exists & before.isfinite().all(-1)).to(local)
    from_previous = torch.einsum("bv,bv,bvi->bi", weight, local[..., 0], before.nan_to_num())
    spread = inputs.points[..., :2] - inputs.points[..., :2].mean(1, keepdim=True)
    covariance = spread.mT @ spread
    angle = 0.5 * torch.atan2(2 * covariance[:, 0, 1], covariance[:, 0, 0] - covariance[:, 1, 1])
    from_cloud = torch.stack([angle.cos(), angle.sin()], -1)
    return torch.where(weight.any(-1, keepdim=True), from_previous, from_cloud)


def _masked_mean(values: Tensor, mask: Tensor) -> Tensor:
    """Mean of values [..., N, 3] over those of mask [..., N]; zero of none."""
    weight = mask.to(values).unsqueeze(-1)
    return (values * weight).sum(-2) / weight.sum(-2).clamp_min(1.0)


def _unit(vectors: Tensor, default: Tensor) -> Tensor:
    """Vectors [B, 2] of length 1; the default where one has none."""
    length = vectors.norm(dim=-1, keepdim=True)
    return torch.where(length > torch.finfo(vectors.dtype).tiny, vectors / length.clamp_min(1e-12), default)


def _like(per_scene: Tensor, values: Tensor) -> Tensor:
    """View [B, C] as [B, 1, ..., C], to be used with values [B, ..., 3]."""
    return per_scene.reshape(len(per_scene), *(1,) * (values.dim() - 2), per_scene.shape[-1])
