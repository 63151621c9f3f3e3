"""The swing of the shipped example by torchcloth, which other engines are to follow."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.interpolate import CubicSpline

import torchcloth
from torchcloth.cloth import Cloth
from torchcloth.episodes.observed import build_episode
from torchcloth.episodes.recorded_cloth import build_cloth
from torchcloth.episodes.replay import SETTLE_TIME_S, first_state
from torchcloth.recordings import Recording

from ..independent.flex_sheet import SheetSpec, StillAir

Array = np.ndarray
EXAMPLE = Path(torchcloth.__file__).parent / "examples" / "bimanual_swing"
PATH_STEP_S = 2.5e-3  # of the grippers' path, between whose knots a spline runs; the example's knots are 10 ms apart
FITTED_VALUES = {  # of `torchcloth demo`, which takes the bench as exact
    "material.youngs_modulus": 53.73e3,
    "material.poisson_ratio": 0.3485,
    "areal_density": 0.3496,
    "effects.bending.stiffness": 3.39e-5,
    "effects.bending.damping_time": 0.005,
    "effects.air.normal": 1.187,
}


@dataclass(frozen=True, eq=False)
class Swing:
    """A simulated motion.

    Attributes:
        cloth: what moved.
        t: [T] s, frame times.
        x: [T, V, 3] m.
        gripped: [H] vertices that the grippers hold.
        path_t: [K] s.
        path_x: [K, H, 3] m, positions of the gripped vertices.
    """

    cloth: Cloth
    t: Array
    x: Array
    gripped: Array
    path_t: Array
    path_x: Array

    @cached_property
    def path(self) -> CubicSpline:
        """Positions [H, 3] m of the gripped vertices as a function of time [s]."""
        return CubicSpline(self.path_t, self.path_x)

    def rms_distance(self, x: Array) -> float:
        """Return the root mean square distance [m] of positions [T, V, 3] m of the free vertices."""
        free = np.setdiff1d(np.arange(self.x.shape[1]), self.gripped)
        return float(np.sqrt(((x - self.x)[:, free] ** 2).sum(-1).mean()))

    def max_distance(self, x: Array) -> float:
        """Return the largest distance [m] of a vertex."""
        return float(np.linalg.norm(x - self.x, axis=-1).max())


def make_still_air(swing: Swing) -> StillAir:
    """Return the drag of the swing's cloth along the normal of every triangle, in numpy."""
    effect: Any = swing.cloth.effects["air"]
    spec = SheetSpec(drag_normal=float(effect.normal.value.detach()), air_density=effect.density)
    return StillAir(spec, swing.cloth.mesh.faces, swing.x.shape[1])


def build_fitted_cloth(recording: Recording) -> Cloth:
    """Return the example's cloth with the values of its fit."""
    cloth = build_cloth(recording)
    for name, value in FITTED_VALUES.items():
        parameter: Any = cloth.get_submodule(name)
        parameter.set(value)
    return cloth


def simulate_swing(cloth: Cloth, recording: Recording, seconds: float | None = None) -> Swing:
    """Simulate an episode from rest.

    Args:
        cloth: of the episode.
        recording: the episode.
        seconds: simulated time; None: the whole motion.
    """
    episode = build_episode(cloth, recording)
    times = episode.times.numpy()
    times = times[: len(times) if seconds is None else np.searchsorted(times, times[0] + seconds)]
    count = round((times[-1] - times[0]) / PATH_STEP_S)
    dense = np.union1d(times, np.linspace(times[0], times[-1], count + 1))
    dense = dense[np.append(True, np.diff(dense) > 1e-9)]
    with torch.no_grad():
        state = cloth.settle(first_state(cloth, episode), episode.motion, start=float(times[0]), duration=SETTLE_TIME_S)
        x = cloth(state, episode.motion, torch.as_tensor(dense)).x.numpy()
    grasps: Any = cloth.boundaries
    gripped = np.concatenate([grasp.index.numpy() for grasp in grasps.values()])
    return Swing(cloth, times, x[np.searchsorted(dense, times - 1e-9)], gripped, dense, x[:, gripped])
