"""Bending: a cantilever against the heavy elastica."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

import torchcloth as tc

from . import closed_forms
from .case_figures import MEASURED_COLOUR, TRUTH_COLOUR
from .registry import FigureData, Outcome, Row, register_case, relative
from .scenes import indices_where, make_strip, stationary_trajectory

CANTILEVER_DENSITY_KG_PER_M2, CANTILEVER_LENGTH_M, CANTILEVER_WIDTH_M = 0.2, 0.095, 0.02


def simulate_profile(bending: float, degrees: float, edge: float) -> np.ndarray:
    """Return the profile [2, K] m of a strip from its clamp, along and height; it holds two rows of vertices."""
    mesh = make_strip(
        CANTILEVER_LENGTH_M + edge,
        CANTILEVER_WIDTH_M,
        (round(CANTILEVER_LENGTH_M / edge) + 2, round(CANTILEVER_WIDTH_M / edge) + 1),
        degrees,
    )
    s = mesh.vertices[:, 0]
    cloth = tc.Cloth(
        mesh,
        tc.materials.AEP(1e5, 0.02),
        CANTILEVER_DENSITY_KG_PER_M2,
        {"bending": tc.effects.Bending(bending), "gravity": tc.effects.Gravity()},
        {"clamp": tc.boundaries.Grasp(indices_where(s < 1.01 * edge))},
        contact=None,
    )
    state = cloth.rest_state()
    with torch.no_grad():
        for rate in (10.0, 40.0):
            state = cloth.settle(state, {"clamp": stationary_trajectory()}, duration=0.5, rate=rate)
    columns = np.unique(s.round(9))[1:]
    profile = [state.x.numpy()[np.abs(s - c) < 1e-6][:, [0, 2]].mean(0) for c in columns]
    return np.array(profile).T - [[edge], [0.0]]


def draw_figure(figure: Any, data: FigureData) -> None:
    """Draw the profiles of the strips along the warp."""
    axis = figure.subplots()
    for name in (name.removeprefix("truth ") for name in data if name.startswith("truth ")):
        axis.plot(*(1e3 * data[f"truth {name}"]), color=TRUTH_COLOUR, lw=2.5)
        axis.plot(*(1e3 * data[f"measured {name}"]), ".", color=MEASURED_COLOUR, ms=4)
        axis.annotate(name, 1e3 * data[f"truth {name}"][:, -1], textcoords="offset points", xytext=(4, -4))
    axis.set(xlabel="along [mm]", ylabel="height [mm]", aspect="equal", xlim=(0, 120))


@register_case(
    "cantilever",
    "Cantilever under its own weight",
    truth="heavy elastica, B θ'' = ρ_A g (L − s) cos θ, solved as a boundary-value problem (scipy)",
    tolerance=relative(0.03),
    draw=draw_figure,
)
def heavy_cantilever(fast: bool) -> Outcome:
    """Measure sag and reach of the strip\'s end."""
    rows, data = [], {}
    scenes = [(2e-4, 0.0), (1e-3, 0.0), (5e-5, 0.0), (2e-4, 45.0)]
    for bending, degrees in scenes[:1] if fast else scenes:
        name = f"B = {bending:.0e} N m" + (", bias" if degrees else "")
        truth = closed_forms.solve_heavy_elastica(bending, CANTILEVER_DENSITY_KG_PER_M2, CANTILEVER_LENGTH_M)
        for edge in (5e-3,) if fast else (5e-3, 2.5e-3):
            profile = simulate_profile(bending, degrees, edge)
            tip, label = 1e3 * profile[:, -1], f"{name}, edges {1e3 * edge:g} mm"
            coarse = edge > 2.5e-3 and not fast
            rows.append(Row(f"sag, {label}", -tip[1], -1e3 * truth.height[-1], "mm", finding=coarse))
            rows.append(Row(f"reach, {label}", tip[0], 1e3 * truth.along[-1], "mm", finding=coarse))
        if not degrees:
            data[f"truth {name}"] = np.array([truth.along, truth.height])
            data[f"measured {name}"] = profile
    note = (
        "Strip of 95 mm x 20 mm beyond its clamp, 0.2 kg/m²; the bias strip's warp lies at 45°. Two rows of vertices"
        " are held, and the clamp's root is taken at the second. The clamp is soft over a part of an edge, which is the"
        " error. The finest edge has a tolerance; the coarse one shows the order."
    )
    return Outcome(rows, data, note)
