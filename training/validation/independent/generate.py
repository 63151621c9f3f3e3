"""Generate a synthetic recording of cloth that the independent engine simulates, with any hidden effects.

    P=torchcloth.training.validation.independent
    python -m $P.generate --motion swing --effect air.drag_n=1.2 --seed 3 --out episodes/a

The episode goes into the folder of --out. The hidden effects go into another file (--hidden): nothing in the episode
names them. ``--list`` shows motions and effects.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from torchcloth import recordings
from torchcloth.errors import InvalidInput, TorchclothError

from .effects import CATALOGUE, add_effect, parse_effect
from .first_frame import measured_mesh
from .flex_sheet import sheet_mesh
from .motions import MOTION_NAMES, Motion, make_motion
from .mujoco_cloth import Result, mujoco_version
from .scene import Scene, recorded_poses, simulate
from .sensor import pinhole_camera, sample_points

Array = np.ndarray
INITIAL_ERROR_RMS_M = 1e-3  # of the first positions, along the cloth's normal
WRENCH_NOISE_STD = {"force": 0.02, "torque": 0.002}  # N, N m


def make_recording(
    scene: Scene,
    motion: Motion,
    result: Result,
    name: str,
    seed: int | Sequence[int],
    nodes: int,
    exact: bool = False,
    data_sheet_scene: Scene | None = None,
) -> recordings.Recording:
    """Return the recording of a simulated motion.

    Args:
        scene: the true scene.
        motion: the commanded motion.
        result: the simulated motion.
        name: of the motion, for the split.
        seed: of all noise.
        nodes: vertices along each side of the mesh that a fit uses.
        exact: without any noise: points on the surface, exact first positions and forces.
        data_sheet_scene: its values are recorded as those of the data sheet, the grasps and the table; None: those of
            the effect-free fabric.
    """
    scene = scene.aligned_to_patches  # the result's vertices are its vertices
    points_rng, shape_rng, wrench_rng = (np.random.default_rng([*np.atleast_1d(seed), k]) for k in range(3))
    nominal, sensor = data_sheet_scene or Scene(), replace(scene.sensor, noise=0.0) if exact else scene.sensor
    noise = {key: 0.0 if exact else std for key, std in WRENCH_NOISE_STD.items()}
    radius = nominal.grip.radius
    grasps = {key: recordings.GraspInfo(np.array([uv]), radius) for key, uv in motion.grasp_points.items()}
    table = recordings.Collider(np.zeros(3), np.array([0.0, 0.0, 1.0]), nominal.table.friction)
    faces, size = sheet_mesh(scene.sheet)[1].astype(np.int32), {"nodes": np.array(scene.sheet.nodes)}
    return recordings.Recording(
        cloth=_cloth_info(scene, nominal, motion, result.x[0], nodes, 0.0 if exact else INITIAL_ERROR_RMS_M, shape_rng),
        provenance=f"synthetic: MuJoCo flex {mujoco_version()}, validation.independent.generate",
        licence="CC0-1.0",
        grasps=grasps,
        grippers={key: _gripper_motion(scene, motion, result, key, noise, wrench_rng) for key in motion.pose},
        cameras={"cam0": recordings.Camera(**pinhole_camera(scene.sensor))},
        colliders={"table": table} if motion.on_table else {},
        points=sample_points(sensor, scene.sheet, motion.t, result.x, points_rng),
        truth=recordings.Truth(motion.t[::2], result.x[::2].astype(np.float32), faces, size),
        observation_noise_std=nominal.sensor.noise,
        gravity=np.array([0.0, 0.0, nominal.sheet.gravity]),
        split={"motion": name, "replicate_of": None},
    )


def _cloth_info(
    scene: Scene, nominal: Scene, motion: Motion, x: Array, nodes: int, error: float, rng: np.random.Generator
) -> recordings.ClothInfo:
    """Return nominal values, and the measured first positions."""
    points = list(motion.grasp_points.values())
    uv, faces, start = measured_mesh(scene.sheet, x, nodes, error, points, nominal.grip.radius, rng)
    if motion.on_table:
        start[:, 2] = np.maximum(start[:, 2], 0.0)
    poses = np.tile(np.eye(4), (len(start), 1, 1))
    poses[:, :3, 3] = start
    return recordings.ClothInfo(
        areal_density=nominal.sheet.areal_density,
        areal_density_std=0.02 * nominal.sheet.areal_density,
        thickness=1e-3,
        initial_vertices=recorded_poses(scene.grip, poses)[:, :3, 3],  # the robot says where the measured shape is
        vertices=np.column_stack([uv, np.zeros(len(uv))]),
        faces=faces,
        uv=uv,
        nominal=data_sheet_values(nominal),
    )


def data_sheet_values(nominal: Scene) -> dict[str, object]:
    """Return the nominal values of a scene's fabric: a start for fits."""
    sheet, plate = nominal.sheet, nominal.plate
    return {
        "membrane_stiffness": sheet.membrane_stiffness,
        "poisson_ratio": sheet.poisson_ratio,
        "bending_stiffness": plate.stiffness,
        "bending_damping_time": plate.damping_time,
    }


