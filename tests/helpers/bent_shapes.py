"""Bent sheets for the tests of bending effects."""

import math
from functools import cache

import numpy as np
import torch

import torchcloth as tc
from torchcloth.dynamics import substep
from torchcloth.types import EffectInputs


def make_irregular_mesh(n, amount=0.25, size=0.3):
    """Return a square sheet whose inner vertices are moved by up to ``amount`` cells."""
    mesh = tc.meshes.rectangle(size, size, resolution=(n, n))
    uv = mesh.uv.copy()
    inside = ((uv > 1e-9) & (uv < size - 1e-9)).all(-1)
    generator = np.random.default_rng(n)
    uv[inside] += amount * size / (n - 1) * generator.uniform(-1, 1, (inside.sum(), 2))
    return tc.meshes.Mesh.build(np.column_stack([uv, np.zeros(len(uv))]), mesh.faces, uv)


def roll_to_cylinder(mesh, curvature, degrees=0.0):
    """Return positions [V, 3] m of the sheet rolled to a cylinder.

    The axis lies on the normal's side if ``curvature`` > 0.
    """
    a = math.radians(degrees)
    u, v = torch.as_tensor(mesh.uv).T
    u, v = math.cos(a) * u + math.sin(a) * v, math.cos(a) * v - math.sin(a) * u
    angle = curvature * u
    half = torch.where(angle == 0, 0.0, torch.sin(angle / 2) ** 2 / torch.where(angle == 0, 1.0, angle) * 2)
    return torch.stack([u * torch.sinc(angle / math.pi), v, u * half], dim=-1)


@cache
def build_bare_model(mesh):
    return tc.Cloth(mesh, tc.materials.AEP(1e3), 0.2, contact=None).build_model()


def make_effect_inputs(mesh, x, memory=None, dt=0.0):
    """Return the inputs of an effect for the sheet at ``x``, at rest."""
    v, model = torch.zeros_like(x), build_bare_model(mesh)
    return EffectInputs(x, v, substep.surface(model.geometry, x, v), model.mass, memory, dt)


def trace_memory(effect, mesh, path, dt=0.0):
    """Return internal variables at the positions of ``path``, from their initial values at the first."""
    memory = effect.initial_memory(path[0])
    memories = [memory]
    for x in path[1:]:
        memory = effect.update_memory(effect.coefficients(), make_effect_inputs(mesh, x, memory, dt))
        memories.append(memory)
    return memories


def compute_work(effect, mesh, path):
    """Return the work [J] done on a sheet along ``path``, by the trapezoidal rule."""
    memories = trace_memory(effect, mesh, path)
    c = effect.coefficients()
    forces = [effect.force(c, make_effect_inputs(mesh, x, memory)) for x, memory in zip(path, memories, strict=True)]
    pairs = zip(forces, forces[1:], path, path[1:], strict=False)
    return -sum(0.5 * ((f0 + f1) * (x1 - x0)).sum() for f0, f1, x0, x1 in pairs).item()


def make_cycles(largest, steps, count=2):
    """Return values from 0 to ``largest``, to -``largest`` and back, ``count`` times."""
    ramp = torch.linspace(-1, 1, steps + 1)
    loop = torch.cat([ramp.flip(0)[1:], ramp[1:]])
    return largest * torch.cat([torch.linspace(0, 1, steps // 2 + 1), *[loop] * count])


def measure_momentum_drift(effects, steps=100, seed=0):
    """Return the relative changes of momentum and of angular momentum over a free motion with these effects."""
    mesh = make_irregular_mesh(6, size=0.15)
    cloth = tc.Cloth(mesh, tc.materials.AEP(1e3), 0.2, effects, contact=None)
    generator = torch.Generator().manual_seed(seed)
    x = roll_to_cylinder(mesh, 8.0, 30) + 5.0
    v = 0.3 * torch.randn(x.shape, generator=generator)
    with torch.no_grad():
        out = cloth(cloth.state(x, v), times=(0.0, steps * cloth.stable_step()))
    mass = cloth.build_model().mass
    momenta = [(mass * u).sum(0) for u in out.v]
    angular = [(mass * torch.linalg.cross(y, u)).sum(0) for y, u in zip(out.x, out.v, strict=True)]
    scale = (mass * out.v[0].norm(dim=-1, keepdim=True)).sum()
    angular_scale = (mass * torch.linalg.cross(out.x[0], out.v[0]).norm(dim=-1, keepdim=True)).sum()
    return ((momenta[1] - momenta[0]).norm() / scale).item(), ((angular[1] - angular[0]).norm() / angular_scale).item()


def make_gradient_problem(cloth, state, times, names, effect=None):
    """Return (function, inputs) for ``check_gradients``: end positions, by start [0.1 mm] and logarithms of parameters.

    Steps in these inputs are small enough to stay between the kinks of a law.
    """
    prefix = "effects." if effect is None else f"effects.{effect}."
    start = {name: cloth.state_dict()[f"{prefix}{name}.raw"].clone() for name in names}
    options = {"times": times, "dt": 0.7 * cloth.stable_step()}  # automatic steps would jump with the parameters

    def end(x, **logs):
        parameters = {f"{prefix}{name}.raw": start[name] * logs[name].exp() for name in names}
        moved = cloth.state(state.x + 1e-4 * x, state.v)  # initial memory follows the positions
        return torch.func.functional_call(cloth, parameters, (moved,), options).x[-1]

    return end, {"x": torch.zeros_like(state.x), **{name: torch.zeros(()) for name in names}}
