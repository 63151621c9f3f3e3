"""Self-convergence over a swing: step, mesh, and where contact's grid lies."""

from __future__ import annotations

import inspect
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

import torchcloth as tc

from .apic import APICCloth
from .case_figures import colour
from .registry import Outcome, Row, absolute, case
from .scenes import path, rms, rotation

SIZE, COARSE = 0.5, 15
EDGE = SIZE / (COARSE - 1)
PATCH = EDGE * 1.01  # m, radius of the held patches: the same piece of cloth on every mesh
HALVED, REFINED = absolute(1.0), absolute(5.0)  # mm
OURS = "mesh elasticity, grid contact"


@dataclass(frozen=True)
class Swing:
    """0.5 m sheet held by patches at its upper corners, swung along its normal by 0.10 m sin(2 pi t) for 1 s."""

    n: int = COARSE
    dt: float = 1e-4
    spacing: float | None = None  # contact grid [m]; None: left out
    contact_stiffness: float = 1e5  # Pa at 1 mm: k h = 100 N/m
    bending: float = 3e-5
    shift: float = 0.0  # of the scene along (1, 1, 1), in spacings: the same as moving the grid
    turn: float = 0.0  # of the scene about (1, 2, 3), degrees: the same as turning the grid
    duration: float = 1.0
    grid: Mapping[str, Any] = field(default_factory=dict)  # further arguments of Contact
    cloth_type: type[tc.Cloth] = tc.Cloth

    def run(self) -> Tensor:
        """Frames [T, 15 * 15, 3] of the vertices that all meshes share, with the shift and turn taken back."""
        turn = rotation((1.0, 2.0, 3.0), self.turn)
        offset = self.shift * (self.spacing or EDGE) * torch.ones(3)
        cloth = self.cloth(tuple((turn @ torch.tensor([0.0, 0.0, -9.81])).tolist()))
        u, v = torch.as_tensor(cloth.mesh.uv).T
        x = torch.stack([0 * u, u, v], dim=-1) @ turn.mT + offset
        t = torch.linspace(0, self.duration, round(200 * self.duration) + 1)
        way = 0.10 * torch.sin(2 * math.pi * t)[:, None] * torch.tensor([1.0, 0.0, 0.0])
        motion = path(t, way @ turn.mT)  # only the path's increments move the cloth
        times = torch.linspace(0, self.duration, round(50 * self.duration) + 1)
        with torch.no_grad():
            out = cloth(cloth.state(x), {"left": motion, "right": motion}, times=times, dt=self.dt)
        stride = (self.n - 1) // (COARSE - 1)
        shared = out.x.unflatten(1, (self.n, self.n))[:, ::stride, ::stride].flatten(1, 2)
        return (shared - offset) @ turn

    def cloth(self, gravity: tuple[float, ...]) -> tc.Cloth:
        effects = {
            "gravity": tc.effects.Gravity(gravity),
            "air": tc.effects.AirDrag(1.2),
            "bending": tc.effects.Bending(self.bending, damping_time=5e-3),
        }
        corners = {side: tc.boundaries.Grasp.corner(f"upper-{side}", radius=PATCH) for side in ("left", "right")}
        return self.cloth_type(
            tc.meshes.rectangle(SIZE, SIZE, resolution=(self.n, self.n)),
            tc.materials.AEP(6.09e5, 0.3, self.contact_stiffness, 2.5e4),
            0.15,
            effects,
            corners,
            None if self.spacing is None else tc.Contact(self.spacing, **self.grid),
        )


class Comparer:
    """RMS differences between swings; each swing runs once."""

    def __init__(self) -> None:
        self._frames: dict[str, Tensor] = {}
        self.data: dict[str, np.ndarray] = {}

    def frames(self, swing: Swing) -> Tensor:
        key = repr(swing)
        if key not in self._frames:
            self._frames[key] = swing.run()
        return self._frames[key]

    def __call__(self, label: str, a: Swing, b: Swing) -> float:
        """RMS over all shared vertices and frames [mm]; its course over time is kept for the picture."""
        first, second = self.frames(a), self.frames(b)
        self.data[label] = 1e3 * (first - second).square().sum(-1).mean(-1).sqrt().numpy()
        self.data["t"] = np.linspace(0, a.duration, len(first))
        return 1e3 * rms(first, second)


def draw(figure, data) -> None:
    axis = figure.subplots()
    names = [name for name in data if name != "t"]
    for k, name in enumerate(names):
        axis.plot(data["t"], data[name], color=colour(k), lw=1.2, ls="-" if k < 7 else "--", label=name)
    axis.set(xlabel="time [s]", ylabel="RMS over the vertices [mm]", ylim=(0, None))
    axis.legend(fontsize=7)


