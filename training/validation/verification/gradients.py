"""Forces and gradients against finite differences.

The step h is swept, so that the error is seen to fall with h².
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.func import functional_call

import torchcloth as tc
from torchcloth.testing import Sweep, finite_difference_sweep

from .case_figures import TRUTH_COLOUR, line_colour
from .registry import FigureData, Outcome, Row, Tolerance, register_case, relative
from .scenes import rotation_matrix, total_energy, translation_trajectory

GRADIENT_TOLERANCE = 1e-7
SWEEP_STEPS = tuple(10.0 ** (-1 - k / 2) for k in range(10))


def draw_figure(figure: Any, data: FigureData) -> None:
    """Draw the errors over the step."""
    axis = figure.subplots()
    names = [name.removeprefix("errors of ") for name in data if name.startswith("errors of ")]
    for k, name in enumerate(names):
        axis.loglog(data["steps"], data[f"errors of {name}"] + 1e-17, "o-", ms=3, color=line_colour(k), label=name)
    axis.loglog(data["steps"], data["steps"] ** 2, color=TRUTH_COLOUR, lw=0.8, label="h²")
    axis.axhline(GRADIENT_TOLERANCE, color="k", lw=0.6, ls=":")
    axis.set(xlabel="step h", ylabel="relative error", ylim=(1e-13, 2))
    axis.legend(ncols=2, fontsize=7)


def assess_sweeps(sweeps: dict[str, Sweep], note: str) -> Outcome:
    """Return the best error of each sweep, or infinity where the error does not fall with h²."""
    rows, data = [], {"steps": torch.tensor(SWEEP_STEPS).numpy()}
    for name, sweep in sweeps.items():
        data[f"errors of {name}"] = sweep.errors.numpy()
        try:
            best = sweep.check(GRADIENT_TOLERANCE)
        except AssertionError:
            best = float("inf")
        rows.append(Row(name, best, 0.0, tolerance=Tolerance(GRADIENT_TOLERANCE, "absolute")))
    return Outcome(rows, data, note)


def crumpled_state(cloth: tc.Cloth) -> tc.ClothState:
    """Return a state with rotated, stretched, sheared triangles and with tilted, compressed directors."""
    random = torch.Generator().manual_seed(0)
    noise = torch.randn(len(cloth.mesh.vertices), 3, generator=random)
    state = cloth.state(cloth.rest_state().x @ rotation_matrix((1, 2, 3), 50.0).mT + 0.01 * noise)
    return state._replace(d3=0.9 * state.d3 + 0.05 * torch.randn(state.d3.shape, generator=random))


@register_case(
    "force-is-minus-gradient",
    "Force is minus the gradient of the energy",
    truth="central differences of the energy over decreasing steps; the error must fall with h²",
    tolerance=relative(GRADIENT_TOLERANCE),
    draw=draw_figure,
)
def force_is_minus_gradient(fast: bool) -> Outcome:
    """Check the acceleration of one substep from rest, without contact."""
    mesh = tc.meshes.rectangle(0.2, 0.15, resolution=(5, 4))
    sweeps = {}
    for name, effects in (("membrane", {}), ("membrane and bending", {"bending": tc.effects.Bending(1e-3)})):
        cloth = tc.Cloth(mesh, tc.materials.AEP(1e5, 0.3), 0.2, effects, contact=None)
        state = crumpled_state(cloth)
        dt = 1e-3 * cloth.stable_step()
        with torch.no_grad():
            v = cloth(state, times=[0.0, dt], dt=dt).v[-1]
        force = cloth.build_model().mass.detach() * v / dt
        direction = 0.01 * torch.randn(state.x.shape, generator=torch.Generator().manual_seed(1))

        def energy(x: Tensor, cloth: tc.Cloth = cloth, state: tc.ClothState = state) -> Tensor:
            return total_energy(cloth, state._replace(x=x))

        sweeps[name] = finite_difference_sweep(energy, state.x, direction, -(force * direction).sum(), SWEEP_STEPS)
    return assess_sweeps(sweeps, "The force follows from the velocity that one substep gives a crumpled sheet at rest.")


@register_case(
    "rollout-gradient",
    "Gradient through a rollout",
    truth="central differences of the whole simulation over decreasing steps; the error must fall with h²",
    tolerance=relative(GRADIENT_TOLERANCE),
    draw=draw_figure,
)
def rollout_gradient(fast: bool) -> Outcome:
    """Check gradients of a rollout with respect to parameters, initial positions and the gripper\'s path."""
    cloth, state, motion, times, dt = make_smooth_swing()
    values = {name: p.detach() for name, p in cloth.named_parameters() if not name.startswith("material.c")}
    values = {name: value for name, value in values.items() if "shear_stiffness" not in name}
    weight = torch.randn(len(state.x), 6, generator=torch.Generator().manual_seed(2))

    def loss(changed: dict[str, Tensor], x: Tensor = state.x, pose: Tensor = motion.pose) -> Tensor:
        hand = {"hand": motion._replace(pose=pose)}
        out = functional_call(cloth, {**values, **changed}, (state._replace(x=x), hand, times), {"dt": dt})
        return (weight * torch.cat([out.x[-1], 0.01 * out.v[-1]], -1)).sum() + out.wrench["hand"][-1].sum()

    labels = {
        "material.youngs_modulus.raw": "Young's modulus",
        "material.poisson_ratio.raw": "Poisson's ratio",
        "areal_density.raw": "areal density",
        "effects.air.normal.raw": "air drag",
        "effects.bending.stiffness.raw": "bending stiffness",
    }
    sweeps = {}
    for name, label in labels.items():
        size = min(1.0, float(values[name].abs().mean())) or 1.0
        sweeps[label] = _sweep(lambda p, name=name: loss({name: p}), values[name], size * torch.ones_like(values[name]))
    random = torch.Generator().manual_seed(3)
    sweeps["initial positions"] = _sweep(
        lambda x: loss({}, x=x), state.x, 1e-3 * torch.randn(state.x.shape, generator=random)
    )
    turn = torch.zeros_like(motion.pose)
    turn[:, :3, 3] = 0.01 * torch.randn(len(turn), 3, generator=random)
    sweeps["gripper's path"] = _sweep(lambda pose: loss({}, pose=pose), motion.pose, turn)
    return assess_sweeps(
        sweeps, "A sheet held by two vertices and moved through the air, 40 substeps; positions, velocities and wrench."
    )


