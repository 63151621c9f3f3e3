"""Layers on layers: gap, no pass-through, friction, folding. Sizes are such that the cases run in minutes."""

from __future__ import annotations

import math

import torch
from torch import Tensor

import torchcloth as tc

from . import closed_forms
from .case_figures import MEASURED, OTHER
from .registry import AT_LEAST, AT_MOST, Outcome, Row, absolute, case
from .scenes import path, smooth, stacked, still, where

# k h = 75 N/m lets a 3 mm grid step by about 0.1 ms: dt ~ spacing sqrt(rho_A / (k h))
STIFFNESS, CONTACT, SHEAR, DENSITY, THICKNESS = 150.0, 75.0, 20.0, 0.2, 1e-3


def material(cone: float = 0.3) -> tc.materials.AEP:
    return tc.materials.AEP(STIFFNESS / THICKNESS, 0.3, CONTACT / THICKNESS, SHEAR / THICKNESS, cone, THICKNESS)


def pair(spacing: float, gravity=(0.0, 0.0, -9.81), cone: float = 0.3, height: float = 0.015) -> tuple[tc.Cloth, int]:
    """(a 50 mm sheet above a pinned one of 70 mm as one cloth, number of the pinned vertices)."""
    lower = tc.meshes.rectangle(0.07, 0.07, resolution=(7, 7))
    upper = tc.meshes.rectangle(0.05, 0.05, resolution=(5, 5))
    count = len(lower.vertices)
    cloth = tc.Cloth(
        stacked(lower, upper, (0.0104, 0.0097, height)),
        material(cone),
        DENSITY,
        {
            "gravity": tc.effects.Gravity(gravity),
            "air": tc.effects.AirDrag(1.2),
            "bending": tc.effects.Bending(1e-5, 5e-3),
        },
        {"pin": tc.boundaries.Grasp(range(count))},
        tc.Contact(spacing=spacing),
    )
    return cloth, count


def dropped(spacing: float, speed: float, duration: float) -> tuple[tc.Rollout, tc.ClothState, int]:
    """(frames of the fall and impact, state at rest, number of the pinned vertices)."""
    cloth, count = pair(spacing)
    v = torch.zeros(len(cloth.mesh.vertices), 3)
    v[count:, 2] = -speed
    with torch.no_grad():
        out = cloth(cloth.state(cloth.rest_state().x, v), {"pin": still()}, times=torch.linspace(0, duration, 41))
        rest = cloth.settle(out.state, {"pin": still()}, duration=0.25, rate=40.0)
    return out, rest, count


def draw_drop(figure, data) -> None:
    axis = figure.subplots()
    axis.fill_between(
        data["t"], data["lowest"], data["highest"], color=MEASURED, alpha=0.3, lw=0, label="lowest to highest vertex"
    )
    axis.plot(data["t"], data["mean"], color=MEASURED, label="mean")
    axis.axhline(0, color="k", lw=1)
    axis.axhline(5, color=OTHER, lw=0.8, ls=":", label="5 mm")
    axis.set(xlabel="time [s]", ylabel="height over the pinned sheet [mm]")
    axis.legend()


@case(
    "drop-on-sheet",
    "Sheet dropped on a pinned sheet at 2 m/s",
    truth="matter: it comes to rest above, and no vertex goes through",
    draw=draw_drop,
    fast=False,
)
def drop_on_sheet(fast: bool) -> Outcome:
    spacing = 3e-3
    out, rest, count = dropped(spacing, 2.0, 0.12)
    height = 1e3 * out.x[:, count:, 2]
    end = 1e3 * float(rest.x[count:, 2].mean())
    rows = [
        Row("gap at rest", end, 5.0, "mm", AT_MOST),
        Row("gap at rest", end / (1e3 * spacing), unit="Δx", finding=True),
        Row(
            "height 0.12 s after the release, before it is damped to rest",
            float(height[-1].mean()),
            unit="mm",
            finding=True,
        ),
        Row("lowest vertex in the impact", float(height.min()), 0.0, "mm", AT_LEAST),
        Row("lowest vertex at rest", 1e3 * float(rest.x[count:, 2].min()), 0.0, "mm", AT_LEAST),
    ]
    data = {
        "t": out.t.numpy(),
        "lowest": height.amin(1).numpy(),
        "highest": height.amax(1).numpy(),
        "mean": height.mean(1).numpy(),
    }
    return Outcome(rows, data, f"Contact spacing {1e3 * spacing:g} mm, k h = {CONTACT:g} N/m, {DENSITY:g} kg/m².")


