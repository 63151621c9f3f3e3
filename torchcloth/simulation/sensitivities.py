"""Sensitivities: a simulation with its derivatives along K directions, by forward mode."""

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
from .initial_state import require_at_rest, stationary_motion, with_mass_damping
from .rollout import FrameInterval, RolloutSchedule, check_finite, collect_rollout

SETTLING_DAMPING_RATE_PER_S = 30.0  # as the default of ``Cloth.settle``
WARNING_STACK_LEVEL = 6  # calls between the user's and the warning, decorators included


class Directions(NamedTuple):
    """K directions. Each changes parameters, state and motion together; K precedes the shape of what changes.

    Attributes:
        parameters: changes of raw values, by the names of ``Cloth.named_parameters``.
        state: change of the initial state; None: no change.
        motion: changes of poses [K, ..., knots, 4, 4], by boundary.
    """

    parameters: Mapping[str, Tensor] = {}
    state: ClothState | None = None
    motion: Mapping[str, Tensor] = {}


@torch.inference_mode(False)  # inference mode drops tangents
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
) -> tuple[Rollout, Rollout]:
    """Simulate and differentiate; see ``Cloth.sensitivities``. ``cloth`` is Any because the layer imports this file."""
    cloth = shallow_clone_module(cloth)  # parameters are replaced meanwhile, and others may simulate the same cloth
    schedule = cloth.schedule(state, motion, times, dt)  # checks states and motions first
    count = _check_directions(along, cloth, state, motion)
    fused = schedule.choice.fused
    if fused is None or not fused.has_tangents:
        return _simulate_dual_copies(cloth, schedule, motion, along, count, dt, settle)
    state, tangent = schedule.state, _state_tangent(schedule.state, along, count)
    if settle:
        settling = cloth.schedule_settling(state, motion, schedule.frames[0], settle, SETTLING_DAMPING_RATE_PER_S)

        def damped_model() -> Model:
            return with_mass_damping(cloth.build_model(), SETTLING_DAMPING_RATE_PER_S)

        poses = _PoseTangents(
            motion, along, count, lambda m: stationary_motion(m, settling.frames[0], settling.frames[-1])
        )
        runner = _TangentRunner(cloth, settling, damped_model, along, count)
        (states, _), (tangents, _) = runner.run(state, tangent, poses)
        state, tangent = require_at_rest(states[-1], settle, WARNING_STACK_LEVEL), tangents[-1].at_rest()
    runner = _TangentRunner(cloth, schedule, cloth.build_model, along, count)
    results = runner.run(state, tangent, _PoseTangents(motion, along, count))
    values, derivatives = (collect_rollout(schedule, states, impulses) for states, impulses in results)
    return values, derivatives


class _TangentRunner:
    """Runs a schedule on the engine, interval by interval, with K tangents."""

    def __init__(
        self,
        cloth: nn.Module,
        schedule: RolloutSchedule,
        build: Callable[[], Model],
        along: Directions,
        count: int,
    ) -> None:
        self.cloth, self.schedule, self.build, self.along, self.count = cloth, schedule, build, along, count

    def run(self, state: ClothState, tangent: ClothState, poses: _PoseTangents):
        """Return (states, impulses) at all frames, and (their tangents)."""
        fused = self.schedule.choice.fused
        if fused is None:
            raise ValueError("the reference has no such tangents")
        engine = FusedTangents(fused, self._model_tangents, self.count)
        values, tangents, compensation = ([state], []), ([tangent], []), None
        for interval in self.schedule.iterate_intervals(lambda: values[0][-1]):
            start, prescribed = state, interval.sample_motion()
            prescribed_tangents = poses.tangents(interval, state.x.ndim - 2)
            state, compensation, tangent, impulse, impulse_tangent = engine.rollout(
                state,
                compensation,
                tangent,
                interval.dt,
                prescribed,
                prescribed_tangents,
                interval.count,
                interval.first_substep,
            )
            check_finite(interval, start, state)
            self.schedule.check_extent(state)
            for (states, impulses), s, j in ((values, state, impulse), (tangents, tangent, impulse_tangent)):
                states.append(s)
                impulses.append(j)
        return values, tangents

    def _model_tangents(self, work: Callable[[Model], dict[Any, Tensor]]) -> dict[Any, Tensor]:
        """Return the tangents [K, ...] of what ``work`` makes of the model, for the entries that have any."""
        given = self.along.parameters
        active = [k for k in range(self.count) if any(bool(tangent[k].any()) for tangent in given.values())]
        if not active:
            return {}
        batch = self.schedule.state.x.ndim - 2
        with forward_ad.dual_level(), dense_tangents():
            entries = _dual_parameters(self.cloth, {name: tangent[active] for name, tangent in given.items()}, batch)
            results = call_with_parameters(_BuildAndWork(self.cloth, self.build, work), entries, ())
            tangents = ((key, forward_ad.unpack_dual(dual).tangent) for key, dual in results.items())
            active_tangents = {key: tangent for key, tangent in tangents if tangent is not None}
        all_tangents = {key: t.new_zeros(self.count, *t.shape[1:]) for key, t in active_tangents.items()}
        for key, tangent in active_tangents.items():
            all_tangents[key][active] = tangent
        return all_tangents


