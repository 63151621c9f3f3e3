"""Elasticity: strips in tension against the closed-form membrane."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

import torchcloth as tc
from torchcloth._utils.constants import STANDARD_GRAVITY_M_PER_S2

from . import closed_forms
from .case_figures import MEASURED_COLOUR, plot_against_truth
from .registry import FigureData, Outcome, Row, register_case, relative
from .scenes import indices_where, make_strip, smooth_step, stationary_trajectory, translation_trajectory

STRIP_STIFFNESS_N_PER_M, STRIP_POISSON_RATIO, STRIP_LENGTH_M, STRIP_WIDTH_M = 600.0, 0.3, 0.20, 0.05
CLAMP_STRAINS = (0.01, 0.03, 0.05, 0.10)


def simulate_tension(degrees: float, fast: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Simulate a strip in tension until it is at rest, at four strains.

    Args:
        degrees: between the strip and the warp.
        fast: use a coarser mesh.

    Returns:
        Strain in the middle [4], lateral strain there [4], and force per width [4] N/m.
    """
    resolution = (25, 7) if fast else (49, 13)
    mesh = make_strip(STRIP_LENGTH_M, STRIP_WIDTH_M, resolution, degrees)
    u, v = mesh.vertices[:, 0], mesh.vertices[:, 1]
    cloth = tc.Cloth(
        mesh,
        tc.materials.AEP(STRIP_STIFFNESS_N_PER_M * 1e3, STRIP_POISSON_RATIO),
        0.2,
        {"damping": tc.effects.MassDamping(300.0)},
        {
            "left": tc.boundaries.Grasp(indices_where(u < 1e-9)),
            "right": tc.boundaries.Grasp(indices_where(u > STRIP_LENGTH_M - 1e-9)),
        },
        contact=None,
    )
    t = torch.linspace(0, 0.2, 81)
    motion = translation_trajectory(
        t,
        STRIP_LENGTH_M * torch.tensor(CLAMP_STRAINS)[:, None, None] * smooth_step(t / 0.05)[:, None] * torch.eye(3)[0],
    )
    with torch.no_grad():
        out = cloth(cloth.rest_state(), {"left": stationary_trajectory(), "right": motion}, times=[0.0, 0.15, 0.2])
    x = out.x[:, -1]
    columns = [np.abs(u - STRIP_LENGTH_M * fraction) < STRIP_LENGTH_M / 24 / 3 for fraction in (5 / 12, 7 / 12)]
    first, second = (x[:, indices_where(mask), 0].mean(-1) for mask in columns)
    along = ((second - first) / (STRIP_LENGTH_M / 6)).numpy()
    middle = np.abs(u - STRIP_LENGTH_M / 2) < 1e-9
    rows = [x[:, indices_where(middle & edge), 1].mean(-1) for edge in (v > STRIP_WIDTH_M - 1e-9, v < 1e-9)]
    across = ((rows[0] - rows[1]) / STRIP_WIDTH_M).numpy()
    force = -out.wrench["right"][:, -1, 0].numpy() / STRIP_WIDTH_M
    return along - 1, across - 1, force


def compare_tension(degrees: float, fast: bool) -> Outcome:
    """Compare force and contraction of a strip with the closed form."""
    strain, contraction, force = simulate_tension(degrees, fast)
    truth = [closed_forms.uniaxial_tension(1 + e, STRIP_STIFFNESS_N_PER_M, STRIP_POISSON_RATIO) for e in strain]
    rows = []
    for k, nominal in enumerate(CLAMP_STRAINS):
        rows.append(Row(f"force per width, {100 * nominal:.0f} % between clamps", force[k], truth[k][1], "N/m"))
    rows.append(Row("contraction in the middle, 10 %", -100 * contraction[-1], 100 * (1 - truth[-1][0]), "%"))
    line = np.linspace(0, strain.max(), 50)
    data = {"strain": strain, "force": force, "line": line}
    data["truth"] = np.array(
        [closed_forms.uniaxial_tension(1 + e, STRIP_STIFFNESS_N_PER_M, STRIP_POISSON_RATIO)[1] for e in line]
    )
    return Outcome(rows, data, TENSION_NOTE)


