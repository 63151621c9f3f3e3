"""Where a simulation begins: states of a cloth that has never been strained, and what lets it come to rest."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from functools import partial

import torch
from torch import Tensor

from .._utils.caching import LRUCache, bytes_of
from ..boundaries import sample_trajectory
from ..boundaries.motion import check_trajectory, check_covers_times, interpolate_poses
from ..dynamics.contact.self_contact import initial_directors
from ..dynamics.model import Model
from ..effects import MassDamping
from ..types import ClothState, Memory, Trajectory
from .argument_checks import check_duration, check_mapping, check_positions

MAX_SETTLED_RMS_SPEED_M_PER_S = 0.1  # m/s, rms: what has settled is slower
SETTLING_EFFECT_NAME = "cloth.settling"  # an effect that no user's can be called: names have no dots


def initial_state(model: Model, x: Tensor, v: Tensor) -> ClothState:
    """Vertices at x [..., V, 3] with velocities v; directors along the normals, nothing remembered.

    Raises:
        InvalidInput: shapes that do not fit, or positions that are not finite.
    """
    check_positions(x, v, model.mass.shape[-2])
    d3 = x[..., :0, :] if model.grid is None else initial_directors(model, model.grid, x)
    return ClothState(x, v, d3, _initial_memory(model, x))


@torch.no_grad()
def random_contact_state(model: Model, x: Tensor, duration: float, batch: torch.Size, seed: int) -> ClothState:
    """A batch of cloths x [V, 3] in motion, where there is contact one half over the other, on its way down to it.

    None is even: nothing lies on the edge of a spline, or at the brink of pressing, where slopes jump.
    """
    generator = torch.Generator().manual_seed(seed)

    def noise(like: Tensor) -> Tensor:
        return torch.randn(*batch, *like.shape[-2:], generator=generator, dtype=torch.float64).to(like)

    edge = model.geometry.area.mean().sqrt()
    x, v = x + 0.01 * edge * noise(x), 0.05 * edge / duration * noise(x)
    if model.grid is None:
        return initial_state(model, x, v)
    low, high = x.amin((*range(len(batch)), -2)), x.amax((*range(len(batch)), -2))
    thin, *_, long = (high - low).argsort().tolist()
    middle = (low + high)[long] / 2
    beyond = x[..., long] > middle
    x[..., long] = middle - (x[..., long] - middle).abs()
    x[..., thin] += model.grid.spacing / 2 * beyond
    v[..., thin] -= model.grid.spacing / 4 / duration * beyond
    state = initial_state(model, x, v)
    shorter = 0.1 * torch.rand(*state.d3.shape[:-1], 1, generator=generator, dtype=torch.float64)
    return state._replace(d3=state.d3 * (1 - shorter.to(x)))


def template_state(model: Model, x: Tensor) -> ClothState:
    """A state with the right shapes and no physics."""
    points = 0 if model.grid is None else len(model.geometry.area) * len(model.grid.points)
    return ClothState(x, x, x.new_empty(points, 3), _initial_memory(model, x))


def require_at_rest(state: ClothState, duration: float, level: int) -> ClothState:
    """At rest; a warning, ``level`` calls above this one, where the cloth was still moving after ``duration`` [s]."""
    speed = float(state.v.detach().square().sum(-1).mean(-1).sqrt().max())  # of the scene that moves most
    if speed > MAX_SETTLED_RMS_SPEED_M_PER_S:
        text = f"settle: after {duration:g} s the cloth still moves at {speed:.2g} m/s (rms), and is stopped there"
        warnings.warn(text, stacklevel=level + 1)
    return state.at_rest()


def with_mass_damping(model: Model, rate: float) -> Model:
    """With mass damping of ``rate`` [1/s] beside all; grips do not slip yet."""
    damping = MassDamping(rate).to(model.geometry.area)
    kept = {name: part for name, part in model.effects.items() if part[0].grasp is None}
    return model._replace(effects={**kept, SETTLING_EFFECT_NAME: (damping, damping.coefficients().detach())})


def stationary_motion(motion: Mapping[str, Trajectory], start: float, end: float) -> dict[str, Trajectory]:
    """Every body stands where it is at ``start``, with the same grasps closed.

    Raises:
        InvalidInput: a trajectory that cannot be followed, or no time to stand still.
    """
    check_duration(end - start)
    check_mapping(motion)
    found, span = {}, torch.tensor([start, end], dtype=torch.float64)
    for name, trajectory in motion.items():
        check_trajectory(trajectory, name)
        check_covers_times(trajectory, name, start, start)
        found[name] = _STATIONARY_TRAJECTORIES.get_by_value((*trajectory, span), partial(_stationary_trajectory, trajectory, span))
    return found


_STATIONARY_TRAJECTORIES: LRUCache[Trajectory] = LRUCache(16 * 2**20, lambda t: bytes_of(*t))


def _stationary_trajectory(trajectory: Trajectory, span: Tensor) -> Trajectory:
    pose = interpolate_poses(trajectory, span[:1])
    closed = sample_trajectory(trajectory, span[:1].repeat(2)).closed[0]
    return Trajectory(span, pose.expand(*pose.shape[:-3], 2, 4, 4), torch.tensor([closed, closed]))


def _initial_memory(model: Model, x: Tensor) -> Memory:
    triangles = len(model.geometry.area)
    own = model.material.initial_memory(triangles)
    found = {"material": None if own is None else own.to(x).expand(*x.shape[:-2], -1, -1)}
    if model.grid is not None:
        found["contact"] = x.new_zeros(*x.shape[:-2], triangles * len(model.grid.points), 1)
    if model.custom_substep is not None:
        found |= model.custom_substep.initial_memory(x, triangles)
    found |= {f"effects.{name}": effect.initial_memory(x) for name, (effect, _) in model.effects.items()}
    return {name: value for name, value in found.items() if value is not None}