class _BuildAndWork(nn.Module):
    """Work on a model within ``call_with_parameters``, so that parts see the dual parameters."""

    def __init__(self, cloth: nn.Module, build: Callable[[], Model], work: Callable[[Model], Any]) -> None:
        super().__init__()
        self.cloth, self.build, self.work = cloth, build, work

    def forward(self) -> Any:
        return self.work(self.build())


class _PoseTangents(NamedTuple):
    """Tangents of the prescribed motion.

    Attributes:
        motion: trajectories as the user gave them.
        along: the directions.
        count: K.
        transform: makes of ``motion`` what the simulation follows.
    """

    motion: Mapping[str, Trajectory]
    along: Directions
    count: int
    transform: Callable[[Mapping[str, Trajectory]], Mapping[str, Trajectory]] = dict

    def tangents(self, interval: FrameInterval, batch: int) -> dict[str, PrescribedMotion]:
        """Return the tangents [K, ...] of an interval's prescribed motion, by boundary whose poses change."""
        if not self.along.motion:
            return {}
        with forward_ad.dual_level():
            motion = self.transform(_dual_motion(self.motion, self.along, self.count, batch))
            like = interval.motion
            motion = {name: m._replace(pose=m.pose.to(like[name].pose)) for name, m in motion.items()}
            duals = interval._replace(motion=motion, prescribed=None).sample_motion()
            return {
                name: duals[name]._replace(
                    increment=_dense_tangent(duals[name].increment), pose=_dense_tangent(duals[name].pose)
                )
                for name in self.along.motion
            }


def _simulate_dual_copies(
    cloth: Any,
    schedule: RolloutSchedule,
    motion: Mapping[str, Trajectory],
    along: Directions,
    count: int,
    dt: float | None,
    settle: float,
) -> tuple[Rollout, Rollout]:
    """Simulate K dual copies as a batch, which every engine can."""
    state, batch = schedule.state, schedule.state.x.ndim - 2
    with forward_ad.dual_level(), dense_tangents():
        entries = _dual_parameters(cloth, along.parameters, batch)
        states = state.map(lambda field: _contiguous_copy(field.expand(count, *field.shape)))
        if along.state is not None:
            states = _map_two_states(states, _state_tangent(state, along, count), forward_ad.make_dual)
        duals = _dual_motion(motion, along, count, batch)
        out = call_with_parameters(_SettleAndRun(cloth), entries, (states, duals, schedule.times, dt, settle))
        primal = _map_rollout(out, lambda t: forward_ad.unpack_dual(t).primal[0].clone())
        return primal, _map_rollout(out, _dense_tangent)


class _SettleAndRun(nn.Module):
    """A cloth that comes to rest, and then moves."""

    def __init__(self, cloth: nn.Module) -> None:
        super().__init__()
        self.cloth: Any = cloth

    def forward(self, state: ClothState, motion: Any, frames: list[float], dt: float | None, settle: float) -> Rollout:
        if settle:
            rate = SETTLING_DAMPING_RATE_PER_S
            state = self.cloth.settle(state, motion, start=frames[0], duration=settle, rate=rate)
        return self.cloth(state, motion, frames, dt=dt)


