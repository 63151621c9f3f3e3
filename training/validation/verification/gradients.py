"""Forces and gradients against finite differences: sweeps, so that the fall of the error with h² is seen."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.func import functional_call

import torchcloth as tc
from torchcloth.testing import Sweep, finite_difference_sweep

from .case_figures import TRUTH, colour
from .registry import Mark, Outcome, Row, case, relative
from .scenes import path, rotation, total_energy

MARK = 1e-7
STEPS = tuple(10.0 ** (-1 - k / 2) for k in range(10))


def draw(figure, data) -> None:
    axis = figure.subplots()
    names = [name.removeprefix("errors of ") for name in data if name.startswith("errors of ")]
    for k, name in enumerate(names):
        axis.loglog(data["steps"], data[f"errors of {name}"] + 1e-17, "o-", ms=3, color=colour(k), label=name)
    axis.loglog(data["steps"], data["steps"] ** 2, color=TRUTH, lw=0.8, label="h²")
    axis.axhline(MARK, color="k", lw=0.6, ls=":")
    axis.set(xlabel="step h", ylabel="relative error", ylim=(1e-13, 2))
    axis.legend(ncols=2, fontsize=7)


def outcome(sweeps: dict[str, Sweep], note: str) -> Outcome:
    """Best error of each sweep, which must also fall with h²: ``Sweep.check`` refuses it otherwise."""
    rows, data = [], {"steps": torch.tensor(STEPS).numpy()}
    for name, sweep in sweeps.items():
        data[f"errors of {name}"] = sweep.errors.numpy()
        try:
            best = sweep.check(MARK)
        except AssertionError:
            best = float("inf")
        rows.append(Row(name, best, 0.0, mark=Mark(MARK, "absolute")))
    return Outcome(rows, data, note)


def crumpled(cloth: tc.Cloth) -> tc.ClothState:
    """Rotated, stretched, sheared triangles; directors tilted and compressed."""
    random = torch.Generator().manual_seed(0)
    noise = torch.randn(len(cloth.mesh.vertices), 3, generator=random)
    state = cloth.state(cloth.rest_state().x @ rotation((1, 2, 3), 50.0).mT + 0.01 * noise)
    return state._replace(d3=0.9 * state.d3 + 0.05 * torch.randn(state.d3.shape, generator=random))


@case(
    "force-is-minus-gradient",
    "Force is minus the gradient of the energy",
    truth="central differences of the energy over falling steps; the error must fall with h²",
    mark=relative(MARK),
    draw=draw,
)
def force_is_minus_gradient(fast: bool) -> Outcome:
    """The acceleration that one substep really gives, from rest, without the grid."""
    mesh = tc.meshes.rectangle(0.2, 0.15, resolution=(5, 4))
    sweeps = {}
    for name, effects in (("membrane", {}), ("membrane and bending", {"bending": tc.effects.Bending(1e-3)})):
        cloth = tc.Cloth(mesh, tc.materials.AEP(1e5, 0.3), 0.2, effects, contact=None)
        state = crumpled(cloth)
        dt = 1e-3 * cloth.stable_step()
        with torch.no_grad():
            v = cloth(state, times=[0.0, dt], dt=dt).v[-1]
        force = cloth.model().mass.detach() * v / dt
        direction = 0.01 * torch.randn(state.x.shape, generator=torch.Generator().manual_seed(1))

        def energy(x: Tensor, cloth: tc.Cloth = cloth, state: tc.ClothState = state) -> Tensor:
            return total_energy(cloth, state._replace(x=x))

        sweeps[name] = finite_difference_sweep(energy, state.x, direction, -(force * direction).sum(), STEPS)
    return outcome(sweeps, "The force is read off the velocity that one substep gives a crumpled sheet at rest.")


@case(
    "rollout-gradient",
    "Gradient through a rollout",
    truth="central differences of the whole simulation over falling steps; the error must fall with h²",
    mark=relative(MARK),
    draw=draw,
)
def rollout_gradient(fast: bool) -> Outcome:
    cloth, state, motion, times, dt = swing()
    values = {name: p.detach() for name, p in cloth.named_parameters() if not name.startswith("material.c")}
    values = {name: value for name, value in values.items() if "shear_stiffness" not in name}
    weight = torch.randn(len(state.x), 6, generator=torch.Generator().manual_seed(2))

    def loss(moved: dict[str, Tensor], x: Tensor = state.x, pose: Tensor = motion.pose) -> Tensor:
        hand = {"hand": motion._replace(pose=pose)}
        out = functional_call(cloth, {**values, **moved}, (state._replace(x=x), hand, times), {"dt": dt})
        return (weight * torch.cat([out.x[-1], 0.01 * out.v[-1]], -1)).sum() + out.wrench["hand"][-1].sum()

    shown = {
        "material.youngs_modulus.raw": "Young's modulus",
        "material.poisson_ratio.raw": "Poisson's ratio",
        "areal_density.raw": "areal density",
        "effects.air.normal.raw": "air drag",
        "effects.bending.stiffness.raw": "bending stiffness",
    }
    sweeps = {}
    for name, label in shown.items():
        size = min(1.0, float(values[name].abs().mean())) or 1.0
        sweeps[label] = _sweep(lambda p, name=name: loss({name: p}), values[name], size * torch.ones_like(values[name]))
    random = torch.Generator().manual_seed(3)
    sweeps["initial positions"] = _sweep(
        lambda x: loss({}, x=x), state.x, 1e-3 * torch.randn(state.x.shape, generator=random)
    )
    turn = torch.zeros_like(motion.pose)
    turn[:, :3, 3] = 0.01 * torch.randn(len(turn), 3, generator=random)
    sweeps["gripper's path"] = _sweep(lambda pose: loss({}, pose=pose), motion.pose, turn)
    return outcome(
        sweeps, "A sheet held by two vertices and blown through the air, 40 substeps; positions, velocities and wrench."
    )


def swing():
    """(cloth, state, motion, times, dt): drag keeps its sign throughout, so the scene is smooth."""
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
    motion = path(t, 1.5 * (t**2 / t[-1])[:, None] * torch.tensor([0.3, -0.2, 1.0]))
    return cloth, cloth.state(x, velocity), motion, [0.0, 40 * dt], dt


def _sweep(function, point: Tensor, direction: Tensor) -> Sweep:
    leaf = point.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(function(leaf), leaf)
    return finite_difference_sweep(function, point, direction, (gradient * direction).sum(), STEPS)
