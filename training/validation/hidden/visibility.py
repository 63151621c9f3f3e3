"""Print how visible the effects of a hidden case are: how far they move the cloth that no fabric parameter does.

    python -m torchcloth.training.validation.hidden.visibility --seed 12    # after the answer is written

It uses the independent engine alone, without noise, on a coarser mesh, and knows nothing of the diagnosis. Errors of
the sensor and of a robot's base move no cloth and are left out.
"""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np

from torchcloth.errors import InvalidInput

from ..independent.flex_sheet import sheet_mesh
from ..independent.motions import make_motion
from ..independent.scene import resample_evenly, simulate
from .case_command import print_case_json
from .case_sampling import Case
from .effect_map import OUTSIDE_EFFECTS, SINGLE_EFFECTS
from .make_case import make_scenes

Array = np.ndarray
PATCHES_PER_SIDE, WINDOW_S = 4, 0.2  # a diagnosis uses means over such patches and windows
MEAN_POSITION_STD_M, MEAN_FORCE_STD_N = 0.5e-3, 10e-3  # about how exactly such a mean is known
# step of the logarithm, and standard deviation of the logarithm that a data sheet leaves open
FABRIC_STEP_AND_STD = {
    "membrane_stiffness": (0.1, 0.9),
    "bending_stiffness": (0.2, 0.9),
    "areal_density": (0.04, 0.02),
}
IMMOBILE_PREFIXES = ("obs.", "robot.base")  # of effects that move no cloth


def measure_visibility(case: Case) -> list[dict[str, object]]:
    """Return for each effect that moves the cloth how far it changes the means.

    ``displacement_rms_m`` and ``force_rms_n`` are the whole change. ``unexplained_displacement_rms_m`` and
    ``unexplained_force_rms_n`` are what no membrane stiffness, bending stiffness or areal density can do, as far as a
    data sheet leaves these open.
    """
    case = replace(case, nodes=case.size.fit_nodes)
    mapped = SINGLE_EFFECTS | OUTSIDE_EFFECTS
    effects = [e for e in case.effects if e.name in mapped and not e.name.startswith(IMMOBILE_PREFIXES)]
    if not effects:
        return []
    means = simulate_means(case)
    slopes = np.stack([_central_difference(case, name, step) for name, (step, _) in FABRIC_STEP_AND_STD.items()], -1)
    prior = np.diag([1 / std for _, std in FABRIC_STEP_AND_STD.values()])
    rows: list[dict[str, object]] = []
    for effect in effects:
        others = replace(case, effects=tuple(e for e in case.effects if e is not effect))
        try:
            change = means - simulate_means(others)
        except InvalidInput:  # another effect needs this one, and stands for both
            continue
        target = np.append(change, np.zeros(len(prior)))
        fitted, *_ = np.linalg.lstsq(np.vstack([slopes, prior]), target, rcond=None)
        (displacement, force), (left, left_force) = rms(case, change), rms(case, change - slopes @ fitted)
        rows.append(
            {
                "name": effect.name,
                "displacement_rms_m": displacement,
                "force_rms_n": force,
                "unexplained_displacement_rms_m": left,
                "unexplained_force_rms_n": left_force,
            }
        )
    return rows


def _central_difference(case: Case, name: str, step: float) -> Array:
    return (simulate_means(case, name, step) - simulate_means(case, name, -step)) / (2 * step)


def simulate_means(case: Case, name: str = "", log_change: float = 0.0) -> Array:
    """Return the means of all episodes, in units of their standard deviations.

    Mean positions by patch and window come first, then mean forces by window.

    Args:
        case: its truth is simulated.
        name: value of the fabric that is changed; "": none.
        log_change: of the logarithm of that value.
    """
    if name:
        case = replace(case, fabric=case.fabric | {name: case.fabric[name] * np.exp(log_change)})
    positions, forces = [], []
    for episode in case.episodes:
        scene, _ = make_scenes(case, episode)
        motion = make_motion(episode.motion, scene.sheet, episode.heading, episode.speed, episode.start)
        result = simulate(scene, motion)
        x = resample_evenly(scene, result.x)
        uv = sheet_mesh(scene.sheet)[0] / [scene.sheet.width, scene.sheet.height]
        patch = np.minimum((uv * PATCHES_PER_SIDE).astype(int), PATCHES_PER_SIDE - 1) @ [PATCHES_PER_SIDE, 1]
        window = (motion.t / WINDOW_S).astype(int)
        for k in range(window[-1] + 1):
            mean = x[window == k].mean(0)
            positions += [mean[patch == p].mean(0) for p in range(PATCHES_PER_SIDE**2)]
            forces += [force[window == k].mean(0) for force in result.force.values()]
    scaled_forces = np.concatenate(forces) / MEAN_FORCE_STD_N * case.has_forces
    return np.concatenate([np.concatenate(positions) / MEAN_POSITION_STD_M, scaled_forces])


def rms(case: Case, change: Array) -> tuple[float, float]:
    """Return the root mean square per axis of a change of the means: positions [m] and forces [N]."""
    force_count = change.size * 2 // (PATCHES_PER_SIDE**2 + 2)  # two grippers beside each window's patches
    positions, forces = np.split(change, [change.size - force_count])
    return (
        float(MEAN_POSITION_STD_M * np.sqrt(np.mean(positions**2))),
        float(MEAN_FORCE_STD_N * np.sqrt(np.mean(forces**2))),
    )


if __name__ == "__main__":
    sys.exit(print_case_json(__doc__, measure_visibility))