def _dual_parameters(cloth: nn.Module, along: Mapping[str, Tensor], batch: int) -> dict[str, Tensor]:
    """Return K copies of each parameter in front of ``batch`` axes, dual along its direction, by all its names."""
    out = {}
    for name, tangent in along.items():
        path, _, attribute = name.rpartition(".")
        part = cloth.get_submodule(path)
        value = getattr(part, attribute)  # a plain tensor inside of ``call_with_parameters``
        if batch and value.ndim > 1 and not isinstance(part, PhysicalParameter):
            got = f"a parameter of shape {tuple(value.shape)}, and several scenes"
            remedy = "make it a PhysicalParameter(..., axes=...), which says so, or use reverse mode"
            raise InvalidInput(f"along.parameters[{name!r}]", got=got, expected="to know its own axes", remedy=remedy)
        axes = part.axes if isinstance(part, PhysicalParameter) else 1
        dual = forward_ad.make_dual(*_copies(value, tangent, len(tangent), batch, axes))
        out |= dict.fromkeys((f"cloth.{alias}" for alias in _parameter_names(cloth, value)), dual)
    return out


def _parameter_names(cloth: nn.Module, value: Tensor) -> list[str]:
    """Return the names of a parameter that several parts share, one for each part."""
    owners: dict[nn.Module, str] = {}
    for name, other in cloth.named_parameters(remove_duplicate=False):
        if other is value:
            owners.setdefault(cloth.get_submodule(name.rpartition(".")[0]), name)
    return list(owners.values())


def _copies(value: Tensor, tangent: Tensor, count: int, batch: int, axes: int) -> tuple[Tensor, Tensor]:
    """Return K copies of a parameter with ``axes`` own axes, in front of ``batch`` others, and their tangents."""
    shape = value.shape if value.ndim else torch.Size((1,))  # a number would be taken for a field
    ones = (1,) * max(0, batch + axes - len(shape))
    full = _contiguous_copy(value.detach().reshape(1, *ones, *shape).expand(count, *ones, *shape))
    return full, _contiguous_copy(tangent.to(full).reshape(full.shape))


def _dual_motion(motion: Mapping[str, Trajectory], along: Directions, count: int, batch: int) -> dict[str, Trajectory]:
    """Return trajectories with K copies of their poses, dual where a direction changes them."""
    out = dict(motion)
    for name, tangent in along.motion.items():
        pose = motion[name].pose.detach()
        ones = (1,) * max(0, batch + 3 - pose.ndim)
        poses = _contiguous_copy(pose.reshape(1, *ones, *pose.shape).expand(count, *ones, *pose.shape))
        dual = forward_ad.make_dual(poses, _contiguous_copy(tangent.to(poses).reshape(poses.shape)))
        out[name] = motion[name]._replace(pose=dual)
    return out


def _state_tangent(state: ClothState, along: Directions, count: int) -> ClothState:
    """Return the tangent [K, ...] of the state with all its batch dimensions."""
    zero = state.map(lambda field: field.new_zeros(count, *field.shape))
    if along.state is None:
        return zero

    def expand(like: Tensor, tangent: Tensor) -> Tensor:
        ones = (1,) * (like.ndim - tangent.ndim)
        return _contiguous_copy(tangent.to(like).reshape(tangent.shape[0], *ones, *tangent.shape[1:]).expand_as(like))

    return _map_two_states(zero, along.state, expand)


def _contiguous_copy(tensor: Tensor) -> Tensor:
    """Return a contiguous copy. A tensor of inference mode cannot hold a tangent, nor can a view of it."""
    return tensor.clone(memory_format=torch.contiguous_format)


def _map_two_states(a: ClothState, b: ClothState, function: Callable[[Tensor, Tensor], Tensor]) -> ClothState:
    memory = {name: function(value, b.memory[name]) for name, value in a.memory.items()}
    return ClothState(function(a.x, b.x), function(a.v, b.v), function(a.d3, b.d3), memory)


def _map_rollout(out: Rollout, function: Callable[[Tensor], Tensor]) -> Rollout:
    wrench = {name: function(w) for name, w in out.wrench.items()}
    return Rollout(out.t, function(out.x), function(out.v), wrench, out.state.map(function))


def _dense_tangent(t: Tensor) -> Tensor:
    tangent = forward_ad.unpack_dual(t).tangent
    return torch.zeros_like(t) if tangent is None else tangent.clone()


def _check_directions(along: Directions, cloth: nn.Module, state: ClothState, motion: Mapping[str, Trajectory]) -> int:
    """Return K, the same for all directions.

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
