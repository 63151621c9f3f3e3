"""Where a simulation begins: states of a cloth that has never been strained, and what lets it come to rest."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from .boundaries import drive
from .boundaries.motion import check, check_cover, interpolate
from .effects import MassDamping
from .model import Model
from .self_contact import first_directors
from .types import ClothState, Memory, Trajectory
from .validation import check_duration, check_mapping, check_positions

SETTLING = "cloth.settling"  # an effect that no user's can be called: names have no dots


def first_state(model: Model, x: Tensor, v: Tensor) -> ClothState:
    """Vertices at x [..., V, 3] with velocities v; directors along the normals, nothing remembered.

    Raises:
        InvalidInput: shapes that do not fit, or positions that are not finite.
    """
    check_positions(x, v, model.mass.shape[-2])
    d3 = x[..., :0, :] if model.grid is None else first_directors(model, model.grid, x)
    return ClothState(x, v, d3, _virgin(model, x))


@torch.no_grad()
def folded(model: Model, x: Tensor, duration: float) -> ClothState:
    """One half over the other, and on its way down to it: layers meet, and press each other more and more.

    Not quite even: nothing lies on the edge of a spline, where slopes of slopes jump.
    """
    spacing = 0.01 if model.grid is None else model.grid.spacing
    low, high = x.amin(-2), x.amax(-2)
    thin, *_, long = (high - low).argsort().tolist()
    beyond = x[:, long] > (low + high)[long] / 2
    noise = torch.randn(x.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    x, v = x + 0.01 * spacing * noise.to(x), torch.zeros_like(x)
    x[beyond, long] = (low + high)[long] - x[beyond, long]
    x[beyond, thin] += spacing / 2
    v[beyond, thin] = -spacing / 4 / duration
    return first_state(model, x, v)


def likeness(model: Model, x: Tensor) -> ClothState:
    """A state with the right shapes and no physics."""
    points = 0 if model.grid is None else len(model.geometry.area) * len(model.grid.points)
    return ClothState(x, x, x.new_empty(points, 3), _virgin(model, x))


def damped(model: Model, rate: float) -> Model:
    """With mass damping of ``rate`` [1/s] beside all; grips do not slip yet."""
    damping = MassDamping(rate).to(model.geometry.area)
    kept = {name: part for name, part in model.effects.items() if part[0].grasp is None}
    return model._replace(effects={**kept, SETTLING: (damping, damping.coefficients().detach())})


def held(motion: Mapping[str, Trajectory], start: float, end: float) -> dict[str, Trajectory]:
    """Every body stands where it is at ``start``, with the same grasps closed.

    Raises:
        InvalidInput: a trajectory that cannot be followed, or no time to stand still.
    """
    check_duration(end - start)
    check_mapping(motion)
    found, span = {}, torch.tensor([start, end], dtype=torch.float64)
    for name, trajectory in motion.items():
        check(trajectory, name)
        check_cover(trajectory, name, start, start)
        pose = interpolate(trajectory, span[:1])
        closed = drive(trajectory, span[:1].repeat(2)).closed[0]
        found[name] = Trajectory(span, pose.expand(*pose.shape[:-3], 2, 4, 4), torch.tensor([closed, closed]))
    return found


def _virgin(model: Model, x: Tensor) -> Memory:
    triangles = len(model.geometry.area)
    own = model.material.start(triangles)
    found = {"material": None if own is None else own.to(x).expand(*x.shape[:-2], -1, -1)}
    if model.grid is not None:
        found["contact"] = x.new_zeros(*x.shape[:-2], triangles * len(model.grid.points), 1)
    if model.transfer == "apic":
        found["apic"] = x.new_zeros(*x.shape[:-2], x.shape[-2] + triangles, 9)
    found |= {f"effects.{name}": effect.start(x) for name, (effect, _) in model.effects.items()}
    return {name: value for name, value in found.items() if value is not None}
