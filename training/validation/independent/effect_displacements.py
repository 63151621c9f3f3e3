"""How far each hidden effect moves the cloth and the measured points, at its typical amplitude, on a coarse mesh.

python -m torchcloth.training.validation.independent.effect_displacements    # five minutes; names choose some
"""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np

from torchcloth.errors import InvalidInput

from .effects import CATALOGUE, hide
from .motions import Motion, motion
from .mujoco_cloth import Result
from .scene import Scene, believed, evenly, simulate
from .sensor import see

NODES = 13
BESIDE = {"air.wind": ("air.drag_n", 1.2), "x.jet": ("air.drag_n", 1.2)}  # what makes an effect felt
CHOOSES = ("obs.occlusion", "obs.edge")  # other points are seen: their distance means nothing
Run = tuple[Scene, Motion, Result]


def size(name: str, plain: Run | None = None) -> tuple[float, float, Run]:
    """Root mean square displacement [m] of the cloth and of the points by an effect, and the run without it."""
    effect = CATALOGUE[name]
    if plain is None:
        scene = Scene()
        scene = replace(scene, sheet=replace(scene.sheet, nodes=(NODES, NODES)))
        if name in BESIDE:
            scene = hide(scene, *BESIDE[name])
        moved = motion(effect.motion, scene.sheet)
        plain = scene, moved, simulate(scene, moved)
    scene, moved, result = plain
    hidden = hide(scene, name, effect.typical)
    # what only changes the recording leaves the cloth alone
    other = result if effect.part == "sensor" or effect.name == "base" else simulate(hidden, moved)
    seen = points(hidden, moved, other) - points(scene, moved, result)
    return rms(evenly(hidden, other.x) - evenly(scene, result.x)), rms(seen), plain


def points(scene: Scene, moved: Motion, result: Result) -> np.ndarray:
    """Noise-free points [N, 3] m of all frames, from where the left gripper is recorded to be at first."""
    clouds = see(replace(scene.sensor, noise=0.0), scene.gripped.sheet, moved.t, result.x, np.random.default_rng(0))
    return clouds.xyz - believed(scene.grip, moved.pose["left"])[0, :3, 3]


def rms(moved: np.ndarray) -> float:
    """Root mean square length of vectors [..., 3]."""
    return float(np.sqrt((moved**2).sum(-1).mean()))


def main(names: list[str]) -> int:
    """Command line."""
    unknown = [name for name in names if name not in CATALOGUE]
    if unknown:
        print(InvalidInput("effect", got=unknown[0], expected=f"one of {', '.join(CATALOGUE)}"), file=sys.stderr)
        return 2
    print("| effect | amplitude | motion | cloth, mm | points, mm |\n|---|---|---|---|---|")
    kept: dict[tuple[str, bool], Run] = {}
    for name in names or CATALOGUE:
        effect, key = CATALOGUE[name], (CATALOGUE[name].motion, name in BESIDE)
        cloth, seen, kept[key] = size(name, kept.get(key))
        amplitude = f"{effect.typical:g} {effect.unit}".removesuffix(" -")
        shown = "other ones" if name in CHOOSES else f"{1e3 * seen:.2f}"
        print(f"| {name} | {amplitude} | {effect.motion} | {1e3 * cloth:.2f} | {shown} |", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
