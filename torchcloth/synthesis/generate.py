"""Generate a recording from its specification: plan the motion, simulate the cloth, observe it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .._utils.constants import STANDARD_AIR_DENSITY_KG_PER_M3
from ..errors import MissingDependency, SimulationDiverged
from ..observe import build_solid_meshes, capture, encode_depth
from ..observe.render import import_open3d
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
    plan,
    to_gripper_motion,
)
from ..types import Trajectory
from .episode_spec import EpisodeSpec
from .garments import cloth_properties, nominal_properties
from .initial_scene import INITIAL_LAYER_DISTANCE_M, TABLE_FRICTION, InitialScene, build_initial_scene
from .sensors import DEPTH_SCALE_M, build_view

SETTLING_TIME_S = 0.6  # hanging cloth comes to rest in this time before the first frame
MIN_CLOUD_POINTS = 10  # frames with fewer points of cloth are left out of the clouds

Progress = Callable[[str, int, int], None]  # (stage, done, total)


def _ignore_progress(stage: str, done: int, total: int) -> None:
    pass


@dataclass(frozen=True, eq=False)
class SimulatedMotion:
    """A simulated motion before it is observed.

    Attributes:
        t: [T] s.
        x: [T, V, 3] m.
        motion: path of each gripper.
        rig: arms and table.
        plan: of the arms; None if grippers are free.
    """

    t: np.ndarray
    x: np.ndarray
    motion: dict[str, Trajectory]
    rig: Scene
    plan: JointPlan | None


def make_episode(spec: EpisodeSpec, images: Path, on_progress: Progress = _ignore_progress) -> Recording:
    """Generate the recording of a specification, with its truth.

    Args:
        spec: of the episode.
        images: folder for the depth images, to which the recording refers; ``recordings.write`` copies them.
        on_progress: called with (stage, done, total).

    Raises:
        InvalidInput: the arms cannot do the motion; the message names the obstacle.
        SimulationDiverged: the simulation is unstable.
        MissingDependency: open3d or Pillow is not installed.
    """
    import_open3d()  # fail before the simulation, not after it
    start_rng, sensor_rng = (np.random.default_rng([spec.seed, k]) for k in range(2))
    initial = build_initial_scene(spec, start_rng)
    on_progress("planning", 0, 1)
    simulated = plan_and_simulate(spec, initial, on_progress)
    return _build_recording(spec, initial, simulated, images, sensor_rng, on_progress)


def plan_and_simulate(spec: EpisodeSpec, initial: InitialScene, on_progress: Progress) -> SimulatedMotion:
    """Plan the motion and simulate the cloth."""
    rig = bimanual_rig()
    arm_plan = plan(rig, initial.action) if spec.arms else None
    motion = initial.action.motion if arm_plan is None else arm_plan.motion(rig)
    motion = {
        name: Trajectory(t, pose.to(torch.get_default_dtype()), closed) for name, (t, pose, closed) in motion.items()
    }
    duration = min(float(trajectory.t[-1]) for trajectory in motion.values())
    frames = np.arange(int(duration * spec.rate + 1e-6) + 1) / spec.rate
    return SimulatedMotion(frames, simulate(initial, motion, frames, on_progress), motion, rig, arm_plan)


@torch.no_grad()
def simulate(
    initial: InitialScene, motion: dict[str, Trajectory], frames: np.ndarray, on_progress: Progress
) -> np.ndarray:
    """Simulate the cloth and return its vertices [T, V, 3] m at the frames [T] s.

    Raises:
        SimulationDiverged: the cloth extends over twice its size.
    """
    cloth = initial.cloth
    state = cloth.rest_state()
    if initial.hangs:
        state = cloth.settle(state, motion, duration=SETTLING_TIME_S)
    frames_x = [state.x.numpy()]
    for i in range(1, len(frames)):
        state = cloth(state, motion, frames[i - 1 : i + 1].tolist(), checkpoint=False).state
        frames_x.append(state.x.numpy())
        on_progress("simulating", i, len(frames) - 1)
    x = np.stack(frames_x)
    if float(np.ptp(x, axis=1).max()) > 2 * initial.mesh.extent:
        raise SimulationDiverged("the cloth is torn apart", remedy="ask for a slower motion, or report this")
    return x


def _build_recording(
    spec: EpisodeSpec,
    initial: InitialScene,
    simulated: SimulatedMotion,
    images: Path,
    rng: np.random.Generator,
    on_progress: Progress,
) -> Recording:
    camera, points, stds = _observe(spec, initial, simulated, images, rng, on_progress)
    values = cloth_properties(spec.cloth_fabric)
    table_point = np.array([0.0, 0.0, INITIAL_LAYER_DISTANCE_M / 2])
    cloth = ClothInfo(
        areal_density=values["areal_density"],
        thickness=values["thickness"],
        vertices=initial.rest,
        faces=initial.mesh.faces,
        uv=initial.mesh.pattern if initial.mesh.uv is None else initial.mesh.uv,
        initial_vertices=simulated.x[0],
        nominal=nominal_properties(spec.cloth_fabric),
    )
    faces = initial.mesh.faces.astype(np.int32)
    truth = Truth(simulated.t, simulated.x.astype(np.float32), faces, _true_parameters(initial))
    return Recording(
        cloth=cloth,
        provenance=f"synthetic: torchcloth {metadata.version('torchcloth')} simulate, same engine (inverse crime)",
        licence="CC0-1.0",
        grasps={name: GraspInfo(vertices=vertices) for name, vertices in initial.gripped_vertices.items()},
        colliders={"table": Collider(table_point, np.array([0.0, 0.0, 1.0]), TABLE_FRICTION)},
        cameras={"cam0": camera},
        points=points,
        truth=truth,
        observation_noise_std=stds,
        air_density=STANDARD_AIR_DENSITY_KG_PER_M3,
        split={"motion": spec.motion, "replicate_of": None},
        grippers={} if simulated.plan else {name: to_gripper_motion(path) for name, path in simulated.motion.items()},
        joints=simulated.plan.joint_motions() if simulated.plan else {},
        robots=simulated.rig.robot_infos() if simulated.plan else {},
        extra={"order": spec.as_dict(), **_plan_facts(simulated)},
    )


def _observe(
    spec: EpisodeSpec,
    initial: InitialScene,
    simulated: SimulatedMotion,
    images: Path,
    rng: np.random.Generator,
    on_progress: Progress,
) -> tuple[Camera, PointClouds, float]:
    """Return the camera with its depth images, the cloth's points, and their mean standard deviation of depth [m]."""
    view = build_view(spec, rng)
    occluders_at = _occluders(simulated)
    clouds, times, stds, paths = [], [], [], []
    for i, t in enumerate(simulated.t):
        captured = capture(view, simulated.x[i], initial.mesh.faces, occluders_at(i), rng=rng)
        paths.append(_save(encode_depth(captured.depth, DEPTH_SCALE_M), images / f"{i:06d}.png"))
        if len(captured.points) >= MIN_CLOUD_POINTS or i == 0:  # the first frame gives the initial shape
            times.append(t)
            clouds.append(captured.points)
            if view.noise is not None:
                stds.append(float(view.noise.sigma(view.camera.project(captured.points)[1]).mean()))
        on_progress("observing", i + 1, len(simulated.t))
    size = (view.camera.width, view.camera.height)
    stream = ImageStream("depth", np.arange(len(simulated.t)), simulated.t, tuple(paths), size)
    camera = Camera(**view.camera.to_calibration(), depth_scale=DEPTH_SCALE_M, depth=stream)
    points = PointClouds(np.array(times), np.concatenate(clouds), np.array([len(cloud) for cloud in clouds]))
    return camera, points, round(float(np.mean(stds)), 6)


