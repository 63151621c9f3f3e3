"""Recording of a manipulation: simulated on one discretisation, observed by a depth camera, given on another."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchcloth import recordings as rec
from torchcloth.errors import SimulationDiverged
from torchcloth.losses import find_closest_points
from torchcloth.observe import DepthCamera, DepthNoise, View, build_solid_mesh, capture, look_at, render_depth
from torchcloth.robots import to_gripper_motion  # pyright: ignore[reportMissingImports] - mapped from robots/
from torchcloth.synthesis.garments import DEFAULT_AREAL_DENSITY_KG_PER_M2
from torchcloth.synthesis.generate import MIN_CLOUD_POINTS, SETTLING_TIME_S
from torchcloth.synthesis.sensors import CAMERA_POSITION_M, CAMERA_TARGET_M
from torchcloth.types import Trajectory

from .scenes import INITIAL_LAYER_DISTANCE_M, Fabric, Manipulation, Scene

POLE_SIZE_M = (0.045, 0.02, 1.2)  # a box that occludes the camera's view
POLE_POSITION_FRACTION = 0.55  # of the way from the target to the camera


class Observation(NamedTuple):
    """Data of a fit, and the truth for its assessment.

    Attributes:
        recording: data.
        x: [T, V, 3] m, the truth at the fit's vertices and at the frames of the points.
        hidden: fraction of the visible cloth that is occluded.
    """

    recording: rec.Recording
    x: Tensor
    hidden: float

    def until(self, share: float) -> Observation:
        """Return the first frames, a fraction ``share`` of all."""
        points = self.recording.require("points")
        count = round(share * len(points.t))
        beginning = points.select(np.arange(len(points)) < count)
        return self._replace(recording=replace(self.recording, points=beginning), x=self.x[:count])


def record(truth: Scene, model: Scene, rate: float, points: int) -> Observation:
    """Simulate and observe the true fabric on the truth's discretisation, for a fit on the model's.

    Raises:
        SimulationDiverged: the simulation is unstable.
    """
    what = truth.what
    motion = {name: Trajectory(t, pose.double(), closed) for name, (t, pose, closed) in truth.action.motion.items()}
    end = min(float(path.t[-1]) for path in motion.values())
    t = np.arange(int(end * rate + 1e-6) + 1) / rate
    x = _simulate(truth, motion, t)
    clouds, stds, hidden = _look(what, x, truth.mesh.faces, points)
    kept_frames = [i for i, cloud in enumerate(clouds) if i == 0 or len(cloud) >= MIN_CLOUD_POINTS]
    place = find_closest_points(
        torch.as_tensor(model.rest), torch.as_tensor(truth.rest), torch.as_tensor(truth.mesh.faces)
    )
    true_positions = place.interpolate(torch.as_tensor(x[kept_frames]))
    recording = rec.Recording(
        cloth=rec.ClothInfo(
            areal_density=DEFAULT_AREAL_DENSITY_KG_PER_M2,
            vertices=model.rest,
            faces=model.mesh.faces,
            uv=model.mesh.pattern,
            initial_vertices=true_positions[0].numpy(),
        ),
        provenance=f"synthetic: the fitted engine on {truth.fine.triangles} triangles (same law, other discretisation)",
        grasps={name: rec.GraspInfo(vertices=vertices) for name, vertices in model.gripped_vertices.items()},
        colliders={
            "table": rec.Collider(np.array([0.0, 0.0, INITIAL_LAYER_DISTANCE_M / 2]), np.array([0.0, 0.0, 1.0]))
        },
        points=rec.PointClouds(
            t[kept_frames],
            np.concatenate([clouds[i] for i in kept_frames]),
            np.array([len(clouds[i]) for i in kept_frames]),
        ),
        observation_noise_std=stds,
        grippers={name: to_gripper_motion(path) for name, path in motion.items()},
    )
    return Observation(recording, true_positions, hidden)


@torch.no_grad()
def _simulate(scene: Scene, motion: dict[str, Trajectory], t: np.ndarray) -> np.ndarray:
    """Return the true vertices [T, V, 3] m."""
    cloth = scene.cloth(Fabric.true(scene.what.garment))
    dt, state = scene.fine.step * cloth.stable_step(), cloth.rest_state()
    if scene.hangs:
        state = cloth.settle(state, motion, duration=SETTLING_TIME_S)
    x = cloth(state, motion, t.tolist(), dt=dt, checkpoint=False).x.numpy()
    if not float(np.ptp(x, axis=1).max()) < 2 * scene.mesh.extent:
        raise SimulationDiverged(f"{scene.what.name}: the cloth is torn apart", remedy="report this")
    return x


def _look(what: Manipulation, x: np.ndarray, faces: np.ndarray, points: int) -> tuple[list[np.ndarray], float, float]:
    """Return clouds [N, 3] m of all frames, the mean standard deviation of depth [m], and the hidden fraction."""
    rng = np.random.default_rng([sum(map(ord, what.garment)), what.number])
    camera = DepthCamera.azure_kinect_nfov(look_at(np.array(CAMERA_POSITION_M), np.array(CAMERA_TARGET_M)))
    view = View(camera, DepthNoise(), max_points=points).with_bias(rng)
    pole, clouds, stds, free = _pole(rng), [], [], []
    for i, frame in enumerate(x):
        cloud = capture(view, frame, faces, [pole], rng=rng).points
        clouds.append(cloud)
        if len(cloud):
            stds.append(float(DepthNoise().sigma(camera.project(cloud)[1]).mean()))
        if i % 4 == 0:
            open_, shut = (render_depth(camera, [(frame, faces), *more])[1] == 0 for more in ([], [pole]))
            free.append(shut.sum() / max(1, open_.sum()))
    return clouds, float(np.mean(stds)), float(1 - np.mean(free))


def _pole(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and triangles of an upright box between camera and cloth, slightly to a side."""
    eye, target = np.array(CAMERA_POSITION_M), np.array(CAMERA_TARGET_M)
    toward = np.array([eye[0] - target[0], eye[1] - target[1], 0.0])
    toward /= np.linalg.norm(toward)
    across = np.array([-toward[1], toward[0], 0.0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([across, toward, [0.0, 0.0, 1.0]], axis=1)
    pose[:3, 3] = target + POLE_POSITION_FRACTION * (eye - target) + rng.uniform(-0.05, 0.05) * across
    return build_solid_mesh("box", POLE_SIZE_M, pose)
