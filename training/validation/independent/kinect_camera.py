"""Point clouds of a simulated Azure Kinect, with the arms as occluders."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch

from torchcloth import observe
from torchcloth.recordings import PointClouds
from torchcloth.robots import Scene  # pyright: ignore[reportMissingImports] - mapped from robots/

Array = np.ndarray
Mesh = tuple[Array, Array]
RECTIFIED_INTRINSICS_PX = np.array([[503.8, 0.0, 321.5], [0.0, 503.8, 329.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class CameraPlacement:
    """Pose of the camera, and how its images become points.

    Attributes:
        target: [3] m, the point at which it looks.
        distance: m, from the target.
        azimuth: rad, sideways off the normal of the hanging cloth (+x).
        elevation: rad, upwards off that normal.
        noise: of the depth.
        eroded_pixels: width of the rim that is taken off the cloth's mask.
        max_points: per frame.
    """

    target: tuple[float, float, float] = (0.50, 0.0, 0.32)
    distance: float = 1.2
    azimuth: float = np.deg2rad(28.0)
    elevation: float = np.deg2rad(12.0)
    noise: observe.DepthNoise = field(default_factory=observe.DepthNoise)
    eroded_pixels: int = 2
    max_points: int = 250

    def make_camera(self) -> observe.DepthCamera:
        """Return the camera in its place, with a rectified image."""
        flat = np.cos(self.elevation)
        away = [flat * np.cos(self.azimuth), flat * np.sin(self.azimuth), np.sin(self.elevation)]
        eye = np.asarray(self.target) + self.distance * np.array(away)
        pose = observe.look_at(eye, np.asarray(self.target))
        return observe.DepthCamera(640, 576, RECTIFIED_INTRINSICS_PX, pose, (0.5, 3.86))

    def make_view(self) -> observe.View:
        """Return the camera with its noise and its processing."""
        return observe.View(self.make_camera(), self.noise, self.eroded_pixels, self.max_points)


def arm_mesh_function(rig: Scene, q: dict[str, Array]) -> Callable[[int], list[Mesh]]:
    """Return a function that gives the arms' meshes at knot k of the joint positions [K, 7] rad, by arm."""
    solids = rig.geometry({name: torch.as_tensor(value) for name, value in q.items()})
    return lambda k: observe.build_solid_meshes(solids, at=k)


def observe_cloth(
    view: observe.View,
    t: Array,
    x: Array,
    faces: Array,
    occluders: Callable[[int], list[Mesh]],
    rng: np.random.Generator,
) -> tuple[PointClouds, float, Array]:
    """Return the points of the cloth in every frame.

    Args:
        view: camera and processing.
        t: [T] s, times of the frames.
        x: [T, V, 3] m, the true cloth at the frames.
        faces: [F, 3].
        occluders: returns the meshes at frame i.
        rng: source of all noise.

    Returns:
        The points, the standard deviation of their depth (mean over all points) [m], and the visible fraction [T]: the
        mask's pixels over those of the cloth without occluders.
    """
    clouds, sigma, visible_fraction = [], [], []
    for i in range(len(t)):
        capture = observe.capture(view, x[i], faces, occluders(i), rng=rng)
        unoccluded, _ = observe.render_depth(view.camera, [(x[i], faces)])
        clouds.append(capture.points)
        depth = view.camera.project(capture.points)[1]
        sigma.append(0.0 if view.noise is None else view.noise.sigma(depth).mean())
        visible_fraction.append((capture.mask & (capture.depth > 0)).sum() / (unoccluded > 0).sum())
    counts = np.array([len(cloud) for cloud in clouds])
    return PointClouds(np.asarray(t), np.concatenate(clouds), counts), float(np.mean(sigma)), np.array(visible_fraction)
