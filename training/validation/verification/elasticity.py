"""Strips in tension against the closed-form membrane."""

from __future__ import annotations

import numpy as np
import torch

import torchcloth as tc

from . import closed_forms
from .case_figures import against
from .registry import Outcome, Row, case, relative
from .scenes import path, smooth, still, strip, where

STIFFNESS, POISSON, LENGTH, WIDTH = 600.0, 0.3, 0.20, 0.05
STRAINS = (0.01, 0.03, 0.05, 0.10)


def pull(degrees: float, fast: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(strain in the middle, contraction there, force per width [N/m]) at rest, each [4], of a held strip."""
    resolution = (25, 7) if fast else (49, 13)
    mesh = strip(LENGTH, WIDTH, resolution, degrees)
    u, v = mesh.vertices[:, 0], mesh.vertices[:, 1]
    cloth = tc.Cloth(
        mesh,
        tc.materials.AEP(STIFFNESS * 1e3, POISSON),
        0.2,
        {"damping": tc.effects.MassDamping(300.0)},
        {"left": tc.boundaries.Grasp(where(u < 1e-9)), "right": tc.boundaries.Grasp(where(u > LENGTH - 1e-9))},
        contact=None,
    )
    t = torch.linspace(0, 0.2, 81)
    motion = path(t, LENGTH * torch.tensor(STRAINS)[:, None, None] * smooth(t / 0.05)[:, None] * torch.eye(3)[0])
    with torch.no_grad():
        out = cloth(cloth.rest_state(), {"left": still(), "right": motion}, times=[0.0, 0.15, 0.2])
    x = out.x[:, -1]
    near = [np.abs(u - LENGTH * share) < LENGTH / 24 / 3 for share in (5 / 12, 7 / 12)]
    first, second = (x[:, where(mask), 0].mean(-1) for mask in near)
    along = ((second - first) / (LENGTH / 6)).numpy()
    middle = np.abs(u - LENGTH / 2) < 1e-9
    rows = [x[:, where(middle & edge), 1].mean(-1) for edge in (v > WIDTH - 1e-9, v < 1e-9)]
    across = ((rows[0] - rows[1]) / WIDTH).numpy()
    force = -out.wrench["right"][:, -1, 0].numpy() / WIDTH
    return along - 1, across - 1, force


def tension(degrees: float, fast: bool) -> Outcome:
    strain, contraction, force = pull(degrees, fast)
    truth = [closed_forms.uniaxial(1 + e, STIFFNESS, POISSON) for e in strain]
    rows = []
    for k, nominal in enumerate(STRAINS):
        rows.append(Row(f"force per width, {100 * nominal:.0f} % between clamps", force[k], truth[k][1], "N/m"))
    rows.append(Row("contraction in the middle, 10 %", -100 * contraction[-1], 100 * (1 - truth[-1][0]), "%"))
    line = np.linspace(0, strain.max(), 50)
    data = {"strain": strain, "force": force, "line": line}
    data["truth"] = np.array([closed_forms.uniaxial(1 + e, STIFFNESS, POISSON)[1] for e in line])
    return Outcome(rows, data, NOTE)


NOTE = (
    f"Y = {STIFFNESS:g} N/m, ν = {POISSON}, {LENGTH:g} m × {WIDTH:g} m; clamps hinder the contraction, so the truth is"
    " taken at the strain measured over the middle sixth, where the tension is uniaxial."
)


def draw(figure, data) -> None:
    axis = figure.subplots()
    against(
        axis,
        100 * data["line"],
        np.full(50, np.nan),
        data["truth"],
        ("strain in the middle [%]", "force per width [N/m]"),
    )
    axis.plot(100 * data["strain"], data["force"], "o", color="#1f6f8b")


TRUTH = "uniaxial stress of the fixed-corotated membrane, μ Σ(σ−1)² + λ/2 (J−1)² with free contraction"


@case("uniaxial-strip", "Strip in tension along the warp", truth=TRUTH, mark=relative(0.01), draw=draw)
def uniaxial_strip(fast: bool) -> Outcome:
    return tension(0.0, fast)


@case(
    "bias-strip",
    "Strip in tension at 45° to the warp",
    truth=TRUTH + "; isotropic, so the angle must not matter",
    mark=relative(0.01),
)
def bias_strip(fast: bool) -> Outcome:
    return tension(45.0, fast)


@case(
    "hanging-strip",
    "Strip that hangs under its own weight",
    truth="ρ_A g L² / (2 Y), at depth s ρ_A g (L s − s²/2) / Y; the clamp carries the weight",
    mark=relative(0.02),
    draw=lambda figure, data: against(
        figure.subplots(), data["depth"], data["measured"], data["truth"], ("depth [m]", "displacement [mm]")
    ),
)
def hanging_strip(fast: bool) -> Outcome:
    stiffness, density, length, width = 20.0, 0.3, 0.4, 0.1
    mesh = strip(length, width, (17, 5) if fast else (33, 9))
    s = mesh.vertices[:, 0]
    cloth = tc.Cloth(
        mesh,
        tc.materials.AEP(stiffness * 1e3, 1e-3),
        density,
        {"gravity": tc.effects.Gravity((closed_forms.GRAVITY, 0.0, 0.0))},
        {"clamp": tc.boundaries.Grasp(where(s < 1e-9))},
        contact=None,
    )
    with torch.no_grad():
        state = cloth.settle(
            cloth.rest_state(),
            {"clamp": still()},
            duration=1.0,
            rate=2 * np.pi / 4 / length * (stiffness / density) ** 0.5,
        )
        out = cloth(state, {"clamp": still()}, times=[0.0, 0.01])
    moved = (out.x[-1, :, 0] - cloth.rest_state().x[:, 0]).numpy()
    end = s > length - 1e-9
    weight = density * closed_forms.GRAVITY * length * width
    depth = np.unique(s.round(9))
    data = {
        "depth": depth,
        "measured": 1e3 * np.array([moved[np.abs(s - d) < 1e-6].mean() for d in depth]),
        "truth": 1e3 * density * closed_forms.GRAVITY * (length * depth - depth**2 / 2) / stiffness,
    }
    return Outcome(
        [
            Row("lower edge", 1e3 * moved[end].mean(), 1e3 * closed_forms.sag(density, length, stiffness), "mm"),
            Row("force on the clamp", float(out.wrench["clamp"][-1, 0]), weight, "N"),
        ],
        data,
        f"Y = {stiffness:g} N/m, ρ_A = {density:g} kg/m², {length:g} m long.",
    )
