"""Depth images of triangle meshes by ray casting (open3d, imported when called)."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np

from ..errors import InvalidInput, MissingDependency
from .camera import DepthCamera

Array = np.ndarray


class Surfaces(NamedTuple):
    """What the pixels of a camera see.

    Attributes:
        depth: [H, W] float32 m along the optical axis, 0 where nothing is seen.
        ids: [H, W] int32, index of the body; -1 where there is none or it is out of range.
        normals: [H, W, 3] float32, of the triangle in the world, as its corners say; 0 where nothing is seen.
    """

    depth: Array
    ids: Array
    normals: Array


def render_depth(camera: DepthCamera, meshes: Sequence[tuple[Array, Array]]) -> tuple[Array, Array]:
    """Render what the camera would see without noise.

    Both sides of every triangle are visible, so that a sheet needs no thickness. Bodies nearer than the camera's range
    still hide what is behind them.

    Args:
        camera: the camera.
        meshes: for each body its vertices [V, 3] m in world coordinates and triangles [F, 3].

    Returns:
        Depth [H, W] float32, m along the optical axis, 0 where nothing is seen, and ids [H, W] int32: the index in
        ``meshes`` of the body that was hit, -1 where there is none or it is out of range.

    Raises:
        MissingDependency: open3d cannot be imported.
        InvalidInput: a mesh that has the wrong shape, an index out of bounds or a vertex that is not finite.
    """
    surfaces = render_surfaces(camera, meshes)
    return surfaces.depth, surfaces.ids


def render_surfaces(camera: DepthCamera, meshes: Sequence[tuple[Array, Array]]) -> Surfaces:
    """Render depth, bodies and normals; see ``render_depth``."""
    o3d = import_open3d()
    scene = o3d.t.geometry.RaycastingScene()
    body = []
    for index, (vertices, faces) in enumerate(meshes):
        vertices, faces = _validate_mesh(index, vertices, faces)
        if len(faces) == 0:
            continue
        scene.add_triangles(o3d.core.Tensor(vertices), o3d.core.Tensor(faces))
        body.append(index)
    origin, directions = camera.rays()
    size = directions.shape[:2]
    if not body:
        return Surfaces(np.zeros(size, np.float32), np.full(size, -1, np.int32), np.zeros((*size, 3), np.float32))
    has_ray = np.isfinite(directions[..., :1])
    rays = np.concatenate([np.broadcast_to(origin, directions.shape), np.where(has_ray, directions, 1.0)], -1)
    hit = scene.cast_rays(o3d.core.Tensor(np.ascontiguousarray(rays, np.float32)))
    depth, geometry = hit["t_hit"].numpy(), hit["geometry_ids"].numpy()
    seen = np.isfinite(depth) & (depth >= camera.range[0]) & (depth <= camera.range[1]) & has_ray[..., 0]
    ids = np.full(depth.shape, -1, np.int32)
    ids[seen] = np.array(body, np.int32)[geometry[seen]]
    normals = np.where(seen[..., None], hit["primitive_normals"].numpy(), 0)
    return Surfaces(np.where(seen, depth, 0).astype(np.float32), ids, normals)


def _validate_mesh(index: int, vertices: Array, faces: Array) -> tuple[Array, Array]:
    vertices, faces = np.ascontiguousarray(vertices, np.float32), np.ascontiguousarray(faces, np.uint32)
    if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
        raise InvalidInput(
            f"meshes[{index}]", got=f"shapes {vertices.shape} and {faces.shape}", expected="[V, 3] and [F, 3]"
        )
    if not np.isfinite(vertices).all():
        raise InvalidInput(f"meshes[{index}]", got="a vertex that is not finite", expected="finite positions in m")
    if faces.size and int(faces.max()) >= len(vertices):
        raise InvalidInput(f"meshes[{index}]", got=f"vertex index {faces.max()}", expected=f"below {len(vertices)}")
    return vertices, faces


def import_open3d() -> Any:
    """Import open3d, or say how to install it.

    Raises:
        MissingDependency: open3d cannot be imported.
    """
    try:
        return import_module("open3d")  # here, not above: it takes seconds and needs a system library
    except ImportError as error:
        raise MissingDependency(
            "depth cameras and clouds need open3d",
            got=str(error),
            remedy='pip install "torchcloth[observe]"; what is missing of the system is in Debian: apt-get install '
            "libusb-1.0-0 libgl1 libegl1 libx11-6 libudev1 libidn2-0 libgomp1",
        ) from error
