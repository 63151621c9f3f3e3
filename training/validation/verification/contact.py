"""Contact between layers: gap, no pass-through, friction, folding. Sizes are such that the cases run in minutes."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

import torchcloth as tc
from torchcloth._utils.constants import STANDARD_GRAVITY_M_PER_S2
from torchcloth.dynamics.contact import compression_at, layer_pressure

from . import closed_forms
from .case_figures import MEASURED_COLOUR, SECOND_COLOUR
from .registry import AT_LEAST_TRUTH, AT_MOST_TRUTH, FigureData, Outcome, Row, absolute, register_case, relative
from .scenes import indices_where, smooth_step, stack_sheets, stationary_trajectory, translation_trajectory

# k h = 75 N/m lets a 3 mm grid step by about 0.1 ms: dt ~ spacing sqrt(rho_A / (k h))
LAYER_STIFFNESS_N_PER_M, CONTACT_STIFFNESS_N_PER_M, SHEAR_STIFFNESS_N_PER_M = 150.0, 75.0, 20.0
LAYER_DENSITY_KG_PER_M2, LAYER_THICKNESS_M = 0.2, 1e-3
FAR_GAP_SPACINGS = 2.6  # at which layers begin that are pressed together


def make_material(cone: float = 0.3) -> tc.materials.AEP:
    """Return the material of the layers."""
    return tc.materials.AEP(
        LAYER_STIFFNESS_N_PER_M / LAYER_THICKNESS_M,
        0.3,
        contact_stiffness=CONTACT_STIFFNESS_N_PER_M / LAYER_THICKNESS_M,
        shear_stiffness=SHEAR_STIFFNESS_N_PER_M / LAYER_THICKNESS_M,
        cone=cone,
        thickness=LAYER_THICKNESS_M,
    )


def make_two_sheets(
    spacing: float,
    gravity: tuple[float, float, float] = (0.0, 0.0, -STANDARD_GRAVITY_M_PER_S2),
    cone: float = 0.3,
    height: float = 0.015,
) -> tuple[tc.Cloth, int]:
    """Return a 50 mm sheet above a pinned one of 70 mm as one cloth, and the number of pinned vertices."""
    lower = tc.meshes.rectangle(0.07, 0.07, resolution=(7, 7))
    upper = tc.meshes.rectangle(0.05, 0.05, resolution=(5, 5))
    count = len(lower.vertices)
    cloth = tc.Cloth(
        stack_sheets(lower, upper, (0.0104, 0.0097, height)),
        make_material(cone),
        LAYER_DENSITY_KG_PER_M2,
        {
            "gravity": tc.effects.Gravity(gravity),
            "air": tc.effects.AirDrag(1.2),
            "bending": tc.effects.Bending(1e-5, 5e-3),
        },
        {"pin": tc.boundaries.Grasp(range(count))},
        tc.Contact(spacing=spacing),
    )
    return cloth, count


def simulate_drop(spacing: float, speed: float, duration: float) -> tuple[tc.Rollout, tc.ClothState, int]:
    """Return frames of the fall and impact, the state at rest, and the number of pinned vertices."""
    cloth, count = make_two_sheets(spacing)
    v = torch.zeros(len(cloth.mesh.vertices), 3)
    v[count:, 2] = -speed
    with torch.no_grad():
        out = cloth(
            cloth.state(cloth.rest_state().x, v),
            {"pin": stationary_trajectory()},
            times=torch.linspace(0, duration, 41),
        )
        rest = cloth.settle(out.state, {"pin": stationary_trajectory()}, duration=0.25, rate=40.0)
    return out, rest, count


def press_layers(gap: float, place: np.ndarray, turn: Rotation) -> tuple[float, float]:
    """Return the mean compression of the directors, and the pressure over k h / spacing, of held layers at a gap.

    Args:
        gap: at the end [grid spacings]. Layers come from beyond each other's reach.
        place: [3] of the lower layer in the grid [grid spacings].
        turn: of both layers in the grid.
    """
    size, spacing = 0.05, 5e-3
    sheet = tc.meshes.rectangle(size, size, resolution=(9, 9))
    mesh = stack_sheets(sheet, sheet, (0.0, 0.0, FAR_GAP_SPACINGS * spacing))
    mesh = tc.meshes.Mesh.build(turn.apply(mesh.vertices) + spacing * place, mesh.faces, mesh.uv)
    count, normal = len(sheet.vertices), torch.as_tensor(turn.apply([0.0, 0.0, 1.0]))
    grasps = {"low": tc.boundaries.Grasp(range(count)), "high": tc.boundaries.Grasp(range(count, 2 * count))}
    contact = tc.Contact(spacing=spacing, damping=0.0)
    cloth = tc.Cloth(mesh, make_material(), LAYER_DENSITY_KG_PER_M2, boundaries=grasps, contact=contact)
    t = torch.linspace(0, 0.04, 17)
    approach = (FAR_GAP_SPACINGS - gap) * spacing * smooth_step(t / 0.02)
    motion = {"low": stationary_trajectory(), "high": translation_trajectory(t, -approach[:, None] * normal)}
    with torch.no_grad():
        out = cloth(cloth.rest_state(), motion, times=[0.0, 0.03, 0.04])
    pressure = float(out.wrench["high"][-1, :3] @ normal) / size**2
    return 1 - float((out.state.d3 @ normal).abs().mean()), pressure * spacing / CONTACT_STIFFNESS_N_PER_M


def draw_press(figure: Any, data: FigureData) -> None:
    """Draw the pressure between layers over their distance."""
    axis = figure.subplots()
    axis.plot(data["gap"], data["closed"], color="k", lw=1, label="closed form")
    axis.plot(data["flat_gap"], data["flat"], "o", ms=4, color=MEASURED_COLOUR, label="along the grid, any place")
    axis.plot(data["turned_gap"], data["turned"], "x", ms=5, color=SECOND_COLOUR, label="turned, any place")
    axis.set(xlabel="distance of the layers [grid spacings]", ylabel="pressure · spacing / (k h)")
    axis.legend()


@register_case(
    "press-of-layers",
    "Layers pressed together at any place and in any attitude in the grid",
    truth="closed form: mean over all places of the grid",
    draw=draw_press,
)
def press_of_layers(fast: bool) -> Outcome:
    """Measure the pressure of held layers at random places and attitudes."""
    rng, places = np.random.default_rng(0), 2 if fast else 4
    gaps = np.repeat([0.6, 0.8, 1.0, 1.2], places)
    free = tc.Contact().free_compression
    data = {"gap": np.linspace(0.4, 2.0, 81)}
    data["closed"] = layer_pressure(data["gap"], free)
    expected, rows = layer_pressure(gaps, free), []
    for name, label, tolerance in (("flat", "along the grid", 0.05), ("turned", "turned", 0.12)):
        measured = []
        for gap in gaps:
            turn = Rotation.random(None, rng) if name == "turned" else Rotation.identity()
            measured.append(press_layers(gap, rng.uniform(size=3), turn))
        compression, pressure = np.array(measured).T
        off = np.abs(compression - compression_at(torch.as_tensor(gaps)).numpy()).max()
        rows.append(Row(f"largest error of the compression, {label}", float(off), 0.0, "", absolute(0.01)))
        ratio, what = pressure / expected, f"pressure over that of the closed form, {label}"
        for extreme, value in (("smallest", ratio.min()), ("largest", ratio.max())):
            rows.append(Row(f"{extreme} {what}", float(value), 1.0, "", relative(tolerance)))
        data |= {name: pressure, f"{name}_gap": gaps}
    note = f"{len(gaps)} places each, at gaps of 0.6 to 1.2 spacings. The grid lies elsewhere in every substep."
    return Outcome(rows, data, note)


def draw_drop(figure: Any, data: FigureData) -> None:
    """Draw the heights of the falling sheet over time."""
    axis = figure.subplots()
    axis.fill_between(
        data["t"],
        data["lowest"],
        data["highest"],
        color=MEASURED_COLOUR,
        alpha=0.3,
        lw=0,
        label="lowest to highest vertex",
    )
    axis.plot(data["t"], data["mean"], color=MEASURED_COLOUR, label="mean")
    axis.axhline(0, color="k", lw=1)
    axis.axhline(5, color=SECOND_COLOUR, lw=0.8, ls=":", label="5 mm")
    axis.set(xlabel="time [s]", ylabel="height over the pinned sheet [mm]")
    axis.legend()


@register_case(
    "drop-on-sheet",
    "Sheet dropped on a pinned sheet at 2 m/s",
    truth="impenetrability: it comes to rest above, and no vertex goes through",
    draw=draw_drop,
    fast=False,
)
def drop_on_sheet(fast: bool) -> Outcome:
    """Measure the gap at rest and the lowest vertex."""
    spacing = 3e-3
    out, rest, count = simulate_drop(spacing, 2.0, 0.12)
    height = 1e3 * out.x[:, count:, 2]
    end = 1e3 * float(rest.x[count:, 2].mean())
    rows = [
        Row("gap at rest", end, 5.0, "mm", AT_MOST_TRUTH),
        Row("gap at rest", end / (1e3 * spacing), unit="Δx", finding=True),
        Row(
            "height 0.12 s after the release, before it is damped to rest",
            float(height[-1].mean()),
            unit="mm",
            finding=True,
        ),
        Row("lowest vertex in the impact", float(height.min()), 0.0, "mm", AT_LEAST_TRUTH),
        Row("lowest vertex at rest", 1e3 * float(rest.x[count:, 2].min()), 0.0, "mm", AT_LEAST_TRUTH),
    ]
    data = {
        "t": out.t.numpy(),
        "lowest": height.amin(1).numpy(),
        "highest": height.amax(1).numpy(),
        "mean": height.mean(1).numpy(),
    }
    return Outcome(
        rows,
        data,
        f"Contact spacing {1e3 * spacing:g} mm, k h = {CONTACT_STIFFNESS_N_PER_M:g} N/m, "
        f"{LAYER_DENSITY_KG_PER_M2:g} kg/m².",
    )


@register_case(
    "friction-of-layers",
    "Friction cone of layers by tilting",
    truth="Coulomb with the cone's coefficient: sticks below arctan c_F; above, g (sin α − c_F cos α) t²/2",
    fast=False,
)
def friction_of_layers(fast: bool) -> Outcome:
    """Measure how far the upper sheet slides in 0.15 s after gravity is tilted.

    The tolerance is a fifth of a slide without friction.
    """
    cone, t, spacing = 0.3, 0.15, 5e-3
    cloth, count = make_two_sheets(spacing, cone=cone, height=1.5 * spacing)
    with torch.no_grad():
        rest = cloth.settle(cloth.rest_state(), {"pin": stationary_trajectory()}, duration=0.3, rate=40.0)
    rows = []
    for ratio in (0.5, 2.0, 4.0):
        angle = math.atan(cone * ratio)
        gravity = (STANDARD_GRAVITY_M_PER_S2 * math.sin(angle), 0.0, -STANDARD_GRAVITY_M_PER_S2 * math.cos(angle))
        tilted, _ = make_two_sheets(spacing, gravity, cone, 1.5 * spacing)
        with torch.no_grad():
            out = tilted(rest, {"pin": stationary_trajectory()}, times=[0.0, t])
        displacement = float((out.x[-1] - rest.x)[count:, 0].mean())
        truth = closed_forms.sliding_distance(angle, cone, t)
        free = closed_forms.sliding_distance(angle, 0.0, t)
        rows.append(
            Row(
                f"displacement at tan α = {ratio:g} c_F, {'slides' if truth else 'sticks'}",
                1e3 * displacement,
                1e3 * truth,
                "mm",
                absolute(200 * free),
            )
        )
    note = (
        f"c_F = {cone:g}, contact spacing {1e3 * spacing:g} mm, {t:g} s. The tolerance is a fifth of the displacement"
        " without friction."
    )
    return Outcome(rows, note=note)


def make_sheet_on_table(size: float, n: int, spacing: float, grasps: dict[str, list[int]]) -> tc.Cloth:
    """Return a square sheet of ``size`` m and n x n vertices on a table."""
    boundaries = {name: tc.boundaries.Grasp(index) for name, index in grasps.items()}
    return tc.Cloth(
        tc.meshes.rectangle(size, size, resolution=(n, n)),
        make_material(),
        LAYER_DENSITY_KG_PER_M2,
        {"gravity": tc.effects.Gravity(), "air": tc.effects.AirDrag(1.2), "bending": tc.effects.Bending(1e-6, 5e-3)},
        {**boundaries, "table": tc.boundaries.Plane(friction=0.6)},
        tc.Contact(spacing=spacing),
    )


def fold_trajectory(
    t: Tensor, start: float, end: float, direction: int, size: float, height: float, release: float
) -> tc.Trajectory:
    """Return the trajectory of an edge that goes over in a half circle, to ``height`` above the other edge.

    The gripper opens at ``release`` [s].
    """
    turn = math.pi * smooth_step((t - start) / (end - start))
    position = torch.zeros(len(t), 3)
    position[:, direction] = size / 2 * (turn.cos() - 1)
    position[:, 2] = (size / 2) * turn.sin() + height * turn / math.pi
    return translation_trajectory(t, position, (t >= start) & (t < release))


@register_case(
    "fold-and-unfold",
    "A sheet folded and unfolded returns",
    truth="elasticity: compressed directors recover (d₃ = n), and the sheet returns to its place",
    fast=False,
)
def fold_and_unfold(fast: bool) -> Outcome:
    """Fold an edge over, press it on the layer below, and fold it back."""
    size, n, spacing = 0.10, 11, 6e-3
    mesh = tc.meshes.rectangle(size, size, resolution=(n, n))
    u = mesh.vertices[:, 0]
    cloth = make_sheet_on_table(
        size, n, spacing, {"left": indices_where(u < 1e-9), "right": indices_where(u > size - 1e-9)}
    )
    t = torch.linspace(0, 2.0, 401)
    over = fold_trajectory(t, 0.0, 0.5, 0, size, 0.5 * spacing, 9.0)
    back = fold_trajectory(1.2 - t, 0.0, 0.5, 0, size, 0.5 * spacing, 9.0)
    pose = torch.where((t < 0.6)[:, None, None], over.pose, back.pose)
    motion = {"left": stationary_trajectory(), "right": tc.Trajectory(t, pose, torch.ones(len(t), dtype=torch.bool))}
    state, energies = cloth.rest_state(), []
    with torch.no_grad():
        for k in range(14):
            state = cloth(state, motion, times=[0.1 * k, 0.1 * (k + 1)]).state
            energies.append(float(cloth.energy(state)["director"]))
    n_end = cloth.state(state.x).d3
    displacement = 1e3 * float((state.x - cloth.rest_state().x).norm(dim=-1).max())
    rows = [
        Row("director energy at the end over its peak", 100 * energies[-1] / max(energies), 0.0, "%", absolute(1.0)),
        Row(
            "R₃₃ − 1 at the end, largest",
            float(((state.d3 * n_end).sum(-1) - 1).abs().max()),
            0.0,
            tolerance=absolute(0.01),
        ),
        Row("largest displacement from the start", displacement, 0.0, "mm", absolute(1.0)),
        Row("director energy at its peak", 1e3 * max(energies), unit="mJ", finding=True),
        Row("director energy at the end", 1e3 * energies[-1], unit="mJ", finding=True),
    ]
    note = (
        f"{size:g} m sheet on a table, held at two edges, contact spacing {1e3 * spacing:g} mm; tolerances are this"
        " page's."
    )
    return Outcome(rows, note=note)
