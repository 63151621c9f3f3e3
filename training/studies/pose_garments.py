"""The pose network on garments of another engine: MuJoCo carries shirts, trousers and dresses that it has not seen.

The scenes are those of the training's split that is held out, with dresses, of which no training has any. They are
moved by MuJoCo, and seen by the training's reduced cameras with their faults.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchcloth._utils.constants import Z_95
from torchcloth._utils.files import write_atomically
from torchcloth.errors import InvalidInput, SimulationDiverged
from torchcloth.pose import load_network

from ..pose.data import PoseDataset, collate
from ..pose.motions import make_motion, motion_path
from ..pose.scenes import POSE_FRAME_PERIOD_S, RejectedScene, Scene, SimulatedScene, build_scene
from ..resumable import ResumableStudy, write_result
from ..validation.independent.garment import GarmentSpec, simulate_garment
from ..validation.independent.mujoco_cloth import Grip
from .manipulations.console_tables import heading_table, show

SCENE_COUNT, FAST_SCENE_COUNT = 24, 1
FAST_DURATION_S = 0.4
RAYLEIGH_DAMPING_S = 1e-3  # MuJoCo's flex has no damping of bending alone
MUJOCO_STEP_FRACTION = 0.5  # of MuJoCo's stable step: violent motions stretch the cloth
SPLIT = "held-out"


def add(parser: argparse.ArgumentParser) -> None:
    """Add the study's options."""
    parser.add_argument("--scenes", type=int, metavar="N", help=f"garments in motion ({SCENE_COUNT})")


def run(options: argparse.Namespace) -> None:
    """Make the missing scenes, ask the network, print and write the table."""
    count = options.scenes if options.scenes is not None else FAST_SCENE_COUNT if options.fast else SCENE_COUNT
    if count < 1:
        raise InvalidInput("--scenes", got=count, expected="1 or more")
    study = ResumableStudy(options.out, {"study": "pose_garments", "fast": options.fast})
    cases = {
        f"{seed:06d}": partial(run_scene, options.out / "motions" / f"{seed:06d}", seed, options.fast)
        for seed in hanging_garments(count)
    }
    results = study.run(cases)
    show(build_table(results), TABLE_NOTE)
    print(f"result: {write_result(options.out / 'pose_garments.json', 'pose_garments', results)}")


def hanging_garments(count: int) -> list[int]:
    """Return the first seeds of the split whose scene is a garment that hangs from its grippers."""
    seeds, seed = [], 0
    while len(seeds) < count:
        scene = build_scene(seed, SPLIT)
        if scene.shape.kind != "sheet" and not scene.has_table:
            seeds.append(seed)
        seed += 1
    return seeds


def simulate_by_mujoco(fast: bool, scene: Scene) -> SimulatedScene:
    """Simulate a scene by MuJoCo, from a garment that hangs still in its grippers.

    Raises:
        RejectedScene: MuJoCo's simulation is unstable.
    """
    mesh, fabric = scene.shape.true_mesh, scene.fabric
    spec = GarmentSpec(
        rest=np.asarray(mesh.vertices),
        faces=np.asarray(mesh.faces),
        areal_density=fabric.areal_density,
        membrane_stiffness=fabric.membrane_stiffness,
        poisson_ratio=fabric.poisson_ratio,
        bending_stiffness=fabric.bending_stiffness,
        damping_time=RAYLEIGH_DAMPING_S,
        drag_normal=fabric.drag,
    )
    grips = {
        name: Grip(np.asarray(index), path.t.numpy().astype(float), path.pose.numpy().astype(float))
        for index, (name, path) in zip(scene.shape.true_grips, scene.motion.items(), strict=True)
    }
    duration = FAST_DURATION_S if fast else scene.duration
    times = POSE_FRAME_PERIOD_S * np.arange(int(duration / POSE_FRAME_PERIOD_S + 1e-6) + 1)
    try:
        moved = simulate_garment(spec, scene.start, times, grips, MUJOCO_STEP_FRACTION)
    except SimulationDiverged as error:
        raise RejectedScene(f"scene {scene.seed} of {scene.split}", got=str(error)) from error
    return SimulatedScene(scene, times, moved.x, moved.x, moved.v)


def run_scene(folder: Path, seed: int, fast: bool) -> dict[str, Any]:
    """Make a motion and return the network's errors on its clouds."""
    torch.set_num_threads(1)
    motion = make_motion(seed, SPLIT, partial(simulate_by_mujoco, fast))
    facts = {name: str(motion[name]) for name in ("kind", "novelty", "grip_kind", "motion_kind", "rejected")}
    if facts["rejected"]:
        return facts
    folder.mkdir(parents=True, exist_ok=True)
    with write_atomically(motion_path(folder, seed)) as part:
        np.savez(part, **motion)  # pyright: ignore[reportArgumentType] - numpy's stub takes it for a flag
    dataset = PoseDataset(folder)
    samples = [dataset[k] for k in range(len(dataset))]
    batch = collate(samples)
    with torch.no_grad():
        answer = load_network()(batch.inputs)
    squared = (answer.x - batch.x).square()
    free = batch.inputs.grip == 0
    inside = squared.sqrt() < Z_95 * answer.std[..., None]
    return facts | {
        "rms": squared.sum(-1).mean(1).sqrt().tolist(),
        "coverage": float(inside[free].double().mean()),
        "visible": [sample.visible for sample in samples],
    }


def build_table(results: Mapping[str, Mapping[str, Any]]):
    """Return one row for each kind of garment, and one for all."""
    table = heading_table(
        "The network on MuJoCo's garments", "garment", "scenes", "clouds", "median, mm", "quartiles, mm", "in 95 %"
    )
    done = [case for case in results.values() if "rms" in case]
    for kind in [*sorted({case["kind"] for case in done}), "all"]:
        rows = [case for case in done if kind in (case["kind"], "all")]
        rms = 1e3 * np.array([value for case in rows for value in case["rms"]])
        low, high = np.percentile(rms, [25, 75])
        coverage = float(np.mean([case["coverage"] for case in rows]))
        cells = (str(len(rows)), str(len(rms)), f"{np.median(rms):.1f}", f"{low:.1f} to {high:.1f}", f"{coverage:.0%}")
        table.add_row(kind, *cells)
    return table


TABLE_NOTE = (
    "Root mean square distance of the vertices from the truth, cloud by cloud. in 95 %: share of the free vertices' "
    "coordinates that are within 1.96 of the network's standard deviations."
)
