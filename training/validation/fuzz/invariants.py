"""What holds for everything that a reader accepts; the targets check it after each accepted input."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import torch

from torchcloth.meshes import Mesh
from torchcloth.recordings import Camera, ClothInfo, GraspInfo, Markers, PointClouds, Recording, Truth
from torchcloth.recordings.checks import ROUNDING_TOLERANCE
from torchcloth.recordings.images import ImageStream

UNIT_LENGTH_TOLERANCE = 10 * ROUNDING_TOLERANCE
MAX_CHECKED_IMAGES = 4  # of a stream; each load of an imported image decodes all before it


class BrokenPromise(AssertionError):
    """An input was accepted, and what was read from it breaks an invariant of its format."""


def require(condition: Any, what: str) -> None:
    """Raise ``BrokenPromise`` unless the condition holds; assertions of Python can be switched off."""
    if not condition:
        raise BrokenPromise(what)


def check_finite(arrays: Iterable[tuple[str, np.ndarray | torch.Tensor | float | None]]) -> None:
    """Check that named arrays hold finite numbers only; None stands for an array that is not there."""
    for name, array in arrays:
        require(array is None or np.isfinite(np.asarray(array)).all(), f"{name} is finite")


def check_times(t: np.ndarray, name: str) -> None:
    """Check times [N] s: some, finite and increasing."""
    require(t.ndim == 1 and len(t) > 0, f"{name} has times")
    require(np.isfinite(t).all() and (np.diff(t) > 0).all(), f"{name} increases")


def check_indices(indices: np.ndarray, count: int, name: str) -> None:
    """Check that there are indices, and that all are in 0 to ``count`` - 1."""
    require(indices.size > 0, f"{name} has indices")
    require(indices.dtype.kind in "iu" and indices.min() >= 0 and indices.max() < count, f"{name} is within range")


def check_rigid(matrix: np.ndarray, name: str) -> None:
    """Check a rigid transform [4, 4] in metres."""
    rotation = matrix[:3, :3]
    require(np.isfinite(matrix).all(), f"{name} is finite")
    require(np.abs(rotation @ rotation.T - np.eye(3)).max() < UNIT_LENGTH_TOLERANCE, f"{name} is orthonormal")
    require(np.linalg.det(rotation) > 0, f"{name} is no reflection")
    require(np.array_equal(matrix[3], [0, 0, 0, 1]), f"{name} ends with 0 0 0 1")


def check_unit(vectors: np.ndarray, name: str) -> None:
    """Check that vectors or quaternions [..., D] have length one."""
    off = np.abs(np.linalg.norm(vectors, axis=-1) - 1)
    require(np.isfinite(vectors).all() and off.max(initial=0.0) < UNIT_LENGTH_TOLERANCE, f"{name} is unit")


def check_recording(recording: Recording) -> None:
    """Check every stream of a recording, and that the streams fit together."""
    check_cloth(recording.cloth)
    for name, motion in recording.grippers.items():
        check_motion(motion, name)
        check_finite([(f"{name}/position", motion.position)])
        require(motion.position.shape == (len(motion.t), 3), f"{name}/position has 3 numbers for each time")
        require(motion.quat_wxyz.shape == (len(motion.t), 4), f"{name}/quat_wxyz has 4 numbers for each time")
        require(motion.closed is not None, f"{name}/closed is there")
        check_unit(motion.quat_wxyz, f"{name}/quat_wxyz")
    for name, motion in recording.joints.items():
        check_motion(motion, name)
        require(motion.q.ndim == 2 and len(motion.q) == len(motion.t) and motion.q.shape[1], f"{name}/q has joints")
        require(motion.width is None or motion.width.shape == motion.t.shape, f"{name}/width has one for each time")
        check_finite([(f"{name}/q", motion.q), (f"{name}/width", motion.width)])
    for name, robot in recording.robots.items():
        require(name in recording.joints or name in recording.grippers, f"robot {name} moves")
        check_rigid(robot.T_world_base, f"robots.{name}.T_world_base")
    for name, grasp in recording.grasps.items():
        require(name in recording.joints or name in recording.grippers, f"grasp {name} moves")
        check_grasp(grasp, recording.cloth, name)
    for name, collider in recording.colliders.items():
        check_finite([(f"{name}.point", collider.point), (f"{name}.friction", collider.friction)])
        check_unit(collider.normal, f"{name}.normal")
        require(collider.friction is None or collider.friction >= 0, f"{name}.friction is not negative")
    for name, camera in recording.cameras.items():
        check_camera(camera, name)
    if recording.points is not None:
        check_points(recording.points)
    if recording.markers is not None:
        check_markers(recording.markers)
    if recording.truth is not None:
        check_truth(recording.truth)
    noise, density = recording.observation_noise_std, recording.air_density
    check_finite([("gravity", recording.gravity), ("clock_offset", recording.clock_offset), ("noise", noise)])
    require(recording.gravity.shape == (3,), "gravity has three numbers")
    require(noise is None or noise >= 0, "observation_noise.std is not negative")
    require(density is None or 0 < density < np.inf, "air.density is positive")


def check_motion(motion: Any, name: str) -> None:
    """Check the times of a motion, and what grippers and arms have in common."""
    check_times(motion.t, name)
    for key in ("force", "torque"):
        vectors = getattr(motion, key)
        require(vectors is None or vectors.shape == (len(motion.t), 3), f"{name}/{key} has 3 numbers for each time")
        check_finite([(f"{name}/{key}", vectors)])
    closed = motion.closed
    is_whole = closed is None or (closed.shape == motion.t.shape and closed.dtype == bool)
    require(is_whole, f"{name}/closed has one for each time")


def check_cloth(cloth: ClothInfo) -> None:
    """Check the weight and the mesh or sheet of a cloth."""
    require(0 < cloth.areal_density < np.inf, "areal_density is positive")
    require(cloth.thickness is None or 0 < cloth.thickness < np.inf, "thickness is positive")
    require(cloth.sheet is None or all(0 < side < np.inf for side in cloth.sheet), "the sheet has sides")
    require(cloth.vertices is not None or cloth.sheet is not None, "the cloth has a shape")
    if cloth.vertices is not None and cloth.faces is not None:
        check_triangles(cloth.vertices, cloth.faces)
        if cloth.uv is not None:
            shapes = (len(cloth.vertices), 2), (*cloth.faces.shape, 2)
            require(cloth.uv.shape in shapes, "uv fits vertices or corners")
            check_finite([("uv", cloth.uv)])
    start = cloth.initial_vertices
    check_finite([("initial_vertices", start)])
    if start is not None and cloth.vertices is not None:
        require(start.shape == cloth.vertices.shape, "initial_vertices fit the mesh")


def check_triangles(vertices: np.ndarray, faces: np.ndarray) -> None:
    """Check vertices [V, 3] and faces [F, 3]."""
    require(vertices.ndim == 2 and vertices.shape[1] == 3, "vertices have three coordinates")
    require(faces.ndim == 2 and faces.shape[1] == 3, "faces have three corners")
    check_finite([("vertices", vertices)])
    check_indices(faces, len(vertices), "faces")


def check_mesh(mesh: Mesh) -> None:
    """Check a mesh that can be simulated: areas are positive, and nothing that is computed of it is infinite."""
    check_triangles(mesh.vertices, mesh.faces)
    require((mesh.area > 0).all() and np.isfinite(mesh.area).all(), "areas are positive")
    require((mesh.vertex_area > 0).all(), "every vertex has mass")
    require(len(np.unique(mesh.faces)) == len(mesh.vertices), "every vertex is in a triangle")
    check_finite([("rest", mesh.rest), ("shape_gradient", mesh.shape_gradient), ("pattern", mesh.pattern)])
    if mesh.pattern is None:  # else the rest shape is the pattern's
        corners = mesh.vertices[mesh.faces]
        sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1)
        rest_sides = np.linalg.norm(mesh.rest - np.roll(mesh.rest, 1, axis=1), axis=-1)
        require(np.allclose(rest_sides, sides, rtol=1e-6, atol=1e-9 * sides.max()), "the rest shape is the mesh's")


def check_grasp(grasp: GraspInfo, cloth: ClothInfo, name: str) -> None:
    """Check that a grasp has vertices of the mesh, or pattern points with a radius."""
    if grasp.uv is None:
        require(cloth.vertices is not None and grasp.vertices is not None, f"grasp {name} has material")
        check_indices(np.asarray(grasp.vertices), len(np.asarray(cloth.vertices)), f"grasp {name}")
    else:
        require(grasp.uv.ndim == 2 and grasp.uv.shape[1] == 2 and len(grasp.uv), f"grasp {name} has points")
        require(0 < grasp.radius < np.inf, f"grasp {name} has a radius")
        check_finite([(f"grasp {name}", grasp.uv)])


def check_camera(camera: Camera, name: str) -> None:
    """Check a camera's calibration, and decode the first of its images."""
    require(camera.width > 0 and camera.height > 0, f"{name} has a size")
    check_finite([(f"{name}.K", camera.K), (f"{name}.distortion", camera.distortion)])
    require(camera.K.shape == (3, 3) and camera.K[0, 0] > 0 and camera.K[1, 1] > 0, f"{name}.K has focal lengths")
    require(np.array_equal(camera.K[[1, 2, 2, 2], [0, 0, 1, 2]], [0, 0, 0, 1]), f"{name}.K is a camera matrix")
    check_rigid(camera.T_world_camera, f"{name}.T_world_camera")
    require(camera.depth is None or camera.depth_scale is not None, f"{name} has a unit of depth")
    require(camera.depth_scale is None or 0 < camera.depth_scale < np.inf, f"{name}.depth_scale is positive")
    for stream in (camera.depth, camera.color, camera.mask):
        if stream is not None:
            check_images(stream, (camera.height, camera.width), f"{name}/{stream.kind}")


