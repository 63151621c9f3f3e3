"""Symmetry and conservation: frames, momenta, spin, energy."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import torch

import torchcloth as tc
from torchcloth._utils.constants import STANDARD_GRAVITY_M_PER_S2
from torchcloth.dynamics.kinematics import surface
from torchcloth.types import EffectInputs

from .case_figures import line_colour
from .registry import AT_MOST_TRUTH, FigureData, Outcome, Row, absolute, register_case, relative
from .scenes import compute_momenta, rotation_matrix, total_energy, translation_trajectory

CONSERVATION_TOLERANCE = absolute(1e-9)


def make_free_sheet(n: int, contact: tc.Contact | None, effects=None, boundaries=None) -> tc.Cloth:
    """Return a sheet of 0.3 m x 0.3 m and n x n vertices, Y = 300 N/m, 0.15 kg/m^2."""
    mesh = tc.meshes.rectangle(0.3, 0.3, resolution=(n, n))
    return tc.Cloth(
        mesh, tc.materials.AEP(3e5, 0.3, contact_stiffness=1e5, shear_stiffness=2e4), 0.15, effects, boundaries, contact
    )


def random_motion(cloth: tc.Cloth, speed: float) -> tc.ClothState:
    """Return a state with random velocities of ``speed`` m/s per axis, which crumple the sheet."""
    random = torch.Generator().manual_seed(0)
    x = cloth.rest_state().x
    return cloth.state(x, speed * torch.randn(x.shape, generator=random))


@register_case(
    "frame-indifference",
    "A rotated world rotates the motion",
    truth="symmetry: gravity, gripper and sheet rotated by 73° about (1, 2, 3) and shifted give the rotated motion",
    tolerance=CONSERVATION_TOLERANCE,
)
def frame_indifference(fast: bool) -> Outcome:
    """Compare a motion with that of the rotated and shifted scene, without contact."""
    turn, shift = rotation_matrix((1.0, 2.0, 3.0), 73.0), torch.tensor([0.3, -1.7, 0.9])
    t = torch.linspace(0, 0.1, 11)
    displacement = 0.1 * torch.stack([t, torch.sin(12 * t), 0 * t], -1)
    results = []
    for turned in (False, True):
        g = torch.tensor([0.0, 0.0, -STANDARD_GRAVITY_M_PER_S2])
        effects = {
            "gravity": tc.effects.Gravity(tuple((turn @ g if turned else g).tolist())),
            "air": tc.effects.AirDrag(1.2),
            "bending": tc.effects.Bending(3e-5, 5e-3),
        }
        cloth = make_free_sheet(9, None, effects, {"hand": tc.boundaries.Grasp([0, 1, 9])})
        start = random_motion(cloth, 0.1)
        if turned:
            state = cloth.state(start.x @ turn.mT + shift, start.v @ turn.mT)
            # the gripper's body frame stands at the shifted origin: only its increments move the cloth
            motion = translation_trajectory(t, displacement @ turn.mT + shift)
        else:
            state, motion = start, translation_trajectory(t, displacement)
        with torch.no_grad():
            out = cloth(state, {"hand": motion}, times=[0.0, 0.05, 0.1], dt=cloth.stable_step() / 2)
        results.append((out.x, out.wrench["hand"][..., :3]))
    (x, force), (other, turned_force) = results
    position = float((other - (x @ turn.mT + shift)).abs().max()) / 0.3
    pull = float((turned_force - force @ turn.mT).abs().max() / force.abs().max())
    note = (
        "0.1 s of a sheet with random velocities, a moving gripper, bending and air, without contact (see convergence)."
    )
    return Outcome(
        [Row("positions, over the sheet's size", position, 0.0), Row("force on the gripper", pull, 0.0)], note=note
    )


@register_case(
    "momentum",
    "Linear and angular momentum of a free sheet",
    truth="conservation: no gravity, no air",
    tolerance=CONSERVATION_TOLERANCE,
)
def momentum(fast: bool) -> Outcome:
    """Measure the change of the momenta of a free sheet."""
    rows = []
    for label, contact, effects in (
        ("membrane", None, {}),
        ("bending", None, {"bending": tc.effects.Bending(3e-5)}),
        ("bending with 5 ms damping", None, {"bending": tc.effects.Bending(3e-5, 5e-3)}),
        ("contact grid", tc.Contact(spacing=0.03, everywhere=True), {}),
    ):
        cloth = make_free_sheet(9, contact, effects)
        state = random_motion(cloth, 0.5)
        with torch.no_grad():
            end = cloth(state, times=[0.0, 0.05 if fast else 0.2]).state
        scale = float((cloth.build_model().mass.detach() * state.v.norm(dim=-1, keepdim=True)).sum())
        for name, before, after, arm in zip(
            ("linear", "angular"), compute_momenta(cloth, state), compute_momenta(cloth, end), (1.0, 0.15), strict=True
        ):
            damped = name == "angular" and "damping" in label
            rows.append(Row(f"{name}, {label}", float((after - before).norm()) / (scale * arm), 0.0, finding=damped))
    return Outcome(
        rows,
        note="Change in 0.2 s over Σ m |v| (and half the sheet's size); random velocities of 0.5 m/s at the start. "
        "Bending damping resists the rate of the vector-valued second derivative, so it slows a curved sheet that "
        "turns. It is not frame-indifferent, hence a finding; turning-cylinder measures its power.",
    )


@register_case(
    "turning-cylinder",
    "Power of bending damping on a curved sheet that turns as a whole",
    truth="closed form of this damping: power B τ κ² ω² per area; zero without damping",
    tolerance=relative(0.02),
)
def turning_cylinder(fast: bool) -> Outcome:
    """Measure the damping power on a sheet that is rolled to a cylinder and turns about its axis."""
    radius, speed, stiffness, time = 0.1, 6.0, 3e-5, 5e-3
    mesh = tc.meshes.rectangle(0.3, 0.2, resolution=(31, 21))
    width, height = torch.as_tensor(mesh.uv).T
    angle = width / radius
    x = torch.stack([radius * angle.sin(), height, radius * angle.cos()], dim=-1)
    v = torch.linalg.cross(torch.tensor([0.0, speed, 0.0]).expand_as(x), x)
    powers = []
    for damping in (time, None):
        cloth = tc.Cloth(mesh, tc.materials.AEP(1e5), 0.15, {"b": tc.effects.Bending(stiffness, damping)}, contact=None)
        model, state = cloth.build_model(), cloth.state(x, v)
        effect, c = model.effects["b"]
        inputs = EffectInputs(x, v, surface(model.geometry, x, v), model.mass)
        inputs_at_rest = inputs._replace(v=torch.zeros_like(v))
        moving, static = (effect.force(c, at) for at in (inputs, inputs_at_rest))
        assert moving is not None
        assert static is not None
        powers.append(-float(((moving - static) * state.v).sum().detach()))
    power = stiffness * time * (speed / radius) ** 2 * 0.06
    return Outcome(
        [
            Row("dissipated power, 5 ms", powers[0], power, "W"),
            Row("dissipated power, no damping", powers[1], 0.0, "W", absolute(1e-15)),
            Row(
                "relative loss of angular momentum per second, 0.15 kg/m²",
                power / (0.15 * 0.06 * (radius * speed) ** 2),
                unit="1/s",
                finding=True,
            ),
        ],
        note="B = 3e-5 N m, radius 0.1 m, 6 rad/s. Air drag at 0.6 m/s dissipates about a thousand times as much.",
    )


@register_case(
    "spinning-sheet",
    "A spinning sheet is not slowed by its director",
    truth="symmetry: angular momentum stays, and the director stays the normal (R₃₃ = 1, r = 0)",
    tolerance=CONSERVATION_TOLERANCE,
)
def spinning_sheet(fast: bool) -> Outcome:
    """Measure directors and angular momentum of spinning sheets."""
    rows, energies = [], []
    for label, axis in (("about its diagonal", (1.0, 1.0, 0.0)), ("about a slanted axis", (0.6, 0.0, 0.8))):
        cloth = make_free_sheet(6 if fast else 9, tc.Contact(spacing=0.04, everywhere=True))
        omega = 6.0 * torch.tensor(axis) / float(np.linalg.norm(axis))
        x, mass = cloth.rest_state().x, cloth.build_model().mass.detach()
        centre = (mass * x).sum(0) / mass.sum()
        state = cloth.state(x, torch.linalg.cross(omega.expand_as(x), x - centre))
        with torch.no_grad():
            end = cloth(state, times=[0.0, 0.25 if fast else 1.0]).state
        n = cloth.state(end.x).d3
        height = (end.d3 * n).sum(-1, keepdim=True)
        rows.append(Row(f"R₃₃ − 1, {label}", float((height - 1).abs().max()), 0.0))
        rows.append(Row(f"r, {label}", float((end.d3 - height * n).norm(dim=-1).max()), 0.0))
        before, after = compute_momenta(cloth, state)[1], compute_momenta(cloth, end)[1]
        rows.append(Row(f"angular momentum, {label}", float((after - before).norm() / before.norm()), 0.0))
        kinetic = [cloth.energy(s)["kinetic"].detach() for s in (state, end)]
        energies.append(float(kinetic[1] / kinetic[0]) - 1)
    rows.append(Row("kinetic energy, change", max(energies, key=abs), 0.0, finding=True))
    return Outcome(
        rows,
        note="6 rad/s for 1 s, no gravity, no air. The sheet rings a little under the centrifugal load.",
    )


def draw_energy(figure: Any, data: FigureData) -> None:
    """Draw the energy over time."""
    axis = figure.subplots()
    for k, name in enumerate(name for name in data if name != "t"):
        axis.plot(data["t"], data[name], color=line_colour(k), lw=1, label=name)
    axis.axhline(1, color="k", lw=0.5, ls=":")
    axis.set(xlabel="time [s]", ylabel="energy / energy at the start")
    axis.legend()


@register_case(
    "energy",
    "Energy without gravity and prescribed motion",
    truth="energy is never created: the step's energy is ½ Σ m v₋·v₊ + V(x), which linear motion conserves exactly",
    draw=draw_energy,
)
def energy(fast: bool) -> Outcome:
    """Measure the highest energy over the first, and the mean of the last fifth over that of the first fifth."""
    end, frames = (0.1, 101) if fast else (1.0, 501)
    scenes = {
        "membrane": (None, {}, 1.0),
        "membrane, step halved": (None, {}, 0.5),
        "bending with 5 ms damping": (None, {"bending": tc.effects.Bending(3e-5, 5e-3)}, 1.0),
        "contact grid": (tc.Contact(spacing=0.03, everywhere=True), {}, 1.0),
        "air": (None, {"air": tc.effects.AirDrag(1.2)}, 1.0),
    }
    rows, data = [], {"t": np.linspace(0, end, frames)}
    for name, (contact, effects, step_fraction) in scenes.items():
        cloth = make_free_sheet(9, contact, effects)
        level = energy_levels(cloth, data["t"], step_fraction * cloth.stable_step())
        data[name] = level / level[0]
        fifth = frames // 5
        trend = 100 * float(data[name][-fifth:].mean() / data[name][:fifth].mean() - 1)
        free = name.startswith("membrane")
        rows.append(Row(f"highest, {name}", 100 * float(data[name].max() - 1), 0.5, "%", AT_MOST_TRUTH))
        rows.append(Row(f"trend, {name}", trend, 0.0 if free else None, "%", finding=True))
    note = (
        "A sheet that starts with random velocities of 0.5 m/s and crumples for 1 s. Highest: the largest energy at"
        " any time over the first. The tolerance of 0.5 % is this page's and covers the non-linear error of the step,"
        " which falls with Δt² as the halved step shows. Trend: mean of the last fifth over that of the first."
    )
    return Outcome(rows, data, note)


@torch.no_grad()
def energy_levels(cloth: tc.Cloth, times: np.ndarray, dt: float) -> np.ndarray:
    """Return the total energy [T] J at times [T] s.

    Velocities live between positions, so the kinetic energy is 1/2 m v(n-1/2) . v(n+1/2).
    """
    state, mass = random_motion(cloth, 0.5), cloth.build_model().mass
    energies = []
    for start, stop in pairwise([*times.tolist(), 2 * times[-1] - times[-2]]):
        after = cloth(state, times=[0.0, dt], dt=dt).state
        kinetic = 0.5 * (mass * (after.v * state.v)).sum()
        energies.append(float(kinetic + total_energy(cloth, state._replace(v=0 * state.v))))
        state = cloth(state, times=[start, stop], dt=dt).state
    return np.array(energies)