def _occluders(simulated: SimulatedMotion) -> Callable[[int], Sequence[Any]]:
    """Return a function that gives the meshes of table and arms at a frame."""
    table = [] if simulated.rig.table is None else build_solid_meshes([simulated.rig.table.primitive()])
    if simulated.plan is None:
        return lambda i: table
    knots = simulated.plan.t.numpy()
    joints = {
        name: np.stack([np.interp(simulated.t, knots, column) for column in q.T.numpy()], -1)
        for name, q in simulated.plan.q.items()
    }
    solids = simulated.rig.geometry({name: torch.as_tensor(q).to(simulated.plan.q[name]) for name, q in joints.items()})
    return lambda i: [*table, *build_solid_meshes(solids, i)]


def _true_parameters(initial: InitialScene) -> dict[str, np.ndarray]:
    """Return the true parameters in SI units, for scoring."""
    values: dict[str, Tensor] = dict(initial.cloth.named_parameters())
    for name, module in initial.cloth.named_modules():
        if isinstance(module, PhysicalParameter):
            del values[f"{name}.raw"]
            values[name] = module.value
    return {f"parameter/{name}": value.detach().numpy() for name, value in values.items()}


def _plan_facts(simulated: SimulatedMotion) -> dict[str, Any]:
    """Return how the arms' limits changed the motion."""
    if simulated.plan is None:
        return {}
    gap = simulated.plan.smallest_gap
    return {
        "plan": {
            "slower": simulated.plan.slowdown,
            "limiting": simulated.plan.limiting_joint,
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