@case(
    "friction-of-layers",
    "Friction cone of layers by tilting",
    truth="Coulomb with the cone's coefficient: sticks below arctan c_F; above, g (sin α − c_F cos α) t²/2",
    fast=False,
)
def friction_of_layers(fast: bool) -> Outcome:
    """Rests on the pinned sheet, then gravity tilts; the upper sheet's way in 0.15 s. Mark: a fifth of a free slide."""
    cone, t, spacing = 0.3, 0.15, 5e-3
    cloth, count = pair(spacing, cone=cone, height=1.5 * spacing)
    with torch.no_grad():
        rest = cloth.settle(cloth.rest_state(), {"pin": still()}, duration=0.3, rate=40.0)
    rows = []
    for ratio in (0.5, 2.0, 4.0):
        angle = math.atan(cone * ratio)
        gravity = (9.81 * math.sin(angle), 0.0, -9.81 * math.cos(angle))
        tilted, _ = pair(spacing, gravity, cone, 1.5 * spacing)
        with torch.no_grad():
            out = tilted(rest, {"pin": still()}, times=[0.0, t])
        way = float((out.x[-1] - rest.x)[count:, 0].mean())
        truth = closed_forms.slide(angle, cone, t)
        free = closed_forms.slide(angle, 0.0, t)
        rows.append(
            Row(
                f"way at tan α = {ratio:g} c_F, {'slides' if truth else 'sticks'}",
                1e3 * way,
                1e3 * truth,
                "mm",
                absolute(200 * free),
            )
        )
    note = f"c_F = {cone:g}, contact spacing {1e3 * spacing:g} mm, {t:g} s; mark: a fifth of the way without friction."
    return Outcome(rows, note=note)


def on_table(size: float, n: int, spacing: float, grasps: dict[str, list[int]]) -> tc.Cloth:
    boundaries = {name: tc.boundaries.Grasp(index) for name, index in grasps.items()}
    return tc.Cloth(
        tc.meshes.rectangle(size, size, resolution=(n, n)),
        material(),
        DENSITY,
        {"gravity": tc.effects.Gravity(), "air": tc.effects.AirDrag(1.2), "bending": tc.effects.Bending(1e-6, 5e-3)},
        {**boundaries, "table": tc.boundaries.Plane(friction=0.6)},
        tc.Contact(spacing=spacing),
    )


def carry(
    t: Tensor, start: float, end: float, direction: int, size: float, height: float, release: float
) -> tc.Trajectory:
    """An edge carried over in a half circle about the middle, to ``height`` above where the other edge lies; let go."""
    turn = math.pi * smooth((t - start) / (end - start))
    way = torch.zeros(len(t), 3)
    way[:, direction] = size / 2 * (turn.cos() - 1)
    way[:, 2] = (size / 2) * turn.sin() + height * turn / math.pi
    return path(t, way, (t >= start) & (t < release))


@case(
    "fold-and-unfold",
    "A sheet folded and unfolded returns",
    truth="elastic: pressed directors stand up again (d₃ = n), and the sheet lies where it lay",
    fast=False,
)
def fold_and_unfold(fast: bool) -> Outcome:
    """An edge is carried over, pressed on the layer below, and carried back."""
    size, n, spacing = 0.10, 11, 6e-3
    mesh = tc.meshes.rectangle(size, size, resolution=(n, n))
    u = mesh.uv[:, 0]
    cloth = on_table(size, n, spacing, {"left": where(u < 1e-9), "right": where(u > size - 1e-9)})
    t = torch.linspace(0, 2.0, 401)
    over = carry(t, 0.0, 0.5, 0, size, 0.5 * spacing, 9.0)
    back = carry(1.2 - t, 0.0, 0.5, 0, size, 0.5 * spacing, 9.0)
    pose = torch.where((t < 0.6)[:, None, None], over.pose, back.pose)
    motion = {"left": still(), "right": tc.Trajectory(t, pose, torch.ones(len(t), dtype=torch.bool))}
    state, energies, reached = cloth.rest_state(), [], []
    with torch.no_grad():
        for k in range(14):
            state = cloth(state, motion, times=[0.1 * k, 0.1 * (k + 1)]).state
            energies.append(float(cloth.energy(state)["director"]))
            reached.append(state.x)
    n_end = cloth.state(state.x).d3
    away = 1e3 * float((state.x - cloth.rest_state().x).norm(dim=-1).max())
    rows = [
        Row("director energy at the end over its peak", 100 * energies[-1] / max(energies), 0.0, "%", absolute(1.0)),
        Row(
            "R₃₃ − 1 at the end, largest", float(((state.d3 * n_end).sum(-1) - 1).abs().max()), 0.0, mark=absolute(0.01)
        ),
        Row("farthest vertex from where it lay", away, 0.0, "mm", absolute(1.0)),
        Row("director energy at its peak", 1e3 * max(energies), unit="mJ", finding=True),
        Row("director energy at the end", 1e3 * energies[-1], unit="mJ", finding=True),
    ]
    note = (
        f"{size:g} m sheet on a table, held at two edges, contact spacing {1e3 * spacing:g} mm; marks are this page's."
    )
    return Outcome(rows, note=note)
