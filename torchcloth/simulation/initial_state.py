"""Initial states: of a cloth that has never been strained, and what brings a cloth to rest."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from functools import partial

import torch
from torch import Tensor

from .._utils.caching import LRUCache, bytes_of
from ..boundaries import sample_trajectory
from ..boundaries.motion import check_covers_times, check_trajectory, interpolate_poses
from ..dynamics.contact.self_contact import initial_directors
from ..dynamics.model import Model
from ..effects import MassDamping
from ..types import ClothState, Memory, Trajectory
from .argument_checks import check_duration, check_mapping, check_positions

MAX_SETTLED_RMS_SPEED_M_PER_S = 0.1  # a faster cloth has not settled: warn
SETTLING_EFFECT_NAME = "cloth.settling"  # no user's effect can have it: names have no dots


def initial_state(model: Model, x: Tensor, v: Tensor) -> ClothState:
    """Build the state of a cloth at x [..., V, 3] m with velocities v [..., V, 3] m/s.

    Directors lie along the normals, and no internal variable has evolved.

    Raises:
        InvalidInput: shapes that do not fit, or positions that are not finite.
    """
    check_positions(x, v, model.mass.shape[-2])
    d3 = x[..., :0, :] if model.grid is None else initial_directors(model, model.grid, x)
    return ClothState(x, v, d3, _initial_memory(model, x))


@torch.no_grad()
def random_contact_state(model: Model, x: Tensor, duration: float, batch: torch.Size, seed: int) -> ClothState:
    """Draw a batch of moving cloths; where there is contact, one half lies over the other and moves down to it.

    Positions are noisy: no point lies on the edge of a spline or at the onset of pressing, where slopes jump.

    Args:
        model: the model.
        x: [V, 3] m, vertex positions to start from.
        duration: time in which a vertex moves by about a twentieth of an edge [s].
        batch: leading dimensions of the state.
        seed: of the noise.
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
    is_folded = x[..., long] > middle
    x[..., long] = middle - (x[..., long] - middle).abs()
    x[..., thin] += model.grid.spacing / 2 * is_folded
    v[..., thin] -= model.grid.spacing / 4 / duration * is_folded
    state = initial_state(model, x, v)
    compression = 0.1 * torch.rand(*state.d3.shape[:-1], 1, generator=generator, dtype=torch.float64)
    return state._replace(d3=state.d3 * (1 - compression.to(x)))


def template_state(model: Model, x: Tensor) -> ClothState:
    """Return a state with the right names, shapes and types, to compare others with; its numbers mean nothing."""
    points = 0 if model.grid is None else len(model.geometry.area) * len(model.grid.points)
    return ClothState(x, x, x.new_empty(points, 3), _initial_memory(model, x))


def require_at_rest(state: ClothState, duration: float, level: int) -> ClothState:
    """Return the state with all velocities zero, and warn if the cloth was still moving.

    Args:
        state: after settling.
        duration: time for which the cloth has settled [s], for the message.
        level: how many calls above this one the warning points to.
    """
    speed = float(state.v.detach().square().sum(-1).mean(-1).sqrt().max())  # rms, of the fastest scene
    if speed > MAX_SETTLED_RMS_SPEED_M_PER_S:
        text = f"settle: after {duration:g} s the cloth still moves at {speed:.2g} m/s (rms), and is stopped there"
        warnings.warn(text, stacklevel=level + 1)
    return state.at_rest()


def with_mass_damping(model: Model, rate: float) -> Model:
    """Return the model with mass damping of ``rate`` [1/s] added, and without effects that let grips slip."""
    damping = MassDamping(rate).to(model.geometry.area)
    effects = {name: part for name, part in model.effects.items() if part[0].grasp is None}
    effects[SETTLING_EFFECT_NAME] = (damping, damping.coefficients().detach())
    return model._replace(effects=effects)


def stationary_motion(motion: Mapping[str, Trajectory], start: float, end: float) -> dict[str, Trajectory]:
    """Return trajectories from ``start`` to ``end`` [s] in which every body stands where it is at ``start``.

    Grasps that are closed at ``start`` stay closed.

    Raises:
        InvalidInput: a trajectory that is not valid or does not cover ``start``, or no time to stand still.
    """
    check_duration(end - start)
    check_mapping(motion)
    trajectories, span = {}, torch.tensor([start, end], dtype=torch.float64)
    for name, trajectory in motion.items():
        check_trajectory(trajectory, name)
        check_covers_times(trajectory, name, start, start)
        compute = partial(_stationary_trajectory, trajectory, span)
        trajectories[name] = _STATIONARY_TRAJECTORIES.get_by_value((*trajectory, span), compute)
    return trajectories


_STATIONARY_TRAJECTORIES: LRUCache[Trajectory] = LRUCache(16 * 2**20, lambda t: bytes_of(*t))


def _stationary_trajectory(trajectory: Trajectory, span: Tensor) -> Trajectory:
    pose = interpolate_poses(trajectory, span[:1])
    closed = sample_trajectory(trajectory, span[:1].repeat(2)).closed[0]
    return Trajectory(span, pose.expand(*pose.shape[:-3], 2, 4, 4), torch.tensor([closed, closed]))


def _initial_memory(model: Model, x: Tensor) -> Memory:
    triangles = len(model.geometry.area)
    plastic = model.material.initial_memory(triangles)
    memory = {"material": None if plastic is None else plastic.to(x).expand(*x.shape[:-2], -1, -1)}
    if model.grid is not None:
        memory["contact"] = x.new_zeros(*x.shape[:-2], triangles * len(model.grid.points), 1)
    if model.custom_substep is not None:
        memory |= model.custom_substep.initial_memory(x, triangles)
    memory |= {f"effects.{name}": effect.initial_memory(x) for name, (effect, _) in model.effects.items()}
    return {name: value for name, value in memory.items() if value is not None}
