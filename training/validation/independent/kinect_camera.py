"""What a simulated Azure Kinect sees of the cloth, with the arms in its way."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch

from torchcloth import observe
from torchcloth.recordings import PointClouds
from torchcloth.robots import Scene

Array = np.ndarray
Mesh = tuple[Array, Array]
K = np.array([[503.8, 0.0, 321.5], [0.0, 503.8, 329.0], [0.0, 0.0, 1.0]])  # of the rectified image


@dataclass(frozen=True)
class Place:
    """The camera's place and how its images become points.

    Attributes:
        target: [3] m, where it looks.
        distance: m, from there.
        azimuth, elevation: rad, off the normal of the hanging cloth (+x): sideways, upwards.
        noise: of the depth.
        rim: px, taken off the cloth's mask.
        points: per frame at most.
    """

    target: tuple[float, float, float] = (0.50, 0.0, 0.32)
    distance: float = 1.2
    azimuth: float = np.deg2rad(28.0)
    elevation: float = np.deg2rad(12.0)
    noise: observe.DepthNoise = field(default_factory=observe.DepthNoise)
    rim: int = 2
    points: int = 250

    def camera(self) -> observe.DepthCamera:
        """The camera in its place, its image rectified."""
        flat = np.cos(self.elevation)
        away = [flat * np.cos(self.azimuth), flat * np.sin(self.azimuth), np.sin(self.elevation)]
        eye = np.asarray(self.target) + self.distance * np.array(away)
        return observe.DepthCamera(640, 576, K, observe.look_at(eye, self.target), (0.5, 3.86))

    def view(self) -> observe.View:
        """The camera with its noise."""
        return observe.View(self.camera(), self.noise, self.rim, self.points)


def arm_meshes(rig: Scene, q: dict[str, Array]) -> Callable[[int], list[Mesh]]:
    """The arms' solids at knot k of the joint positions [K, 7], by arm."""
    solids = rig.geometry({name: torch.as_tensor(value) for name, value in q.items()})
    return lambda k: observe.solid_meshes(solids, at=k)


def observe_cloth(
    view: observe.View,
    t: Array,
    x: Array,
    faces: Array,
    occluders: Callable[[int], list[Mesh]],
    rng: np.random.Generator,
) -> tuple[PointClouds, float, Array]:
    """Points of the cloth in every frame.

    Args:
        view: camera and processing.
        t, x: [T] s and [T, V, 3] m, the true cloth at the frames.
        faces: [F, 3].
        occluders: meshes at frame i.
        rng: source of all noise.

    Returns:
        The points, the standard deviation of their depth in m (mean over all points), and per frame the share [T] of
        the unhidden cloth's pixels that were kept by the mask.
    """
    clouds, sigma, share = [], [], []
    for i in range(len(t)):
        seen = observe.capture(view, x[i], faces, occluders(i), rng=rng)
        alone, _ = observe.render_depth(view.camera, [(x[i], faces)])
        clouds.append(seen.points)
        sigma.append(view.noise.sigma(view.camera.project(seen.points)[1]).mean())
        share.append((seen.mask & (seen.depth > 0)).sum() / (alone > 0).sum())
    counts = np.array([len(cloud) for cloud in clouds])
    return PointClouds(np.asarray(t), np.concatenate(clouds), counts), float(np.mean(sigma)), np.array(share)
