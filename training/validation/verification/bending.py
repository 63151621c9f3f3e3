"""A cantilever against the heavy elastica."""

from __future__ import annotations

import numpy as np
import torch

import torchcloth as tc

from . import closed_forms
from .case_figures import MEASURED, TRUTH
from .registry import Outcome, Row, case, relative
from .scenes import still, strip, where

DENSITY, FREE, WIDTH = 0.2, 0.095, 0.02


def cantilever(bending: float, degrees: float, edge: float) -> np.ndarray:
    """Profile [2, K] m from the clamp, along and height, of a strip held by its first two rows of vertices."""
    mesh = strip(FREE + edge, WIDTH, (round(FREE / edge) + 2, round(WIDTH / edge) + 1), degrees)
    s = mesh.vertices[:, 0]
    cloth = tc.Cloth(
        mesh,
        tc.materials.AEP(1e5, 0.02),
        DENSITY,
        {"bending": tc.effects.Bending(bending), "gravity": tc.effects.Gravity()},
        {"clamp": tc.boundaries.Grasp(where(s < 1.01 * edge))},
        contact=None,
    )
    state = cloth.rest_state()
    with torch.no_grad():
        for rate in (10.0, 40.0):
            state = cloth.settle(state, {"clamp": still()}, duration=0.5, rate=rate)
    columns = np.unique(s.round(9))[1:]
    profile = [state.x.numpy()[np.abs(s - c) < 1e-6][:, [0, 2]].mean(0) for c in columns]
    return np.array(profile).T - [[edge], [0.0]]


def draw(figure, data) -> None:
    axis = figure.subplots()
    for name in (name.removeprefix("truth ") for name in data if name.startswith("truth ")):
        axis.plot(*(1e3 * data[f"truth {name}"]), color=TRUTH, lw=2.5)
        axis.plot(*(1e3 * data[f"measured {name}"]), ".", color=MEASURED, ms=4)
        axis.annotate(name, 1e3 * data[f"truth {name}"][:, -1], textcoords="offset points", xytext=(4, -4))
    axis.set(xlabel="along [mm]", ylabel="height [mm]", aspect="equal", xlim=(0, 120))


@case(
    "cantilever",
    "Cantilever under its own weight",
    truth="heavy elastica, B θ'' = ρ_A g (L − s) cos θ, solved as a boundary-value problem (scipy)",
    mark=relative(0.03),
    draw=draw,
)
def heavy_cantilever(fast: bool) -> Outcome:
    rows, data = [], {}
    scenes = [(2e-4, 0.0), (1e-3, 0.0), (5e-5, 0.0), (2e-4, 45.0)]
    for bending, degrees in scenes[:1] if fast else scenes:
        name = f"B = {bending:.0e} N m" + (", bias" if degrees else "")
        truth = closed_forms.heavy_elastica(bending, DENSITY, FREE)
        for edge in (5e-3,) if fast else (5e-3, 2.5e-3):
            profile = cantilever(bending, degrees, edge)
            tip, label = 1e3 * profile[:, -1], f"{name}, edges {1e3 * edge:g} mm"
            coarse = edge > 2.5e-3 and not fast
            rows.append(Row(f"sag, {label}", -tip[1], -1e3 * truth.height[-1], "mm", finding=coarse))
            rows.append(Row(f"reach, {label}", tip[0], 1e3 * truth.along[-1], "mm", finding=coarse))
        if not degrees:
            data[f"truth {name}"] = np.array([truth.along, truth.height])
            data[f"measured {name}"] = profile
    note = (
        "Strip of 95 mm x 20 mm beyond its clamp, 0.2 kg/m²; the bias strip's warp lies at 45°. Two rows of vertices"
        " are held and the clamp's root is taken at the second: it is soft over a part of an edge, which is the error."
        " The finest edge is judged; the coarse one shows the order."
    )
    return Outcome(rows, data, note)
