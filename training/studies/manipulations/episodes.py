"""A manipulation as a recording: simulated on one discretisation, seen by a depth camera, given on another."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchcloth import recordings as rec
from torchcloth.errors import SimulationDiverged
from torchcloth.losses import find_closest_points
from torchcloth.observe import DepthCamera, DepthNoise, View, capture, look_at, render_depth, build_solid_mesh
from torchcloth.robots import to_gripper_motion  # pyright: ignore[reportMissingImports] - mapped from robots/
from torchcloth.synthesis.garments import DEFAULT_AREAL_DENSITY_KG_PER_M2
from torchcloth.synthesis.sensors import CAMERA_POSITION_M, CAMERA_TARGET_M
from torchcloth.types import Trajectory

from .scenes import INITIAL_LAYER_DISTANCE_M, Fabric, Manipulation, Scene

SETTLING_TIME_S = 0.6  # s, in which hanging cloth comes to rest before the first frame
MIN_CLOUD_POINTS = 10  # points; a frame with fewer is left out
POLE_SIZE_M = (0.045, 0.02, 1.2)  # m, a box that stands in the camera's way
POLE_POSITION_FRACTION = 0.55  # of the way from the target to the camera


class Seen(NamedTuple):
    """What a fit gets, and what it is judged by."""

    recording: rec.Recording
    x: Tensor  # [T, V, 3] m, the truth at the fit's vertices, at the frames of the points
    hidden: float  # share of the visible cloth that something stands before

    def until(self, share: float) -> Seen:
        """The first ``share`` of the frames."""
        points = self.recording.require("points")
        count = round(share * len(points.t))
        beginning = points.only(np.arange(len(points)) < count)
        return self._replace(recording=replace(self.recording, points=beginning), x=self.x[:count])


def record(truth: Scene, model: Scene, rate: float, points: int) -> Seen:
    """Simulate the true fabric on ``truth``'s discretisation and look at it; the fit will use ``model``'s.

    Raises:
        SimulationDiverged: the cloth ran away.
    """
    what = truth.what
    motion = {name: Trajectory(t, pose.double(), closed) for name, (t, pose, closed) in truth.action.motion.items()}
    end = min(float(path.t[-1]) for path in motion.values())
    t = np.arange(int(end * rate + 1e-6) + 1) / rate
    x = _simulate(truth, motion, t)
    clouds, sigma, hidden = _look(what, x, truth.mesh.faces, points)
    study = [i for i, cloud in enumerate(clouds) if i == 0 or len(cloud) >= MIN_CLOUD_POINTS]
    place = find_closest_points(torch.as_tensor(model.rest), torch.as_tensor(truth.rest), torch.as_tensor(truth.mesh.faces))
    own = place.interpolate(torch.as_tensor(x[study]))
    recording = rec.Recording(
        cloth=rec.ClothInfo(
            areal_density=DEFAULT_AREAL_DENSITY_KG_PER_M2,
            vertices=model.rest,
            faces=model.mesh.faces,
            uv=model.mesh.pattern,
            initial_vertices=own[0].numpy(),
        ),
        provenance=f"synthetic: the fitted engine on {truth.fine.triangles} triangles (same law, other discretisation)",
        grasps={name: rec.GraspInfo(vertices=held) for name, held in model.held.items()},
        colliders={"table": rec.Collider(np.array([0.0, 0.0, INITIAL_LAYER_DISTANCE_M / 2]), np.array([0.0, 0.0, 1.0]))},
        points=rec.PointClouds(
            t[study], np.concatenate([clouds[i] for i in study]), np.array([len(clouds[i]) for i in study])
        ),
        observation_noise_std=sigma,
        grippers={name: to_gripper_motion(path) for name, path in motion.items()},
    )
    return Seen(recording, own, hidden)


@torch.no_grad()
def _simulate(scene: Scene, motion: dict[str, Trajectory], t: np.ndarray) -> np.ndarray:
    """[T, V, 3] m."""
    cloth = scene.cloth(Fabric.true(scene.what.garment))
    dt, state = scene.fine.step * cloth.stable_step(), cloth.rest_state()
    if scene.hangs:
        state = cloth.settle(state, motion, duration=SETTLING_TIME_S)
    x = cloth(state, motion, t.tolist(), dt=dt, checkpoint=False).x.numpy()
    if not float(np.ptp(x, axis=1).max()) < 2 * scene.mesh.extent:
        raise SimulationDiverged(f"{scene.what.name}: the cloth is torn apart", remedy="report this")
    return x


def _look(what: Manipulation, x: np.ndarray, faces: np.ndarray, points: int) -> tuple[list[np.ndarray], float, float]:
    """Clouds [N, 3] m of all frames, the mean deviation of a point's depth [m], and the share that the pole hides."""
    rng = np.random.default_rng([sum(map(ord, what.garment)), what.number])
    camera = DepthCamera.azure_kinect_nfov(look_at(np.array(CAMERA_POSITION_M), np.array(CAMERA_TARGET_M)))
    view = View(camera, DepthNoise(), max_points=points).with_bias(rng)
    pole, clouds, sigma, free = _pole(rng), [], [], []
    for i, frame in enumerate(x):
        cloud = capture(view, frame, faces, [pole], rng=rng).points
        clouds.append(cloud)
        if len(cloud):
            sigma.append(float(DepthNoise().sigma(camera.project(cloud)[1]).mean()))
        if i % 4 == 0:
            open_, shut = (render_depth(camera, [(frame, faces), *more])[1] == 0 for more in ([], [pole]))
            free.append(shut.sum() / max(1, open_.sum()))
    return clouds, float(np.mean(sigma)), float(1 - np.mean(free))


def _pole(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of an upright box between camera and cloth, somewhat to a side."""
    eye, target = np.array(CAMERA_POSITION_M), np.array(CAMERA_TARGET_M)
    toward = np.array([eye[0] - target[0], eye[1] - target[1], 0.0])
    toward /= np.linalg.norm(toward)
    across = np.array([-toward[1], toward[0], 0.0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([across, toward, [0.0, 0.0, 1.0]], axis=1)
    pose[:3, 3] = target + POLE_POSITION_FRACTION * (eye - target) + rng.uniform(-0.05, 0.05) * across
    return build_solid_mesh("box", POLE_SIZE_M, pose)
