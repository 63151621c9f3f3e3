"""In-plane plastic set against a closed form."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

import torchcloth as tc

from . import closed_forms
from .case_figures import TRUTH_COLOUR, line_colour
from .registry import FigureData, Outcome, Row, register_case, relative
from .scenes import smooth_step, translation_trajectory

SQUARE_SIDE_M, SQUARE_STIFFNESS_N_PER_M, SQUARE_POISSON_RATIO, YIELD_STRAIN = 0.1, 600.0, 0.3, 0.02
STRETCHING_S, HOLDING_S = 0.10, 0.02  # stretched, held, released as slowly, held


def prescribed_stretch(strain: tuple[float, float], release: float, t: torch.Tensor) -> torch.Tensor:
    """Return the stretches [T, 2] over time: up to ``strain``, then back by the fraction ``release``."""
    fraction = smooth_step(t / STRETCHING_S) - release * smooth_step((t - STRETCHING_S - HOLDING_S) / STRETCHING_S)
    return 1 + fraction.unsqueeze(-1) * torch.tensor(strain)


def simulate_tension_history(strain: tuple[float, float], release: float, times: np.ndarray) -> np.ndarray:
    """Return the tension [T, 2] N/m per rest length along warp and weft; a gripper moves each vertex of the rim."""
    mesh = tc.meshes.rectangle(SQUARE_SIDE_M, SQUARE_SIDE_M, resolution=(3, 3))
    rim = [k for k in range(9) if k != 4]
    material = tc.materials.AEP(
        SQUARE_STIFFNESS_N_PER_M * 1e3, SQUARE_POISSON_RATIO, plastic=tc.materials.NormYield(YIELD_STRAIN)
    )
    grasps = {str(k): tc.boundaries.Grasp([k]) for k in rim}
    cloth = tc.Cloth(mesh, material, 0.2, {"damping": tc.effects.MassDamping(30.0)}, grasps, contact=None)
    t = torch.linspace(0, float(times[-1]), 301)
    motion = {}
    for k in rim:
        position = torch.as_tensor(mesh.vertices[k, :2])
        displacement = torch.cat([(prescribed_stretch(strain, release, t) - 1) * position, torch.zeros(len(t), 1)], -1)
        motion[str(k)] = translation_trajectory(t, displacement)
    with torch.no_grad():
        out = cloth(cloth.rest_state(), motion, times=times, dt=5e-5)
    right, upper = ([k for k in rim if mesh.vertices[k, axis] > SQUARE_SIDE_M - 1e-9] for axis in (0, 1))
    tension = [
        -torch.as_tensor(sum(out.wrench[str(k)][:, axis] for k in side)) / SQUARE_SIDE_M
        for axis, side in enumerate((right, upper))
    ]
    return torch.stack(tension, -1).numpy()


def exact_tension_history(strain: tuple[float, float], release: float, times: np.ndarray) -> np.ndarray:
    """Return the tension [T, 2] N/m of the law, integrated along its principal axes.

    The energy is per area of the pattern.
    """
    fine = np.linspace(0, times[-1], 20001)
    plastic, tensions = np.ones(2), []
    for total in prescribed_stretch(strain, release, torch.as_tensor(fine)).numpy():
        first, second = total / plastic
        elastic = np.array(closed_forms.elastic_stretches((first, second), YIELD_STRAIN))
        plastic = total / elastic
        tensions.append(
            np.array(closed_forms.biaxial_tension(tuple(elastic), SQUARE_STIFFNESS_N_PER_M, SQUARE_POISSON_RATIO))
            / plastic
        )
    return np.stack([np.interp(times, fine, np.array(tensions)[:, axis]) for axis in (0, 1)], -1)


def draw_figure(figure: Any, data: FigureData) -> None:
    """Draw the tension over time."""
    axis = figure.subplots()
    for k, label in enumerate(("warp", "weft")):
        axis.plot(1e3 * data["t"], data["truth"][:, k], color=TRUTH_COLOUR, lw=2.5)
        axis.plot(1e3 * data["t"], data["measured"][:, k], ".", color=line_colour(k), ms=4, label=label)
    axis.set(xlabel="time [ms]", ylabel="tension [N/m]")
    axis.legend()


@register_case(
    "biaxial-plastic-set",
    "Biaxial plastic set with NormYield",
    truth="radial return of the stretches to Σ(σ−1)² = c², fixed-corotated tension of the elastic part",
    tolerance=relative(0.01),
    draw=draw_figure,
)
def biaxial_plastic_set(fast: bool) -> Outcome:
    """Stretch far beyond the yield strain, hold, and release a little: the tension then shows the plastic set."""
    times, release = np.linspace(0, 2 * (STRETCHING_S + HOLDING_S), 61), 0.15
    full, released = np.searchsorted(times, (STRETCHING_S + 0.999 * HOLDING_S, 2 * STRETCHING_S + 1.999 * HOLDING_S))
    rows, data = [], {}
    for strain in ((0.08, 0.08),) if fast else ((0.08, 0.08), (0.08, 0.04)):
        measured, truth = (
            simulate_tension_history(strain, release, times),
            exact_tension_history(strain, release, times),
        )
        for k, axis in enumerate(("warp", "weft")[: 1 if strain[0] == strain[1] else 2]):
            name = f"{axis}, {100 * strain[0]:.0f} % × {100 * strain[1]:.0f} %"
            rows.append(Row(f"tension at the full stretch, {name}", measured[full, k], truth[full, k], "N/m"))
            rows.append(
                Row(
                    f"tension after release by {100 * release:.0f} %, {name}",
                    measured[released, k],
                    truth[released, k],
                    "N/m",
                )
            )
        data = {"t": times, "measured": measured, "truth": truth}
    note = f"c = {YIELD_STRAIN:g}, Y = {SQUARE_STIFFNESS_N_PER_M:g} N/m; all vertices of the rim are prescribed."
    return Outcome(rows, data, note)
