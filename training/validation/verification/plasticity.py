"""In-plane plastic set."""

from __future__ import annotations

import numpy as np
import torch

import torchcloth as tc

from . import closed_forms
from .case_figures import TRUTH, colour
from .registry import NotThere, Outcome, Row, case, relative
from .scenes import path, smooth

SIZE, STIFFNESS, POISSON, LIMIT = 0.1, 600.0, 0.3, 0.02
PULL, HOLD = 0.10, 0.02  # s: pulled, held, let back as slowly, held


def stretch(strain: tuple[float, float], back: float, t: torch.Tensor) -> torch.Tensor:
    """Stretches [T, 2] over time: up to ``strain``, then back by the share ``back``."""
    up = smooth(t / PULL) - back * smooth((t - PULL - HOLD) / PULL)
    return 1 + up.unsqueeze(-1) * torch.tensor(strain)


def pulled(strain: tuple[float, float], back: float, times: np.ndarray) -> np.ndarray:
    """Tension [T, 2] N/m per rest length, along warp and weft; a gripper moves each vertex of the rim."""
    mesh = tc.meshes.rectangle(SIZE, SIZE, resolution=(3, 3))
    rim = [k for k in range(9) if k != 4]
    material = tc.materials.AEP(STIFFNESS * 1e3, POISSON, plastic=tc.materials.NormYield(LIMIT))
    grasps = {str(k): tc.boundaries.Grasp([k]) for k in rim}
    cloth = tc.Cloth(mesh, material, 0.2, {"damping": tc.effects.MassDamping(30.0)}, grasps, contact=None)
    t = torch.linspace(0, float(times[-1]), 301)
    motion = {}
    for k in rim:
        place = torch.as_tensor(mesh.vertices[k, :2])
        way = torch.cat([(stretch(strain, back, t) - 1) * place, torch.zeros(len(t), 1)], -1)
        motion[str(k)] = path(t, way)
    with torch.no_grad():
        out = cloth(cloth.rest_state(), motion, times=times, dt=5e-5)
    right, upper = ([k for k in rim if mesh.vertices[k, axis] > SIZE - 1e-9] for axis in (0, 1))
    pull = [-sum(out.wrench[str(k)][:, axis] for k in side) / SIZE for axis, side in enumerate((right, upper))]
    return torch.stack(pull, -1).numpy()


def on_paper(strain: tuple[float, float], back: float, times: np.ndarray) -> np.ndarray:
    """The law, stepped through along its principal axes: tension [T, 2] N/m; energy is per area of the pattern."""
    fine = np.linspace(0, times[-1], 20001)
    set_now, found = np.ones(2), []
    for now in stretch(strain, back, torch.as_tensor(fine)).numpy():
        first, second = now / set_now
        elastic = np.array(closed_forms.elastic_part((first, second), LIMIT))
        set_now = now / elastic
        found.append(np.array(closed_forms.biaxial_tension(tuple(elastic), STIFFNESS, POISSON)) / set_now)
    return np.stack([np.interp(times, fine, np.array(found)[:, axis]) for axis in (0, 1)], -1)


def draw(figure, data) -> None:
    axis = figure.subplots()
    for k, label in enumerate(("warp", "weft")):
        axis.plot(1e3 * data["t"], data["truth"][:, k], color=TRUTH, lw=2.5)
        axis.plot(1e3 * data["t"], data["measured"][:, k], ".", color=colour(k), ms=4, label=label)
    axis.set(xlabel="time [ms]", ylabel="tension [N/m]")
    axis.legend()


@case(
    "biaxial-plastic-set",
    "Biaxial plastic set with NormYield",
    truth="radial return of the stretches to Σ(σ−1)² = c², fixed-corotated tension of what stays elastic",
    mark=relative(0.01),
    draw=draw,
)
def biaxial_plastic_set(fast: bool) -> Outcome:
    """Pulled far beyond the limit, held, let back a little: the tension then shows the set."""
    if not hasattr(tc.materials, "NormYield"):
        raise NotThere("materials.NormYield")
    times, back = np.linspace(0, 2 * (PULL + HOLD), 61), 0.15
    held, let = np.searchsorted(times, (PULL + 0.999 * HOLD, 2 * PULL + 1.999 * HOLD))
    rows, data = [], {}
    for strain in ((0.08, 0.08),) if fast else ((0.08, 0.08), (0.08, 0.04)):
        measured, truth = pulled(strain, back, times), on_paper(strain, back, times)
        for k, axis in enumerate(("warp", "weft")[: 1 if strain[0] == strain[1] else 2]):
            name = f"{axis}, {100 * strain[0]:.0f} % × {100 * strain[1]:.0f} %"
            rows.append(Row(f"tension at the full stretch, {name}", measured[held, k], truth[held, k], "N/m"))
            rows.append(Row(f"tension let back by {100 * back:.0f} %, {name}", measured[let, k], truth[let, k], "N/m"))
        data = {"t": times, "measured": measured, "truth": truth}
    note = f"c = {LIMIT:g}, Y = {STIFFNESS:g} N/m; a square whose rim is moved vertex by vertex."
    return Outcome(rows, data, note)
