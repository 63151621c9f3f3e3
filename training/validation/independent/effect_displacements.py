"""Measure how far each hidden effect moves the cloth and the measured points, at its typical amplitude.

    python -m torchcloth.training.validation.independent.effect_displacements [NAME ...]    # five minutes for all

The mesh is coarse.
"""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np

from torchcloth.errors import InvalidInput

from .effects import CATALOGUE, add_effect
from .motions import Motion, make_motion
from .mujoco_cloth import Result
from .scene import Scene, recorded_poses, resample_evenly, simulate
from .sensor import sample_points

NODES_PER_SIDE = 13
REQUIRED_EFFECTS = {"air.wind": ("air.drag_n", 1.2), "x.jet": ("air.drag_n", 1.2)}  # without these it has no force
POINT_SELECTING_EFFECTS = ("obs.occlusion", "obs.edge")  # other points are seen: their distance means nothing
Run = tuple[Scene, Motion, Result]


def measure_displacement(name: str, reference: Run | None = None) -> tuple[float, float, Run]:
    """Return the RMS displacements [m] of the cloth and of the points by an effect, and the run without it."""
    effect = CATALOGUE[name]
    if reference is None:
        scene = Scene()
        scene = replace(scene, sheet=replace(scene.sheet, nodes=(NODES_PER_SIDE, NODES_PER_SIDE)))
        if name in REQUIRED_EFFECTS:
            scene = add_effect(scene, *REQUIRED_EFFECTS[name])
        motion = make_motion(effect.motion, scene.sheet)
        reference = scene, motion, simulate(scene, motion)
    scene, motion, result = reference
    changed_scene = add_effect(scene, name, effect.typical)
    # errors of the sensor and of the base leave the cloth alone
    moves_cloth = effect.part != "sensor" and effect.field != "base"
    changed = simulate(changed_scene, motion) if moves_cloth else result
    cloth = resample_evenly(changed_scene, changed.x) - resample_evenly(scene, result.x)
    points = exact_points(changed_scene, motion, changed) - exact_points(scene, motion, result)
    return rms_length(cloth), rms_length(points), reference


def exact_points(scene: Scene, motion: Motion, result: Result) -> np.ndarray:
    """Return noise-free points [N, 3] m of all frames, relative to the left gripper's first recorded position."""
    sensor, sheet = replace(scene.sensor, noise=0.0), scene.aligned_to_patches.sheet
    clouds = sample_points(sensor, sheet, motion.t, result.x, np.random.default_rng(0))
    return clouds.xyz - recorded_poses(scene.grip, motion.pose["left"])[0, :3, 3]


def rms_length(vectors: np.ndarray) -> float:
    """Return the root mean square length of vectors [..., 3]."""
    return float(np.sqrt((vectors**2).sum(-1).mean()))


def main(names: list[str]) -> int:
    """Print the table of the named effects, or of all; return the exit code."""
    unknown = [name for name in names if name not in CATALOGUE]
    if unknown:
        print(InvalidInput("effect", got=unknown[0], expected=f"one of {', '.join(CATALOGUE)}"), file=sys.stderr)
        return 2
    print("| effect | amplitude | motion | cloth, mm | points, mm |\n|---|---|---|---|---|")
    plain_runs: dict[tuple[str, bool], Run] = {}
    for name in names or CATALOGUE:
        effect, key = CATALOGUE[name], (CATALOGUE[name].motion, name in REQUIRED_EFFECTS)
        cloth, points, plain_runs[key] = measure_displacement(name, plain_runs.get(key))
        amplitude = f"{effect.typical:g} {effect.unit}".removesuffix(" -")
        moved = "other points" if name in POINT_SELECTING_EFFECTS else f"{1e3 * points:.2f}"
        print(f"| {name} | {amplitude} | {effect.motion} | {1e3 * cloth:.2f} | {moved} |", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