def _gripper_motion(
    scene: Scene, motion: Motion, result: Result, name: str, noise: dict[str, float], rng: np.random.Generator
) -> recordings.GripperMotion:
    pose = recorded_poses(scene.grip, motion.pose[name])
    quat = Rotation.from_matrix(pose[:, :3, :3]).as_quat(scalar_first=True)
    wrench = {
        key: getattr(result, key)[name] + std * rng.standard_normal((len(motion.t), 3)) for key, std in noise.items()
    }
    return recordings.GripperMotion(motion.t, pose[:, :3, 3], quat, np.ones(len(motion.t), bool), **wrench)


def _print_catalogue() -> None:
    print("motions: " + ", ".join(MOTION_NAMES))
    for name, effect in CATALOGUE.items():
        options = f"  [{', '.join(effect.options)}]" if effect.options else ""
        print(f"{name:20s} {effect.typical:8.3g} {effect.unit:8s} visible in {effect.motion}{options}")


def main(arguments: list[str] | None = None) -> int:
    """Run the command line and return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--list", action="store_true", help="motions and effects with typical amplitudes")
    parser.add_argument("--motion", default="swing", metavar="NAME", help=", ".join(MOTION_NAMES))
    parser.add_argument("--heading", type=float, default=0.0, metavar="DEGREES", help="about the vertical")
    parser.add_argument("--speed", type=float, default=1.0, metavar="FACTOR", help="2: in half the time")
    parser.add_argument("--effect", action="append", default=[], metavar="NAME=VALUE[,OPTION=VALUE...]")
    parser.add_argument("--nodes", type=int, default=25, help="vertices along each side of the truth's mesh (25)")
    parser.add_argument("--fit-nodes", type=int, default=17, help="vertices along each side of cloth.obj (17)")
    parser.add_argument("--step", type=float, metavar="SECONDS", help="time step (default: the stable one)")
    parser.add_argument("--exact", action="store_true", help="without noise")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder of the episode")
    parser.add_argument(
        "--hidden", type=Path, metavar="FILE", help="file for the hidden effects (default DIR.hidden.json)"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace DIR")
    options = parser.parse_args(arguments)
    if options.list:
        _print_catalogue()
        return 0
    if options.out is None:
        parser.error("--out is needed")
    try:
        return _generate(options)
    except TorchclothError as error:
        print(error, file=sys.stderr)
        return 2


def _generate(options: argparse.Namespace) -> int:
    if options.out.exists() and not options.overwrite:  # refused before the work is done
        raise InvalidInput("--out", got=f"{options.out}, which exists", expected="a new name", remedy="or --overwrite")
    start = time.perf_counter()
    scene, hidden = Scene(), [parse_effect(text) for text in options.effect]
    scene = replace(scene, sheet=replace(scene.sheet, nodes=(options.nodes, options.nodes)))
    for name, amplitude, effect_options in hidden:
        scene = add_effect(scene, name, amplitude, effect_options)
    motion = make_motion(options.motion, scene.sheet, options.heading, options.speed)
    result = simulate(scene, motion, options.step)
    recording = make_recording(scene, motion, result, options.motion, options.seed, options.fit_nodes, options.exact)
    path = recordings.write(recording, options.out, overwrite=options.overwrite)
    hidden_path = options.hidden or path.with_name(f"{path.name}.hidden.json")
    effects = [{"effect": name, "amplitude": value, **effect_options} for name, value, effect_options in hidden]
    facts = {"seed": options.seed, "motion": options.motion, "heading": options.heading, "speed": options.speed}
    text = json.dumps({**facts, "effects": effects, "scene": asdict(scene)}, indent=1)
    hidden_path.write_text(text + "\n", encoding="utf-8")
    print(f"{path}: {motion.t[-1]:.2f} s of cloth in {time.perf_counter() - start:.0f} s; hidden: {hidden_path}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