def check_images(stream: ImageStream, shape: tuple[int, int], name: str) -> None:
    """Check times and frame numbers of a stream, and decode its first images."""
    check_times(stream.t, name)
    require(len(stream.frames) == len(stream.t), f"{name} has one time for each image")
    require((np.diff(stream.frames) > 0).all(), f"{name} has increasing frame numbers")
    dtypes = {"depth": np.uint16, "color": np.uint8, "mask": np.bool_}
    for i in range(min(len(stream), MAX_CHECKED_IMAGES)):
        pixels = stream.load(i)
        require(pixels.shape[:2] == shape and pixels.dtype == dtypes[stream.kind], f"{name}[{i}] is its kind's")


def check_points(points: PointClouds) -> None:
    """Check clouds of points."""
    check_times(points.t, "points")
    check_finite([("points.xyz", points.xyz)])
    require(points.xyz.ndim == 2 and points.xyz.shape[1] == 3, "points have three coordinates")
    require(points.counts.shape == points.t.shape and points.counts.min() >= 1, "every cloud has points")
    require(sum(points.counts.tolist()) == len(points.xyz), "every point is in a cloud")


def check_markers(markers: Markers) -> None:
    """Check tracked points, each seen whole or not at all."""
    check_times(markers.t, "markers")
    require(markers.xyz.ndim == 3 and markers.xyz.shape[::2] == (len(markers.t), 3), "markers have coordinates")
    seen = ~np.isnan(markers.xyz)
    require((seen.any(axis=-1) == seen.all(axis=-1)).all() and seen.any(), "markers are seen whole, some at least")
    check_finite([("markers.xyz", markers.xyz[seen]), ("markers.uv", markers.uv)])
    require(markers.uv is None or markers.uv.shape == (markers.xyz.shape[1], 2), "uv has a place for each marker")


def check_truth(truth: Truth) -> None:
    """Check the true motion of a synthetic episode."""
    check_times(truth.t, "truth")
    check_finite([("truth.vertices", truth.vertices)])
    require(truth.vertices.ndim == 3 and truth.vertices.shape[::2] == (len(truth.t), 3), "truth has coordinates")
    check_indices(truth.faces, truth.vertices.shape[1], "truth.faces")
