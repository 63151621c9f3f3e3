"""Starts for the pose of a camera: what moves in its images is laid on what moves of an arm."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from ..errors import InvalidInput
from .camera import DepthCamera
from .cloud import to_points
from .rigid import Pose, fit_pose
from .solids import Solid, build_solid_meshes

Array = np.ndarray
MOVING_DEPTH_STEP_M = 0.04  # what is nearer than the background by so much, and by the share below, moves
MOVING_DEPTH_SHARE = 0.02
BACKGROUND_QUANTILE = 0.8  # over the images: what is seen behind the moving things
MIN_MOVING_PIXELS = 40  # of an image that is used
MIN_MOVING_IMAGES = 3
MIN_SOLID_TRAVEL_M = 0.05  # of a corner of a solid that moves
POINTS_PER_IMAGE = (12, 50)  # in the first and second round
SAMPLES_PER_IMAGE = 600  # of the arm's surface
IMAGE_SEPARATION_M = 1000.0  # in the fourth coordinate of the search, so that images do not mix
START_ROTATIONS = 300
SECOND_ROUND_STARTS = 30
ICP_SCALES_M = (tuple(np.geomspace(0.4, 0.1, 7)), tuple(np.geomspace(0.1, 0.03, 7)))  # of the weights of each iteration
MAX_POSE_STARTS = 6
MIN_START_SEPARATION_RAD = 0.2
START_TURN_RAD = 0.3  # about each axis, of starts around a given one


def find_moving_points(camera: DepthCamera, depths: Array) -> list[Array]:
    """Return the points [N, 3] m, in the axes of the camera, of each image's pixels that are before the background.

    Args:
        camera: that took the images.
        depths: [T, H, W] m, 0 = invalid.
    """
    order = np.sort(np.where(depths > 0, depths, np.inf), axis=0)  # pixels without a reading last
    last = np.maximum((depths > 0).sum(0) - 1, 0)
    background = np.take_along_axis(order, np.rint(BACKGROUND_QUANTILE * last).astype(int)[None], axis=0)[0]
    is_moving = (depths > 0) & (depths < (1 - MOVING_DEPTH_SHARE) * background - MOVING_DEPTH_STEP_M)
    inverse = np.linalg.inv(camera.T_world_camera)
    clouds = [to_points(camera, depth, mask) for depth, mask in zip(depths, is_moving, strict=True)]
    return [cloud @ inverse[:3, :3].T + inverse[:3, 3] for cloud in clouds]


def search_starts(clouds: Sequence[Array], solids: Sequence[Solid], start: Array | None) -> list[Array]:
    """Return likely poses [4, 4] of the camera, the best first.

    Points that move are laid on moving solids by iterated closest points, from rotations all over, and around a start.
    Each point searches in its own image. The arm outweighs the cloth that it moves, whose points count less and less.

    Args:
        clouds: T clouds of ``find_moving_points``.
        solids: with poses [T, 4, 4].
        start: [4, 4] a rough pose, or None.

    Raises:
        InvalidInput: too little moves in the images, or of the arm.
    """
    rng = np.random.default_rng(0)
    samples = _sample_moving_surface(solids, len(clouds), rng)
    chosen = [t for t, cloud in enumerate(clouds) if len(cloud) >= MIN_MOVING_PIXELS]
    if samples is None or len(chosen) < MIN_MOVING_IMAGES:
        raise InvalidInput(
            "motion of the arm",
            got="next to none" if samples is None else f"{len(chosen)} images in which something moves",
            expected=f"an arm that moves by more than {MIN_SOLID_TRAVEL_M:g} m in {MIN_MOVING_IMAGES} images or more",
            remedy="record a motion of the arm in its view",
        )
    targets = np.concatenate([np.column_stack([x, np.full(len(x), IMAGE_SEPARATION_M * t)]) for t, x in samples])
    tree, targets = KDTree(targets), torch.as_tensor(targets[:, :3])
    middle = torch.as_tensor(np.concatenate([clouds[t] for t in chosen]).mean(0))
    pose = _initial_poses(middle, targets.mean(0), start, rng)
    for count, scales in zip(POINTS_PER_IMAGE, ICP_SCALES_M, strict=True):
        points = torch.as_tensor(np.concatenate([rng.choice(clouds[t], count) for t in chosen]))
        fourth = np.tile(IMAGE_SEPARATION_M * np.repeat(chosen, count)[:, None], (len(pose.R), 1, 1))
        for scale in scales:
            distance, nearest = tree.query(np.concatenate([pose.transform(points).numpy(), fourth], -1))
            weight = torch.as_tensor((1 + (distance / scale) ** 2) ** -2.0)
            pose = fit_pose(points.expand(*weight.shape, 3), targets[torch.as_tensor(nearest)], weight)
        order = weight.mean(1).argsort(descending=True)[:SECOND_ROUND_STARTS]
        pose = Pose(pose.R[order], pose.t[order])
    return _select_distinct(pose) + ([] if start is None else [start])


def _sample_moving_surface(
    solids: Sequence[Solid], count: int, rng: np.random.Generator
) -> list[tuple[int, Array]] | None:
    """Image and points [N, 3] m of the surface of what moves, for each image; None if nothing does."""
    travel = [_travel(solid) for solid in solids]
    moving = [solid for solid, length in zip(solids, travel, strict=True) if length > MIN_SOLID_TRAVEL_M]
    if not moving:
        return None
    meshes = build_solid_meshes(moving, at=0)
    corners = np.concatenate([x[faces] for x, faces in meshes])
    solid = np.repeat(np.arange(len(meshes)), [len(faces) for _, faces in meshes])
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    pick = rng.choice(len(area), SAMPLES_PER_IMAGE, p=area / area.sum())
    weights = rng.dirichlet(np.ones(3), SAMPLES_PER_IMAGE)
    points = np.column_stack([(weights[:, None] @ corners[pick])[:, 0], np.ones(SAMPLES_PER_IMAGE)])
    poses = np.stack([_poses(s) for s in moving])
    motion = poses @ np.linalg.inv(poses[:, :1])
    return [(t, np.einsum("nij,nj->ni", motion[solid[pick], t], points)[:, :3]) for t in range(count)]


def _poses(solid: Solid) -> Array:
    return solid.pose.detach().cpu().numpy() if hasattr(solid.pose, "detach") else np.asarray(solid.pose)


def _travel(solid: Solid) -> float:
    """Largest extent [m] along an axis of the path of a point at the solid's largest size from its origin."""
    poses = _poses(solid)
    marks = [poses[:, :3, 3], *(poses[:, :3, 3] + max(solid.size) / 2 * poses[:, :3, k] for k in range(3))]
    return max(float(np.ptp(mark, axis=0).max()) for mark in marks)


