"""Self-convergence over a swing: step, mesh, and position of the contact grid."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

import torchcloth as tc
from torchcloth._utils.constants import STANDARD_GRAVITY_M_PER_S2

from .apic import APICCloth
from .case_figures import line_colour
from .registry import FigureData, Outcome, Row, absolute, register_case
from .scenes import rms_distance, rotation_matrix, translation_trajectory

SWING_SIDE_M, COARSE_NODES = 0.5, 15
COARSE_EDGE_M = SWING_SIDE_M / (COARSE_NODES - 1)
PATCH_RADIUS_M = COARSE_EDGE_M * 1.01  # of the held patches: the same piece of cloth on every mesh
STEP_TOLERANCE, MESH_TOLERANCE = absolute(1.0), absolute(5.0)  # mm
LIBRARY_SCHEME = "mesh elasticity, grid contact"


@dataclass(frozen=True)
class Swing:
    """A 0.5 m sheet held by patches at its upper corners, swung along its normal by 0.10 m sin(2 pi t) for 1 s.

    Attributes:
        n: vertices along a side.
        dt: s.
        spacing: m, of the contact grid; None: no contact.
        contact_stiffness: Pa at a thickness of 1 mm: k h = 100 N/m.
        bending: N m.
        shift: of the scene along (1, 1, 1), in spacings: the same as moving the grid.
        turn: degrees, of the scene about (1, 2, 3): the same as turning the grid.
        duration: s.
        grid: further arguments of Contact.
        cloth_type: scheme of the simulation.
    """

    n: int = COARSE_NODES
    dt: float = 1e-4
    spacing: float | None = None
    contact_stiffness: float = 1e5
    bending: float = 3e-5
    shift: float = 0.0
    turn: float = 0.0
    duration: float = 1.0
    grid: Mapping[str, Any] = field(default_factory=dict)
    cloth_type: type[tc.Cloth] = tc.Cloth

    def simulate(self) -> Tensor:
        """Return frames [T, 15 * 15, 3] m of the vertices that all meshes share, without shift and turn."""
        turn = rotation_matrix((1.0, 2.0, 3.0), self.turn)
        offset = self.shift * (self.spacing or COARSE_EDGE_M) * torch.ones(3)
        cloth = self.make_cloth(tuple((turn @ torch.tensor([0.0, 0.0, -STANDARD_GRAVITY_M_PER_S2])).tolist()))
        u, v = torch.as_tensor(cloth.mesh.uv).T
        x = torch.stack([0 * u, u, v], dim=-1) @ turn.mT + offset
        t = torch.linspace(0, self.duration, round(200 * self.duration) + 1)
        displacement = 0.10 * torch.sin(2 * math.pi * t)[:, None] * torch.tensor([1.0, 0.0, 0.0])
        motion = translation_trajectory(t, displacement @ turn.mT)  # only the path's increments move the cloth
        times = torch.linspace(0, self.duration, round(50 * self.duration) + 1)
        with torch.no_grad():
            out = cloth(cloth.state(x), {"left": motion, "right": motion}, times=times, dt=self.dt)
        stride = (self.n - 1) // (COARSE_NODES - 1)
        shared = out.x.unflatten(1, (self.n, self.n))[:, ::stride, ::stride].flatten(1, 2)
        return (shared - offset) @ turn

    def make_cloth(self, gravity: tuple[float, ...]) -> tc.Cloth:
        """Return the sheet with gravity [3] m/s^2."""
        effects = {
            "gravity": tc.effects.Gravity(gravity),
            "air": tc.effects.AirDrag(1.2),
            "bending": tc.effects.Bending(self.bending, damping_time=5e-3),
        }
        corners = {
            "left": tc.boundaries.Grasp.corner("upper-left", radius=PATCH_RADIUS_M),
            "right": tc.boundaries.Grasp.corner("upper-right", radius=PATCH_RADIUS_M),
        }
        return self.cloth_type(
            tc.meshes.rectangle(SWING_SIDE_M, SWING_SIDE_M, resolution=(self.n, self.n)),
            tc.materials.AEP(6.09e5, 0.3, contact_stiffness=self.contact_stiffness, shear_stiffness=2.5e4),
            0.15,
            effects,
            corners,
            None if self.spacing is None else tc.Contact(self.spacing, **self.grid),
        )


class SwingComparison:
    """RMS differences between swings. Each swing is simulated once.

    Attributes:
        data: [T] mm, RMS over the vertices by label, and the times "t" [T] s.
    """

    def __init__(self) -> None:
        self._frames: dict[str, Tensor] = {}
        self.data: dict[str, np.ndarray] = {}

    def frames(self, swing: Swing) -> Tensor:
        """Return the frames of a swing."""
        key = repr(swing)
        if key not in self._frames:
            self._frames[key] = swing.simulate()
        return self._frames[key]

    def __call__(self, label: str, a: Swing, b: Swing) -> float:
        """Return the RMS over all shared vertices and frames [mm], and store its course over time."""
        first, second = self.frames(a), self.frames(b)
        self.data[label] = 1e3 * (first - second).square().sum(-1).mean(-1).sqrt().numpy()
        self.data["t"] = np.linspace(0, a.duration, len(first))
        return 1e3 * rms_distance(first, second)


def draw_figure(figure: Any, data: FigureData) -> None:
    """Draw the differences over time."""
    axis = figure.subplots()
    names = [name for name in data if name != "t"]
    for k, name in enumerate(names):
        axis.plot(data["t"], data[name], color=line_colour(k), lw=1.2, ls="-" if k < 7 else "--", label=name)
    axis.set(xlabel="time [s]", ylabel="RMS over the vertices [mm]", ylim=(0, None))
    axis.legend(fontsize=7)


SWING_DESCRIPTION = (
    "0.5 m sheet, 15² vertices, Y = 609 N/m, ν = 0.3, 0.15 kg/m², air C_n = 1.2, swung by patches of 36 mm at two"
    " corners, ±0.10 m at 1 Hz for 1 s from a standing start (the corners jump to 0.63 m/s). RMS over all shared"
    " vertices and 51 frames."
)
BENDING_DESCRIPTION = " Bending 3e-5 N m with 5 ms damping."
FINER_TRUTH = "the same scene on a finer discretisation"


def compare_steps_and_meshes(base: Swing, fast: bool) -> tuple[SwingComparison, list[tuple[str, float, Any]]]:
    """Return the comparison, and (label, difference [mm], tolerance) for halved steps and refined meshes."""
    compare, differences = SwingComparison(), []
    half, quarter = replace(base, dt=base.dt / 2), replace(base, dt=base.dt / 4)
    for a, b in ((base, half), (half, quarter)):
        label = f"Δt {1e3 * a.dt:g} → {1e3 * b.dt:g} ms"
        differences.append((label, compare(label, a, b), STEP_TOLERANCE))
    for n in (COARSE_NODES,) if fast else (COARSE_NODES, 2 * COARSE_NODES - 1):
        label = f"mesh {n}² → {2 * n - 1}²"
        differences.append((label, compare(label, replace(half, n=n), replace(half, n=2 * n - 1)), MESH_TOLERANCE))
    return compare, differences


@register_case("convergence", "Step halved, mesh halved", truth=FINER_TRUTH, draw=draw_figure)
def convergence(fast: bool) -> Outcome:
    """Compare halved steps and refined meshes."""
    compare, differences = compare_steps_and_meshes(Swing(duration=0.2 if fast else 1.0), fast)
    rows = [Row(label, value, 0.0, "mm", tolerance) for label, value, tolerance in differences]
    return Outcome(rows, compare.data, SWING_DESCRIPTION + BENDING_DESCRIPTION + " A sheet alone, without contact.")


@register_case(
    "convergence-without-bending",
    "Step halved, mesh halved, without bending",
    truth=FINER_TRUTH,
    draw=draw_figure,
    fast=False,
)
def convergence_without_bending(fast: bool) -> Outcome:
    """Compare halved steps and refined meshes of a membrane alone."""
    compare, differences = compare_steps_and_meshes(Swing(bending=0.0), True)
    rows = [Row(label, value, 0.0, "mm", finding=True) for label, value, _ in differences]
    note = (
        " A membrane without bending buckles at the length of an edge on every mesh, so it has no limit to converge to."
    )
    return Outcome(rows, compare.data, SWING_DESCRIPTION + note)


def grid_comparisons(base: Swing) -> list[tuple[str, Swing, Swing, bool]]:
    """Return (label, first swing, second swing, whether there is a tolerance)."""
    return [
        ("Δt 0.2 → 0.1 ms", base, replace(base, dt=base.dt / 2), True),
        ("Δx × 1.3", base, replace(base, spacing=1.3 * COARSE_EDGE_M), True),
        ("grid shifted by 0.37 Δx", base, replace(base, shift=0.37), True),
        ("grid turned by 37°", base, replace(base, turn=37.0), True),
        ("k halved", base, replace(base, contact_stiffness=base.contact_stiffness / 2), False),
    ]


SCHEMES: dict[str, dict[str, Any]] = {  # arguments of Swing
    LIBRARY_SCHEME: {},
    "the same, grid everywhere": {"grid": {"everywhere": True}},
    "APIC, all through the grid": {"cloth_type": APICCloth},
}


@register_case(
    "convergence-grid", "Position and spacing of the contact grid", truth=FINER_TRUTH, draw=draw_figure, fast=False
)
def convergence_grid(fast: bool) -> Outcome:
    """Compare the library's scheme, which has a tolerance, with other schemes."""
    compare, rows, table = SwingComparison(), [], []
    for scheme, options in SCHEMES.items():
        values = []
        for label, a, b, has_tolerance in grid_comparisons(Swing(spacing=COARSE_EDGE_M, dt=2e-4, **options)):
            values.append(compare(label if scheme == LIBRARY_SCHEME else f"{scheme}: {label}", a, b))
            finding = scheme != LIBRARY_SCHEME or not has_tolerance
            rows.append(Row(f"{label}, {scheme}", values[-1], 0.0, "mm", STEP_TOLERANCE, finding))
        table.append((scheme, values))
    head = [label for label, *_ in grid_comparisons(Swing(spacing=COARSE_EDGE_M))]
    lines = ["| RMS in mm | " + " | ".join(head) + " |", "|---" * (len(head) + 1) + "|"]
    lines += [f"| {scheme} | " + " | ".join(f"{value:.2g}" for value in values) + " |" for scheme, values in table]
    note = (
        SWING_DESCRIPTION
        + BENDING_DESCRIPTION
        + f" Contact grid: {1e3 * COARSE_EDGE_M:.0f} mm, k h = 100 N/m. Layers never touch here.\n\n"
    )
    curves = {k: v for k, v in compare.data.items() if k == "t" or "Δt" in k or "shifted" in k}
    return Outcome(rows, curves, note + "\n".join(lines))
