"""Says by how much a case's effects move its cloth beside what the fabric's numbers could do; after the answer, too.

python -m torchcloth.training.validation.hidden.visibility --seed 12

By the truth's engine alone, without noise, on a coarser mesh: it knows nothing of how a diagnosis goes about it. What
the sensor sees otherwise, or a robot that stands elsewhere, moves no cloth and is left out.
"""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np

from torchcloth.errors import InvalidInput

from ..independent.flex_sheet import grid
from ..independent.motions import motion
from ..independent.scene import evenly, simulate
from .case_command import told
from .case_sampling import Case
from .effect_map import OUTSIDE, SINGLES
from .make_case import scenes

Array = np.ndarray
PATCHES, WINDOW = 4, 0.2  # along either side of the sheet; s: a diagnosis sees means over such
SEEN, FELT = 0.5e-3, 10e-3  # m and N, how exactly such a mean is known, about
FABRIC = {"membrane_stiffness": (0.1, 0.9), "bending_stiffness": (0.2, 0.9), "areal_density": (0.04, 0.02)}
"""Step of the logarithm and standard deviation of what a data sheet says of it."""
UNMOVED = ("obs.", "robot.base")


def shown(found: Case) -> list[dict[str, object]]:
    """For each effect that moves the cloth, RMS of the means' changes: positions [m], forces [N].

    ``moves`` and ``pulls``: altogether. ``left_moves`` and ``left_pulls``: what no membrane stiffness, bending
    stiffness or areal density does, as far as a data sheet leaves them open.
    """
    found = replace(found, nodes=found.size.fit)
    effects = [e for e in found.effects if e.name in SINGLES | OUTSIDE and not e.name.startswith(UNMOVED)]
    if not effects:
        return []
    whole = means(found)
    slope = lambda name, h: (means(found, name, h) - means(found, name, -h)) / (2 * h)  # noqa: E731
    slopes = np.stack([slope(name, step) for name, (step, _) in FABRIC.items()], -1)
    known = np.diag([1 / std for _, std in FABRIC.values()])
    out: list[dict[str, object]] = []
    for effect in effects:
        others = replace(found, effects=tuple(e for e in found.effects if e is not effect))
        try:
            done = whole - means(others)
        except InvalidInput:  # another effect needs this one, and stands for both
            continue
        fitted, *_ = np.linalg.lstsq(np.vstack([slopes, known]), np.append(done, np.zeros(len(known))), rcond=None)
        (moves, pulls), (left, pull) = rms(found, done), rms(found, done - slopes @ fitted)
        out.append({"name": effect.name, "moves": moves, "pulls": pulls, "left_moves": left, "left_pulls": pull})
    return out


def means(found: Case, name: str = "", change: float = 0.0) -> Array:
    """Mean positions by patch and window, then mean forces by window, of all episodes, in units of what is known.

    With one number of the fabric changed, by its logarithm.
    """
    if name:
        found = replace(found, fabric=found.fabric | {name: found.fabric[name] * np.exp(change)})
    places, forces = [], []
    for take in found.takes:
        scene, _ = scenes(found, take)
        moved = motion(take.motion, scene.sheet, take.heading, take.speed, take.start)
        result = simulate(scene, moved)
        x = evenly(scene, result.x)
        uv = grid(scene.sheet)[0] / [scene.sheet.width, scene.sheet.height]
        patch = np.minimum((uv * PATCHES).astype(int), PATCHES - 1) @ [PATCHES, 1]
        window = (moved.t / WINDOW).astype(int)
        for k in range(window[-1] + 1):
            now = x[window == k].mean(0)
            places += [now[patch == p].mean(0) for p in range(PATCHES**2)]
            forces += [force[window == k].mean(0) for force in result.force.values()]
    return np.concatenate([np.concatenate(places) / SEEN, np.concatenate(forces) / FELT * found.forces])


def rms(found: Case, change: Array) -> tuple[float, float]:
    """(m, N) per axis of what ``means`` gave."""
    of_forces = change.size * 2 // (PATCHES**2 + 2)  # two grippers beside each window's patches
    places, forces = np.split(change, [change.size - of_forces])
    return float(SEEN * np.sqrt(np.mean(places**2))), float(FELT * np.sqrt(np.mean(forces**2)))


if __name__ == "__main__":
    sys.exit(told(__doc__, shown))