SCENE = (
    "0.5 m sheet, 15² vertices, Y = 609 N/m, ν = 0.3, 0.15 kg/m², air C_n = 1.2, swung by patches of 36 mm at two"
    " corners, ±0.10 m at 1 Hz for 1 s from a standing start (the corners jump to 0.63 m/s). RMS over all shared"
    " vertices and 51 frames."
)
BENDING = " Bending 3e-5 N m with 5 ms damping."
TRUTH = "the same scene computed finer"


def steps_and_meshes(base: Swing, fast: bool) -> tuple[Comparer, list[tuple[str, float, Any]]]:
    compare, found = Comparer(), []
    half, quarter = replace(base, dt=base.dt / 2), replace(base, dt=base.dt / 4)
    for a, b in ((base, half), (half, quarter)):
        label = f"Δt {1e3 * a.dt:g} → {1e3 * b.dt:g} ms"
        found.append((label, compare(label, a, b), HALVED))
    for n in (COARSE,) if fast else (COARSE, 2 * COARSE - 1):
        label = f"mesh {n}² → {2 * n - 1}²"
        found.append((label, compare(label, replace(half, n=n), replace(half, n=2 * n - 1)), REFINED))
    return compare, found


@case("convergence", "Step halved, mesh halved", truth=TRUTH, draw=draw)
def convergence(fast: bool) -> Outcome:
    compare, found = steps_and_meshes(Swing(duration=0.2 if fast else 1.0), fast)
    rows = [Row(label, value, 0.0, "mm", mark) for label, value, mark in found]
    return Outcome(rows, compare.data, SCENE + BENDING + " A sheet alone: contact's grid is left out.")


@case("convergence-without-bending", "Step halved, mesh halved, without bending", truth=TRUTH, draw=draw, fast=False)
def convergence_without_bending(fast: bool) -> Outcome:
    compare, found = steps_and_meshes(Swing(bending=0.0), True)
    rows = [Row(label, value, 0.0, "mm", finding=True) for label, value, _ in found]
    note = " A membrane alone buckles at the length of an edge, whatever that is: it has no limit to converge to."
    return Outcome(rows, compare.data, SCENE + note)


def grid_columns(base: Swing) -> list[tuple[str, Swing, Swing, bool]]:
    """(label, one swing, the other, judged)."""
    return [
        ("Δt 0.2 → 0.1 ms", base, replace(base, dt=base.dt / 2), True),
        ("Δx × 1.3", base, replace(base, spacing=1.3 * EDGE), True),
        ("grid shifted by 0.37 Δx", base, replace(base, shift=0.37), True),
        ("grid turned by 37°", base, replace(base, turn=37.0), True),
        ("k halved", base, replace(base, contact_stiffness=base.contact_stiffness / 2), False),
    ]


@case("convergence-grid", "Where contact's grid lies, and how fine it is", truth=TRUTH, draw=draw, fast=False)
def convergence_grid(fast: bool) -> Outcome:
    """One line of the table per scheme; ours is judged, the others stand beside it."""
    compare, rows, table = Comparer(), [], []
    for scheme, options in schemes().items():
        values = []
        for label, a, b, judged in grid_columns(Swing(spacing=EDGE, dt=2e-4, **options)):
            values.append(compare(label if scheme == OURS else f"{scheme}: {label}", a, b))
            finding = scheme != OURS or not judged
            rows.append(Row(f"{label}, {scheme}", values[-1], 0.0, "mm", HALVED, finding))
        table.append((scheme, values))
    head = [label for label, *_ in grid_columns(Swing(spacing=EDGE))]
    lines = ["| RMS in mm | " + " | ".join(head) + " |", "|---" * (len(head) + 1) + "|"]
    lines += [f"| {scheme} | " + " | ".join(f"{value:.2g}" for value in values) + " |" for scheme, values in table]
    note = SCENE + BENDING + f" Contact's grid: {1e3 * EDGE:.0f} mm, k h = 100 N/m. Layers never touch here.\n\n"
    shown = {k: v for k, v in compare.data.items() if k == "t" or "Δt" in k or "shifted" in k}
    return Outcome(rows, shown, note + "\n".join(lines))


def schemes() -> dict[str, dict[str, Any]]:
    """What differs from ours, by scheme: for comparison, where the layer offers it."""
    found: dict[str, dict[str, Any]] = {OURS: {}}
    if "everywhere" in inspect.signature(tc.Contact).parameters:
        found["the same, grid everywhere"] = {"grid": {"everywhere": True}}
    found["APIC, all through the grid"] = {"cloth_type": APICCloth}
    return found