TENSION_NOTE = (
    f"Y = {STRIP_STIFFNESS_N_PER_M:g} N/m, ν = {STRIP_POISSON_RATIO}, {STRIP_LENGTH_M:g} m × {STRIP_WIDTH_M:g} m;"
    " clamps hinder the contraction. The truth is taken at the strain measured over the middle"
    " sixth, where the tension is uniaxial."
)


def draw_figure(figure: Any, data: FigureData) -> None:
    """Draw the force over the strain."""
    axis = figure.subplots()
    plot_against_truth(
        axis,
        100 * data["line"],
        np.full(50, np.nan),
        data["truth"],
        ("strain in the middle [%]", "force per width [N/m]"),
    )
    axis.plot(100 * data["strain"], data["force"], "o", color=MEASURED_COLOUR)


UNIAXIAL_TRUTH = "uniaxial stress of the fixed-corotated membrane, μ Σ(σ−1)² + λ/2 (J−1)² with free contraction"


@register_case(
    "uniaxial-strip",
    "Strip in tension along the warp",
    truth=UNIAXIAL_TRUTH,
    tolerance=relative(0.01),
    draw=draw_figure,
)
def uniaxial_strip(fast: bool) -> Outcome:
    """Measure a strip along the warp."""
    return compare_tension(0.0, fast)


@register_case(
    "bias-strip",
    "Strip in tension at 45° to the warp",
    truth=UNIAXIAL_TRUTH + "; isotropic, so the angle must not matter",
    tolerance=relative(0.01),
)
def bias_strip(fast: bool) -> Outcome:
    """Measure a strip at 45 degrees to the warp."""
    return compare_tension(45.0, fast)


@register_case(
    "hanging-strip",
    "Strip that hangs under its own weight",
    truth="ρ_A g L² / (2 Y), at depth s ρ_A g (L s − s²/2) / Y; the clamp carries the weight",
    tolerance=relative(0.02),
    draw=lambda figure, data: plot_against_truth(
        figure.subplots(), data["depth"], data["measured"], data["truth"], ("depth [m]", "displacement [mm]")
    ),
)
def hanging_strip(fast: bool) -> Outcome:
    """Measure the elongation of a hanging strip, and the force on its clamp."""
    stiffness, density, length, width = 20.0, 0.3, 0.4, 0.1
    mesh = make_strip(length, width, (17, 5) if fast else (33, 9))
    s = mesh.vertices[:, 0]
    cloth = tc.Cloth(
        mesh,
        tc.materials.AEP(stiffness * 1e3, 1e-3),
        density,
        {"gravity": tc.effects.Gravity((STANDARD_GRAVITY_M_PER_S2, 0.0, 0.0))},
        {"clamp": tc.boundaries.Grasp(indices_where(s < 1e-9))},
        contact=None,
    )
    with torch.no_grad():
        state = cloth.settle(
            cloth.rest_state(),
            {"clamp": stationary_trajectory()},
            duration=1.0,
            rate=2 * np.pi / 4 / length * (stiffness / density) ** 0.5,
        )
        out = cloth(state, {"clamp": stationary_trajectory()}, times=[0.0, 0.01])
    displacement = (out.x[-1, :, 0] - cloth.rest_state().x[:, 0]).numpy()
    end = s > length - 1e-9
    weight = density * STANDARD_GRAVITY_M_PER_S2 * length * width
    depth = np.unique(s.round(9))
    data = {
        "depth": depth,
        "measured": 1e3 * np.array([displacement[np.abs(s - d) < 1e-6].mean() for d in depth]),
        "truth": 1e3 * density * STANDARD_GRAVITY_M_PER_S2 * (length * depth - depth**2 / 2) / stiffness,
    }
    return Outcome(
        [
            Row(
                "lower edge",
                1e3 * displacement[end].mean(),
                1e3 * closed_forms.hanging_strip_elongation(density, length, stiffness),
                "mm",
            ),
            Row("force on the clamp", float(out.wrench["clamp"][-1, 0]), weight, "N"),
        ],
        data,
        f"Y = {stiffness:g} N/m, ρ_A = {density:g} kg/m², {length:g} m long.",
    )
