"""One order to one recording: plan, simulate, look."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..errors import MissingDependency, SimulationDiverged
from ..observe import capture, encode, solid_meshes
from ..observe.render import open3d_or_refuse
from ..parameters import PhysicalParameter
from ..recordings import (
    Camera,
    ClothInfo,
    Collider,
    GraspInfo,
    ImageStream,
    PointClouds,
    Recording,
    Truth,
)
from ..robots import (  # pyright: ignore[reportMissingImports] - mapped from robots/ at installation
    JointPlan,
    Scene,
    bimanual_rig,
    to_gripper_motion,
    plan,
)
from ..types import Trajectory
from .episode_spec import Order
from .garments import data_sheet, numbers
from .initial_scene import FRICTION, LAYERS, Staged, stage
from .sensors import DEPTH_SCALE, view

SETTLING = 0.6  # s, in which hanging cloth comes to rest before the first frame
AIR = 1.204  # kg/m^3
THINNEST = 10  # points of cloth in a frame; with fewer the frame is left out of the points

Progress = Callable[[str, int, int], None]  # (stage, done, of)


@dataclass(frozen=True, eq=False)
class Performance:
    """What happened, before anything looked at it."""

    t: np.ndarray  # [T] s
    x: np.ndarray  # [T, V, 3] m
    motion: dict[str, Trajectory]
    scene: Scene
    plan: JointPlan | None


def make(order: Order, images: Path, on_progress: Progress = lambda stage, done, of: None) -> Recording:
    """The recording of an order, truth included.

    Args:
        order: what is asked for.
        images: a folder for the depth images, which the recording names; ``recordings.write`` copies them.
        on_progress: called with what is being done, how much of it is done, and of how much.

    Raises:
        InvalidInput: the arms cannot do the motion; what is in the way is named.
        SimulationDiverged: the cloth ran away.
        MissingDependency: open3d or Pillow is not installed.
    """
    open3d_or_refuse()  # before the simulation, and not after it
    start, seen = (np.random.default_rng([order.seed, k]) for k in range(2))
    staged = stage(order, start)
    on_progress("planning", 0, 1)
    performance = perform(order, staged, on_progress)
    return _recorded(order, staged, performance, images, seen, on_progress)


def perform(order: Order, staged: Staged, on_progress: Progress) -> Performance:
    """Plans the motion and simulates the cloth."""
    scene = bimanual_rig()
    found = plan(scene, staged.action) if order.arms else None
    motion = staged.action.motion if found is None else found.motion(scene)
    motion = {
        name: Trajectory(t, pose.to(torch.get_default_dtype()), closed) for name, (t, pose, closed) in motion.items()
    }
    duration = min(float(trajectory.t[-1]) for trajectory in motion.values())
    frames = np.arange(int(duration * order.rate + 1e-6) + 1) / order.rate
    return Performance(frames, simulate(staged, motion, frames, on_progress), motion, scene, found)


@torch.no_grad()
def simulate(staged: Staged, motion: dict[str, Trajectory], frames: np.ndarray, on_progress: Progress) -> np.ndarray:
    """Vertices [T, V, 3] m at the frames [T] s.

    Raises:
        SimulationDiverged: the cloth is longer than it can be.
    """
    cloth = staged.cloth
    state = cloth.rest_state()
    if staged.hangs:
        state = cloth.settle(state, motion, duration=SETTLING)
    kept = [state.x.numpy()]
    for i in range(1, len(frames)):
        state = cloth(state, motion, frames[i - 1 : i + 1].tolist(), checkpoint=False).state
        kept.append(state.x.numpy())
        on_progress("simulating", i, len(frames) - 1)
    x = np.stack(kept)
    if float(np.ptp(x, axis=1).max()) > 2 * staged.mesh.extent:
        raise SimulationDiverged("the cloth is torn apart", remedy="ask for a slower motion, or report this")
    return x


def _recorded(
    order: Order, staged: Staged, done: Performance, images: Path, rng: np.random.Generator, on_progress: Progress
) -> Recording:
    camera, points, sigma = _observe(order, staged, done, images, rng, on_progress)
    values = numbers(order.cloth_fabric)
    cloth = ClothInfo(
        areal_density=values["areal_density"],
        thickness=values["thickness"],
        vertices=staged.rest,
        faces=staged.mesh.faces,
        uv=staged.mesh.pattern if staged.mesh.uv is None else staged.mesh.uv,
        initial_vertices=done.x[0],
        nominal=data_sheet(order.cloth_fabric),
    )
    truth = Truth(done.t, done.x.astype(np.float32), staged.mesh.faces.astype(np.int32), _parameters(staged))
    return Recording(
        cloth=cloth,
        provenance=f"synthetic: torchcloth {metadata.version('torchcloth')} simulate, same engine (inverse crime)",
        licence="CC0-1.0",
        grasps={name: GraspInfo(vertices=held) for name, held in staged.held.items()},
        colliders={"table": Collider(np.array([0.0, 0.0, LAYERS / 2]), np.array([0.0, 0.0, 1.0]), FRICTION)},
        cameras={"cam0": camera},
        points=points,
        truth=truth,
        observation_noise_std=sigma,
        air_density=AIR,
        split={"motion": order.motion, "replicate_of": None},
        grippers={} if done.plan else {name: to_gripper_motion(path) for name, path in done.motion.items()},
        joints=done.plan.joint_motions() if done.plan else {},
        robots=done.scene.robot_infos() if done.plan else {},
        extra={"order": order.facts(), **_planned(done)},
    )


def _observe(
    order: Order, staged: Staged, done: Performance, images: Path, rng: np.random.Generator, on_progress: Progress
) -> tuple[Camera, PointClouds, float]:
    """The camera with its depth images, the cloth's points, and their depth's mean standard deviation [m]."""
    look = view(order, rng)
    hidden = _occluders(done)
    clouds, times, sigma, paths = [], [], [], []
    for i, t in enumerate(done.t):
        shot = capture(look, done.x[i], staged.mesh.faces, hidden(i), rng=rng)
        paths.append(_save(encode(shot.depth, DEPTH_SCALE), images / f"{i:06d}.png"))
        if len(shot.points) >= THINNEST or i == 0:  # the first shape is that of the first frame
            times.append(t)
            clouds.append(shot.points)
            if look.noise is not None:
                sigma.append(float(look.noise.sigma(look.camera.project(shot.points)[1]).mean()))
        on_progress("looking", i + 1, len(done.t))
    size = (look.camera.width, look.camera.height)
    stream = ImageStream("depth", np.arange(len(done.t)), done.t, tuple(paths), size)
    camera = Camera(**look.camera.calibration(), depth_scale=DEPTH_SCALE, depth=stream)
    points = PointClouds(np.array(times), np.concatenate(clouds), np.array([len(cloud) for cloud in clouds]))
    return camera, points, round(float(np.mean(sigma)), 6)


def _occluders(done: Performance) -> Callable[[int], Sequence[Any]]:
    """Meshes of table and arms at frame i."""
    table = [] if done.scene.table is None else solid_meshes([done.scene.table.primitive()])
    if done.plan is None:
        return lambda i: table
    knots = done.plan.t.numpy()
    joints = {
        name: np.stack([np.interp(done.t, knots, own) for own in q.T.numpy()], -1) for name, q in done.plan.q.items()
    }
    solids = done.scene.geometry({name: torch.as_tensor(q).to(done.plan.q[name]) for name, q in joints.items()})
    return lambda i: [*table, *solid_meshes(solids, i)]


def _parameters(staged: Staged) -> dict[str, np.ndarray]:
    """The true parameters in SI units, for scoring."""
    values: dict[str, Tensor] = dict(staged.cloth.named_parameters())
    for name, module in staged.cloth.named_modules():
        if isinstance(module, PhysicalParameter):
            del values[f"{name}.raw"]
            values[name] = module.value
    return {f"parameter/{name}": value.detach().numpy() for name, value in values.items()}


def _planned(done: Performance) -> dict[str, Any]:
    """What the arms' limits made of the motion."""
    if done.plan is None:
        return {}
    gap = done.plan.smallest_gap
    return {
        "plan": {
            "slower": done.plan.slowdown,
            "limiting": done.plan.limiting_joint,
            "nearest": {"distance": gap.distance, "solids": [gap.first, gap.second], "time": gap.time},
        }
    }


def _save(image: np.ndarray, path: Path) -> Path:
    try:
        from PIL import Image
    except ImportError as error:
        raise MissingDependency("depth images need Pillow", remedy='pip install "torchcloth[data]"') from error
    Image.fromarray(image).save(path)
    return path
