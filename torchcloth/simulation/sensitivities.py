"""A simulation with its derivatives along K directions, by forward mode."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import torch
import torch.autograd.forward_ad as forward_ad
from torch import Tensor, nn

from .._utils.forward_mode import dense_tangents
from .._utils.torch_modes import disable_autocast
from ..boundaries import PrescribedMotion
from ..dynamics.model import Model, shallow_clone_module
from ..engine.tangents import FusedTangents
from ..errors import InvalidInput
from ..parameters import PhysicalParameter, call_with_parameters
from ..types import ClothState, Rollout, Trajectory
from .argument_checks import check_numbers
from .initial_state import with_mass_damping, stationary_motion, require_at_rest
from .rollout import FrameInterval, RolloutSchedule, check_finite, collect_rollout

SETTLING_DAMPING_RATE_PER_S = 30.0  # 1/s, of the damping while the cloth settles
WARNING_STACK_LEVEL = 6  # calls below the user's, decorators too


class Directions(NamedTuple):
    """K directions, each a change of some of these together; K is in front of the shape of what changes."""

    parameters: Mapping[str, Tensor] = {}  # by the names of ``Cloth.named_parameters``, of the raw values
    state: ClothState | None = None
    motion: Mapping[str, Tensor] = {}  # of the poses [K, ..., knots, 4, 4] of a boundary's trajectory


@torch.inference_mode(False)  # in which tangents are lost
@torch.no_grad()
@disable_autocast()
def compute_sensitivities(
    cloth: Any,
    state: ClothState,
    motion: Mapping[str, Trajectory],
    times: Tensor | Sequence[float],
    along: Directions,
    dt: float | None,
    settle: float,
) -> tuple[Rollout, Rollout]:  # a cloth is Any here: the layer stands above this file
    """See ``Cloth.sensitivities``."""
    cloth = shallow_clone_module(cloth)  # parameters are replaced meanwhile, and others may simulate the same cloth
    plan = cloth.schedule(state, motion, times, dt)  # which refuses other states and motions first
    count = _check(along, cloth, state, motion)
    fused = plan.choice.fused
    if fused is None or not fused.has_tangents:
        return _by_copies(cloth, plan, motion, along, count, dt, settle)
    state, moved = plan.state, _tangent_of(plan.state, along, count)
    if settle:
        start = plan.frames[0]
        rest = cloth.schedule_settling(state, motion, start, settle, SETTLING_DAMPING_RATE_PER_S)
        walk = _Walk(cloth, rest, lambda: with_mass_damping(cloth.build_model(), SETTLING_DAMPING_RATE_PER_S), along, count)
        poses = _Poses(motion, along, count, lambda m: stationary_motion(m, rest.frames[0], rest.frames[-1]))
        (states, _), (shifts, _) = walk.run(state, moved, poses)
        state, moved = require_at_rest(states[-1], settle, WARNING_STACK_LEVEL), shifts[-1].at_rest()
    found = _Walk(cloth, plan, cloth.build_model, along, count).run(state, moved, _Poses(motion, along, count))
    values, tangents = (collect_rollout(plan, states, impulses) for states, impulses in found)
    return values, tangents


class _Walk:
    """A plan, interval by interval, with tangents beside the values."""

    def __init__(self, cloth: nn.Module, plan: RolloutSchedule, build: Callable[[], Model], along: Directions, count: int) -> None:
        self.cloth, self.plan, self.build, self.along, self.count = cloth, plan, build, along, count

    def run(self, state: ClothState, moved: ClothState, poses: _Poses):
        """((states, impulses), (their tangents))."""
        fused = self.plan.choice.fused
        if fused is None:
            raise ValueError("the reference has no such tangents")
        engine = FusedTangents(fused, self._within, self.count)
        values, tangents, lost = ([state], []), ([moved], []), None
        for interval in self.plan.iterate_intervals(lambda: values[0][-1]):
            before, drives = state, interval.sample_motion()
            driven = poses.tangents(interval, state.x.ndim - 2)
            state, lost, moved, given, shift = engine.rollout(
                state, lost, moved, interval.dt, drives, driven, interval.count
            )
            check_finite(interval, before, state)
            self.plan.check_extent(state)
            for (states, impulses), s, j in ((values, state, given), (tangents, moved, shift)):
                states.append(s)
                impulses.append(j)
        return values, tangents

    def _within(self, work: Callable[[Model], dict[Any, Tensor]]) -> dict[Any, Tensor]:
        """Tangents [K, ...] of what ``work`` makes of the model, of those that have any."""
        given = self.along.parameters
        changes = [k for k in range(self.count) if any(bool(tangent[k].any()) for tangent in given.values())]
        if not changes:
            return {}
        batch = self.plan.state.x.ndim - 2
        with forward_ad.dual_level(), dense_tangents():
            entries = _dual_copies(self.cloth, {name: tangent[changes] for name, tangent in given.items()}, batch)
            found = call_with_parameters(_Built(self.cloth, self.build, work), entries, ())
            tangents = ((key, forward_ad.unpack_dual(dual).tangent) for key, dual in found.items())
            moved = {key: tangent for key, tangent in tangents if tangent is not None}
        every = {key: t.new_zeros(self.count, *t.shape[1:]) for key, t in moved.items()}
        for key, tangent in moved.items():
            every[key][changes] = tangent
        return every


class _Built(nn.Module):
    """Work on a model within ``called``, so that parts read the dual parameters wherever they do."""

    def __init__(self, cloth: nn.Module, build: Callable[[], Model], work: Callable[[Model], Any]) -> None:
        super().__init__()
        self.cloth, self.build, self.work = cloth, build, work

    def forward(self) -> Any:
        """The result of the work."""
        return self.work(self.build())


class _Poses(NamedTuple):
    """Motion as the user gave it; ``becomes``: what the simulation follows instead."""

    motion: Mapping[str, Trajectory]
    along: Directions
    count: int
    becomes: Callable[[Mapping[str, Trajectory]], Mapping[str, Trajectory]] = dict

    def tangents(self, interval: FrameInterval, batch: int) -> dict[str, PrescribedMotion]:
        """Of the drives of an interval [K, ...]; nothing where no pose changes."""
        if not self.along.motion:
            return {}
        with forward_ad.dual_level():
            motion = self.becomes(_dual_motion(self.motion, self.along, self.count, batch))
            like = interval.motion
            motion = {name: m._replace(pose=m.pose.to(like[name].pose)) for name, m in motion.items()}
            drives = interval._replace(motion=motion, prescribed=None).sample_motion()
            return {
                name: drives[name]._replace(
                    increment=_tangent(drives[name].increment), pose=_tangent(drives[name].pose)
                )
                for name in self.along.motion
            }


def _by_copies(
    cloth: Any,
    plan: RolloutSchedule,
    motion: Mapping[str, Trajectory],
    along: Directions,
    count: int,
    dt: float | None,
    settle: float,
) -> tuple[Rollout, Rollout]:
    """K dual copies side by side: what every engine can do."""
    state, batch = plan.state, plan.state.x.ndim - 2
    with forward_ad.dual_level(), dense_tangents():
        entries = _dual_copies(cloth, along.parameters, batch)
        many = state.map(lambda field: _own(field.expand(count, *field.shape)))
        if along.state is not None:
            many = _both(many, _tangent_of(state, along, count), forward_ad.make_dual)
        moved = _dual_motion(motion, along, count, batch)
        out = call_with_parameters(_Replay(cloth), entries, (many, moved, plan.times, dt, settle))
        primal = _each(out, lambda t: forward_ad.unpack_dual(t).primal[0].clone())
        return primal, _each(out, _tangent)


class _Replay(nn.Module):
    """A cloth that comes to rest, and then moves."""

    def __init__(self, cloth: nn.Module) -> None:
        super().__init__()
        self.cloth: Any = cloth

    def forward(self, state: ClothState, motion: Any, frames: list[float], dt: float | None, settle: float) -> Rollout:
        """The rollout."""
        if settle:
            state = self.cloth.settle(state, motion, start=frames[0], duration=settle, rate=SETTLING_DAMPING_RATE_PER_S)
        return self.cloth(state, motion, frames, dt=dt)


def _dual_copies(cloth: nn.Module, along: Mapping[str, Tensor], batch: int) -> dict[str, Tensor]:
    """Parameters as K copies in front of ``batch`` other axes, each dual along its direction, wherever they are."""
    out = {}
    for name, tangent in along.items():
        path, _, own = name.rpartition(".")
        part = cloth.get_submodule(path)
        value = getattr(part, own)  # a plain tensor inside of `called`
        if batch and value.ndim > 1 and not isinstance(part, PhysicalParameter):
            got = f"a parameter of shape {tuple(value.shape)}, and several scenes"
            remedy = "make it a PhysicalParameter(..., axes=...), which says so, or use reverse mode"
            raise InvalidInput(f"along.parameters[{name!r}]", got=got, expected="to know its own axes", remedy=remedy)
        axes = part.axes if isinstance(part, PhysicalParameter) else 1
        dual = forward_ad.make_dual(*_copies(value, tangent, len(tangent), batch, axes))
        out |= dict.fromkeys((f"cloth.{same}" for same in _places(cloth, value)), dual)
    return out


def _places(cloth: nn.Module, value: Tensor) -> list[str]:
    """Names of a parameter that several parts share, once for each part."""
    owners: dict[nn.Module, str] = {}
    for name, other in cloth.named_parameters(remove_duplicate=False):
        if other is value:
            owners.setdefault(cloth.get_submodule(name.rpartition(".")[0]), name)
    return list(owners.values())


def _copies(value: Tensor, tangent: Tensor, count: int, batch: int, axes: int) -> tuple[Tensor, Tensor]:
    """K copies of a parameter, with so many axes of its own, in front of ``batch`` others, and their tangents."""
    own = value.shape if value.ndim else torch.Size((1,))  # a number would be taken for a field
    ones = (1,) * max(0, batch + axes - len(own))
    full = value.detach().reshape(1, *ones, *own).expand(count, *ones, *own)
    full = _own(full)
    return full, _own(tangent.to(full).reshape(full.shape))


def _dual_motion(motion: Mapping[str, Trajectory], along: Directions, count: int, batch: int) -> dict[str, Trajectory]:
    """Trajectories with K copies of their poses, dual where a direction changes them."""
    out = dict(motion)
    for name, tangent in along.motion.items():
        pose = motion[name].pose.detach()
        ones = (1,) * max(0, batch + 3 - pose.ndim)
        many = _own(pose.reshape(1, *ones, *pose.shape).expand(count, *ones, *pose.shape))
        out[name] = motion[name]._replace(pose=forward_ad.make_dual(many, _own(tangent.to(many).reshape(many.shape))))
    return out


def _tangent_of(state: ClothState, along: Directions, count: int) -> ClothState:
    """Tangents [K, ...] of the state with all its batch dimensions."""
    zero = state.map(lambda field: field.new_zeros(count, *field.shape))
    if along.state is None:
        return zero
    return _both(zero, along.state, lambda like, t: _spread(t.to(like), like))


def _spread(tangent: Tensor, like: Tensor) -> Tensor:
    ones = (1,) * (like.ndim - tangent.ndim)
    return _own(tangent.reshape(tangent.shape[0], *ones, *tangent.shape[1:]).expand_as(like))


def _own(tensor: Tensor) -> Tensor:
    """A contiguous copy: what was made in inference mode keeps no tangent, nor does a view of it."""
    return tensor.clone(memory_format=torch.contiguous_format)


def _both(a: ClothState, b: ClothState, function: Callable[[Tensor, Tensor], Tensor]) -> ClothState:
    memory = {name: function(value, b.memory[name]) for name, value in a.memory.items()}
    return ClothState(function(a.x, b.x), function(a.v, b.v), function(a.d3, b.d3), memory)


def _each(out: Rollout, function: Callable[[Tensor], Tensor]) -> Rollout:
    wrench = {name: function(w) for name, w in out.wrench.items()}
    return Rollout(out.t, function(out.x), function(out.v), wrench, out.state.map(function))


def _tangent(t: Tensor) -> Tensor:
    tangent = forward_ad.unpack_dual(t).tangent
    return torch.zeros_like(t) if tangent is None else tangent.clone()


def _check(along: Directions, cloth: nn.Module, state: ClothState, motion: Mapping[str, Trajectory]) -> int:
    """K, the same everywhere.

    Raises:
        InvalidInput: names or shapes that do not fit.
    """
    if not isinstance(along, Directions) or not isinstance(along.state, ClothState | None):
        got = type(along if not isinstance(along, Directions) else along.state).__name__
        raise InvalidInput("along", got=got, expected="tc.Directions(parameters, state, motion)")
    known = {
        "parameters": dict(cloth.named_parameters()),
        "motion": {name: trajectory.pose for name, trajectory in motion.items()},
    }
    pairs = []
    for kind, given in (("parameters", along.parameters), ("motion", along.motion)):
        for name, tangent in given.items():
            if name not in known[kind]:
                expected = f"one of {', '.join(sorted(known[kind]))}"
                raise InvalidInput(f"along.{kind}", got=repr(name), expected=expected)
            pairs.append((f"along.{kind}[{name!r}]", tangent, known[kind][name]))
    if along.state is not None:
        if along.state.memory.keys() != state.memory.keys():
            got, expected = (str(sorted(s.memory)) for s in (along.state, state))
            raise InvalidInput("along.state.memory", got=got, expected=expected)
        pairs += [(f"along.state.{n}", getattr(along.state, n), getattr(state, n)) for n in ("x", "v", "d3")]
        pairs += [(f"along.state.memory[{n!r}]", along.state.memory[n], state.memory[n]) for n in state.memory]
    for what, tangent, _ in pairs:
        check_numbers(what, tangent)
    counts = {len(tangent) for _, tangent, _ in pairs if tangent.ndim}
    for what, tangent, value in pairs:
        if len(counts) != 1 or tangent.shape != (next(iter(counts)), *value.shape):
            expected = f"[{', '.join(('K', *map(str, value.shape)))}] with the same K everywhere"
            raise InvalidInput(what, got=f"shape {tuple(tangent.shape)}", expected=expected)
    if not counts or 0 in counts:
        raise InvalidInput("along", got="no direction", expected="at least one")
    return counts.pop()