def make_smooth_swing() -> tuple[tc.Cloth, tc.ClothState, tc.Trajectory, list[float], float]:
    """Return cloth, state, motion, frame times [s] and step [s] of a scene in which drag does not change its sign."""
    mesh = tc.meshes.rectangle(0.2, 0.24, resolution=(4, 5))
    effects = {
        "gravity": tc.effects.Gravity(),
        "air": tc.effects.AirDrag(1.2),
        "bending": tc.effects.Bending(1e-4, damping_time=1e-3),
    }
    cloth = tc.Cloth(mesh, tc.materials.AEP(1e5), 0.2, effects, {"hand": tc.boundaries.Grasp([0, 1])}, contact=None)
    dt = 0.6 * cloth.stable_step()
    random = torch.Generator().manual_seed(0)
    u, v = torch.as_tensor(mesh.uv).T
    x = cloth.rest_state().x + torch.stack([0 * u, 0.02 * u, 0.3 * u * v + 0.5 * u**2], dim=-1)
    velocity = torch.tensor([0.2, 0.1, 2.0]) + 0.2 * torch.randn(x.shape, generator=random)
    t = torch.linspace(0.0, 40 * dt, 4)
    motion = translation_trajectory(t, 1.5 * (t**2 / t[-1])[:, None] * torch.tensor([0.3, -0.2, 1.0]))
    return cloth, cloth.state(x, velocity), motion, [0.0, 40 * dt], dt


def _sweep(function, point: Tensor, direction: Tensor) -> Sweep:
    leaf = point.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(function(leaf), leaf)
    return finite_difference_sweep(function, point, direction, (gradient * direction).sum(), SWEEP_STEPS)
