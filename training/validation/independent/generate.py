"""Makes a synthetic recording of another engine's cloth, with any hidden effects.

    python -m torchcloth.training.validation.independent.generate --motion swing --effect air.drag_n=1.2 --seed 3 --out episodes/a

The episode goes into the folder of --out. What was hidden goes into a file beside it (--hidden), which whoever tests a
fit or a diagnosis keeps to himself: nothing in the episode names it. ``--list`` shows motions and effects.
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

from .effects import CATALOGUE, hide, parse
from .first_frame import measured_mesh
from .flex_sheet import grid
from .motions import NAMES, Motion, motion
from .mujoco_cloth import Result, mujoco_version
from .scene import Scene, believed, simulate
from .sensor import pinhole, see

Array = np.ndarray
INITIAL_ERROR = 1e-3  # m, of the first positions, along the cloth's normal
FORCE_NOISE, TORQUE_NOISE = 0.02, 0.002  # N, N m


def record(
    scene: Scene,
    moved: Motion,
    result: Result,
    name: str,
    seed: int | Sequence[int],
    nodes: int,
    exact: bool = False,
    said: Scene | None = None,
) -> recordings.Recording:
    """The recording of a simulated motion.

    Args:
        scene, moved, result: what happened.
        name: the motion's, for the split.
        seed: of all noise.
        nodes: vertices along each side of the mesh that a fit uses.
        exact: no noise at all: points on the surface, first positions and forces as they are.
        said: whose values the data sheet, grasps and table are said to have; None: the effect-free fabric's.
    """
    scene = scene.gripped  # whose vertices the positions are of
    seen, first, touch = (np.random.default_rng([*np.atleast_1d(seed), k]) for k in range(3))
    nominal, sensor = said or Scene(), replace(scene.sensor, noise=0.0) if exact else scene.sensor
    noise = {key: 0.0 if exact else value for key, value in (("force", FORCE_NOISE), ("torque", TORQUE_NOISE))}
    grasps = {key: recordings.GraspInfo(np.array([uv]), nominal.grip.radius) for key, uv in moved.held.items()}
    table = recordings.Collider(np.zeros(3), np.array([0.0, 0.0, 1.0]), nominal.table.friction)
    faces, size = grid(scene.sheet)[1].astype(np.int32), {"nodes": np.array(scene.sheet.nodes)}
    return recordings.Recording(
        cloth=_cloth(scene, nominal, moved, result.x[0], nodes, 0.0 if exact else INITIAL_ERROR, first),
        provenance=f"synthetic: MuJoCo flex {mujoco_version()}, validation.independent.generate",
        licence="CC0-1.0",
        grasps=grasps,
        grippers={key: _gripper(scene, moved, result, key, noise, touch) for key in moved.pose},
        cameras={"cam0": recordings.Camera(**pinhole(scene.sensor))},
        colliders={"table": table} if moved.table else {},
        points=see(sensor, scene.sheet, moved.t, result.x, seen),
        truth=recordings.Truth(moved.t[::2], result.x[::2].astype(np.float32), faces, size),
        observation_noise_std=nominal.sensor.noise,
        gravity=np.array([0.0, 0.0, nominal.sheet.gravity]),
        split={"motion": name, "replicate_of": None},
    )


def _cloth(
    scene: Scene, nominal: Scene, moved: Motion, x: Array, nodes: int, error: float, rng: np.random.Generator
) -> recordings.ClothInfo:
    """What is said of the cloth: nominal values, and where it was seen to be at first."""
    held = list(moved.held.values())
    uv, faces, start = measured_mesh(scene.sheet, x, nodes, error, held, nominal.grip.radius, rng)
    if moved.table:
        start[:, 2] = np.maximum(start[:, 2], 0.0)
    placed = np.tile(np.eye(4), (len(start), 1, 1))
    placed[:, :3, 3] = start
    return recordings.ClothInfo(
        areal_density=nominal.sheet.areal_density,
        areal_density_std=0.02 * nominal.sheet.areal_density,
        thickness=1e-3,
        initial_vertices=believed(scene.grip, placed)[:, :3, 3],  # the shape is measured, the robot says where it is
        vertices=np.column_stack([uv, np.zeros(len(uv))]),
        faces=faces,
        uv=uv,
        nominal=data_sheet(nominal),
    )


def data_sheet(nominal: Scene) -> dict[str, object]:
    """Values of the effect-free fabric: a start for fits."""
    sheet, plate = nominal.sheet, nominal.plate
    return {
        "membrane_stiffness": sheet.membrane_stiffness,
        "poisson_ratio": sheet.poisson_ratio,
        "bending_stiffness": plate.stiffness,
        "bending_damping_time": plate.damping_time,
    }


def _gripper(
    scene: Scene, moved: Motion, result: Result, name: str, noise: dict[str, float], rng: np.random.Generator
) -> recordings.GripperMotion:
    pose = believed(scene.grip, moved.pose[name])
    quat = Rotation.from_matrix(pose[:, :3, :3]).as_quat(scalar_first=True)
    wrench = {
        key: getattr(result, key)[name] + std * rng.standard_normal((len(moved.t), 3)) for key, std in noise.items()
    }
    return recordings.GripperMotion(moved.t, pose[:, :3, 3], quat, np.ones(len(moved.t), bool), **wrench)


def _catalogue() -> None:
    print("motions: " + ", ".join(NAMES))
    for name, effect in CATALOGUE.items():
        more = f"  [{', '.join(effect.options)}]" if effect.options else ""
        print(f"{name:20s} {effect.typical:8.3g} {effect.unit:8s} shows in {effect.motion}{more}")


def main(arguments: list[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--list", action="store_true", help="motions and effects with typical amplitudes")
    parser.add_argument("--motion", default="swing", metavar="NAME", help=", ".join(NAMES))
    parser.add_argument("--heading", type=float, default=0.0, metavar="DEGREES", help="about the vertical")
    parser.add_argument("--speed", type=float, default=1.0, metavar="FACTOR", help="2: in half the time")
    parser.add_argument("--effect", action="append", default=[], metavar="NAME=VALUE[,OPTION=VALUE...]")
    parser.add_argument("--nodes", type=int, default=25, help="vertices along each side of the truth's mesh (25)")
    parser.add_argument("--fit-nodes", type=int, default=17, help="vertices along each side of cloth.obj (17)")
    parser.add_argument("--step", type=float, metavar="SECONDS", help="time step (default: the stable one)")
    parser.add_argument("--exact", action="store_true", help="without noise")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder of the episode")
    parser.add_argument("--hidden", type=Path, metavar="FILE", help="what was hidden (default DIR.hidden.json)")
    parser.add_argument("--overwrite", action="store_true", help="replace DIR")
    options = parser.parse_args(arguments)
    if options.list:
        _catalogue()
        return 0
    if options.out is None:
        parser.error("--out is needed")
    try:
        return _generate(options)
    except TorchclothError as error:
        print(error, file=sys.stderr)
        return 2


def _generate(options: argparse.Namespace) -> int:
    if options.out.exists() and not options.overwrite:  # said before the work is done, and as an option
        raise InvalidInput("--out", got=f"{options.out}, which exists", expected="a new name", remedy="or --overwrite")
    began = time.perf_counter()
    scene, hidden = Scene(), [parse(text) for text in options.effect]
    scene = replace(scene, sheet=replace(scene.sheet, nodes=(options.nodes, options.nodes)))
    for name, amplitude, more in hidden:
        scene = hide(scene, name, amplitude, more)
    moved = motion(options.motion, scene.sheet, options.heading, options.speed)
    result = simulate(scene, moved, options.step)
    recording = record(scene, moved, result, options.motion, options.seed, options.fit_nodes, options.exact)
    path = recordings.write(recording, options.out, overwrite=options.overwrite)
    beside = options.hidden or path.with_name(f"{path.name}.hidden.json")
    effects = [{"effect": name, "amplitude": value, **more} for name, value, more in hidden]
    facts = {"seed": options.seed, "motion": options.motion, "heading": options.heading, "speed": options.speed}
    text = json.dumps({**facts, "effects": effects, "scene": asdict(scene)}, indent=1)
    beside.write_text(text + "\n", encoding="utf-8")
    print(f"{path}: {moved.t[-1]:.2f} s of cloth in {time.perf_counter() - began:.0f} s; hidden: {beside}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