def _initial_poses(middle: torch.Tensor, target: torch.Tensor, start: Array | None, rng: np.random.Generator) -> Pose:
    rotations = torch.as_tensor(Rotation.random(START_ROTATIONS, rng).as_matrix())
    shifts = target - rotations @ middle
    if start is not None:
        turns = Rotation.from_rotvec(START_TURN_RAD * rng.uniform(-1, 1, (START_ROTATIONS // 4, 3)))
        near = torch.as_tensor(turns.as_matrix() @ start[:3, :3])
        place = torch.as_tensor(start[:3, :3]) @ middle + torch.as_tensor(start[:3, 3])
        rotations = torch.cat([rotations, near])
        shifts = torch.cat([shifts, place - near @ middle])
    return Pose(rotations, shifts)


def _select_distinct(pose: Pose) -> list[Array]:
    """Return the first of the poses that differ in their rotation."""
    best: list[Array] = []
    for R, t in zip(pose.R, pose.t, strict=True):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R.numpy(), t.numpy()
        turns = [Rotation.from_matrix(T[:3, :3].T @ other[:3, :3]).magnitude() for other in best]
        if len(best) < MAX_POSE_STARTS and all(turn > MIN_START_SEPARATION_RAD for turn in turns):
            best.append(T)
    return best
