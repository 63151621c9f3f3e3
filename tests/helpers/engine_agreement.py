"""The fused engine against the torch reference: values, memory, impulses, all gradients, and tangents.

    check_agreement(cloth, motion, state)

runs both from the same state. It should be bent, strained and moving, with memory (``make_moving_state``), and all
parameters should differ, so that the comparison reaches every branch and sign.
"""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from typing import NamedTuple

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

import torchcloth as tc
from helpers.cuda_on_host import check_device_agreement
from torchcloth.boundaries import PrescribedMotion
from torchcloth.boundaries.motion import sample_trajectory
from torchcloth.dynamics import substep
from torchcloth.engine import cuda_graphs, execution, fused
from torchcloth.simulation.rollout import SUBSTEPS_PER_CHECKPOINT
from torchcloth.types import ClothState, Trajectory

VALUE_TOLERANCE, GRADIENT_TOLERANCE = 1e-10, 1e-8  # relative, in float64


class Outcome(NamedTuple):
    """Results by name, and gradients of a random function of them."""

    values: dict[str, Tensor]
    gradients: dict[str, Tensor | None]


def check_agreement(
    cloth: tc.Cloth,
    motion: Mapping[str, Trajectory],
    state: ClothState,
    substeps: int = 100,
    dt: float = 1e-4,
    tolerances: tuple[float, float] = (VALUE_TOLERANCE, GRADIENT_TOLERANCE),
    stages: int = 0,
) -> dict[str, float]:
    """Check that both engines agree, and return the largest relative differences by name."""
    cloth.requires_grad_(True)  # also of facts about the world
    reference = compute_outcome(roll_out_in_segments, cloth, motion, state, substeps, dt, stages)
    engine = compute_outcome(fused.rollout, cloth, motion, state, substeps, dt, stages)
    results = compare_outcomes(engine, reference, tolerances)
    with execution.min_filled_lanes(0.0):  # a single scene is repeated in all lanes
        in_lanes = compute_outcome(fused.rollout, cloth, motion, state, substeps, dt, stages)
    compare_outcomes(in_lanes, reference, tolerances)
    check_graph_capture(cloth, motion, state, dt, stages)
    check_device_agreement(cloth, motion, state, dt=dt, stages=stages)
    results["tangents"] = tangent_adjoint_error(cloth, motion, state, substeps, dt, stages)
    assert results["tangents"] <= tolerances[1], results["tangents"]
    if not stages:
        results["layer"] = sensitivity_adjoint_error(cloth, motion, state, substeps, dt)
        assert results["layer"] <= tolerances[1], results["layer"]
    return results


def compare_outcomes(engine: Outcome, reference: Outcome, tolerances: tuple[float, float]) -> dict[str, float]:
    """Check that two outcomes agree, and return the relative differences by name."""
    results = {name: relative_difference(engine.values[name], value) for name, value in reference.values.items()}
    worse = {name: value for name, value in results.items() if not value <= tolerances[0]}
    assert set(engine.values) == set(reference.values)
    assert not worse, worse
    for name, value in reference.gradients.items():
        other = engine.gradients[name]
        assert (value is None) == (other is None), f"only one engine has a gradient of {name}"
        if value is not None and other is not None:
            results[f"d/d {name}"] = relative_difference(other, value)
    worse = {name: value for name, value in results.items() if not value <= tolerances[1]}
    assert not worse, worse
    return results


def check_graph_capture(
    cloth: tc.Cloth, motion: Mapping[str, Trajectory], state: ClothState, dt: float, stages: int
) -> None:
    """Check that substeps of the reference and their gradients can be captured as a CUDA graph.

    They run on the meta device, whose tensors have no values: an operation that waits for a value or makes a tensor
    on another device raises. Layers must not touch: contact is not captured.
    """
    prescribed = {
        name: PrescribedMotion(d.increment.to("meta"), d.pose.to("meta"), d.closed)
        for name, d in sample_motion(motion, 2, dt, {name: t.pose for name, t in motion.items()}).items()
    }
    closed = {name: d.closed[0] for name, d in prescribed.items()}
    model = deepcopy(cloth).to("meta").build_model()._replace(stages=stages)
    leaf = state.map(lambda t: t.to("meta").requires_grad_())
    compensation = torch.zeros_like(leaf.x, requires_grad=False) if state.x.dtype == torch.float32 else None
    moving = cuda_graphs.GraphInputs.of(leaf, compensation, dt, prescribed, 0, 2)
    graphs = cuda_graphs.GraphedRollout(model, 2, capture_on_one_device)
    unit = cuda_graphs.GraphedSegment(graphs.own_model, moving, closed, 2, capture_on_one_device)
    unit.prepare(moving, graphs.parameters, graphs.leaves)
    end = unit(moving, graphs.parameters)
    (end.state.x.sum() + sum(value.sum() for value in end.impulses.values())).backward()
    assert leaf.x.grad is not None
    assert leaf.x.grad.is_meta


def capture_on_one_device(work: cuda_graphs.Work, device: torch.device) -> tuple[list[Tensor], cuda_graphs.Replay]:
    """Run the work once, as the capture of a graph, and refuse operations that leave the device."""
    with OnOneDevice(device.type):
        return work(), lambda: None


class OnOneDevice(TorchDispatchMode):
    """Refuses operations that return a tensor on another device."""

    def __init__(self, device: str) -> None:
        super().__init__()
        self.device = device

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        """Run an operation and check the devices of its results."""
        out = func(*args, **(kwargs or {}))
        for tensor in out if isinstance(out, (tuple, list)) else [out]:
            if isinstance(tensor, Tensor) and tensor.device.type != self.device:
                raise AssertionError(f"{func} makes a tensor on {tensor.device}")
        return out


def sensitivity_adjoint_error(
    cloth: tc.Cloth, motion: Mapping[str, Trajectory], state: ClothState, substeps: int, dt: float
) -> float:
    """Return the largest relative difference between ``Cloth.sensitivities`` and gradients, along random changes."""
    cloth.requires_grad_(True).zero_grad()
    generator, limit = torch.Generator().manual_seed(2), dt * (1 + 1e-9)
    named, times = dict(cloth.named_parameters()), (0.0, substeps * dt)
    along = {name: torch.randn(3, *p.shape, generator=generator, dtype=p.dtype) for name, p in named.items()}
    for change in along.values():
        change[1] = 0.0  # one direction without any change
    out = cloth(state, motion, times, dt=limit)
    weight = torch.randn(out.x.shape, generator=generator, dtype=out.x.dtype)
    (weight * out.x).sum().backward()
    _, moved = cloth.sensitivities(state, motion, times, along=tc.Directions(along), dt=limit)
    gradients = {name: torch.zeros_like(p) if p.grad is None else p.grad for name, p in named.items()}
    reverse = torch.stack([(along[name] * gradient).reshape(3, -1).sum(1) for name, gradient in gradients.items()])
    forward = (weight * moved.x).reshape(3, -1).sum(1)
    return float(((forward - reverse.sum(0)).abs() / (reverse.abs().sum(0) + 1e-12)).max())


def roll_out_in_segments(model, state, dt, prescribed, substeps):
    """Simulate by ``substep.rollout`` as ``Cloth`` does: contact candidates are searched at the start of each call."""
    total = {}
    for first in range(0, substeps, SUBSTEPS_PER_CHECKPOINT):
        state, results = substep.rollout(
            model, state, dt, prescribed, min(SUBSTEPS_PER_CHECKPOINT, substeps - first), first
        )
        total = {name: total[name] + value if name in total else value for name, value in results.items()}
    return state, total


def compute_outcome(rollout, cloth, motion, state: ClothState, substeps: int, dt: float, stages: int = 0) -> Outcome:
    """Return results and gradients of one engine."""
    cloth.zero_grad()
    leaf = state.map(lambda t: t.clone().requires_grad_())
    poses = {name: trajectory.pose.clone().requires_grad_() for name, trajectory in motion.items()}
    model = cloth.build_model()._replace(stages=stages)
    end, impulses = rollout(model, leaf, dt, sample_motion(motion, substeps, dt, poses), substeps)
    values = {
        "displacement": end.x - state.x,
        "v": end.v,
        **({"d3": end.d3} if end.d3.numel() else {}),
        **{f"memory {name}": value for name, value in end.memory.items()},
        **{f"impulse {name}": value for name, value in impulses.items()},
    }
    random_scalar(values).backward()
    gradients = {"x": leaf.x.grad, "v": leaf.v.grad, **({"d3": leaf.d3.grad} if leaf.d3.numel() else {})}
    gradients |= {f"memory {name}": value.grad for name, value in leaf.memory.items()}
    gradients |= {f"pose {name}": pose.grad for name, pose in poses.items()}
    gradients |= {name: parameter.grad for name, parameter in cloth.named_parameters()}
    grads = {name: None if grad is None else grad.clone() for name, grad in gradients.items()}
    return Outcome({name: value.detach() for name, value in values.items()}, grads)


def sample_motion(motion: Mapping[str, Trajectory], substeps: int, dt: float, poses: Mapping[str, Tensor]):
    """Return the trajectories sampled on the substeps, with these poses."""
    times = torch.linspace(0, substeps * dt, substeps + 1, dtype=torch.float64)
    return {
        name: sample_trajectory(trajectory._replace(pose=poses[name]), times) for name, trajectory in motion.items()
    }


def random_scalar(values: Mapping[str, Tensor]) -> Tensor:
    """Return a random function of all values: each component over its size, times random weights."""
    total = torch.zeros(())
    for seed, value in enumerate(values.values()):
        size = _columns(value.detach()).norm(dim=0).clamp(min=1e-12)
        total = total + (value / size * draw_noise(value.shape, seed, value.dtype)).sum()
    return total


def relative_difference(value: Tensor, reference: Tensor) -> float:
    """Return the largest relative error of a component; one that is 0 in the reference must be 0."""
    if value.shape != reference.shape or not bool(torch.isfinite(value).all()):
        return float("inf")
    value, reference = value.detach(), reference.detach()
    error, size = _columns(value - reference).norm(dim=0), _columns(reference).norm(dim=0)
    return float(torch.where(size > 1e-9 * size.max(), error / size, error / size.max().clamp(min=1e-300)).max())


def _columns(value: Tensor) -> Tensor:
    return value.reshape(-1, value.shape[-1] if value.ndim > 1 else 1)


def tangent_adjoint_error(
    cloth, motion, state: ClothState, substeps: int, dt: float, stages: int, directions=9
) -> float:
    """Return the relative error of <seed, J dot> = <J^T seed, dot> of the engine, for random tangents of all inputs."""
    with torch.no_grad():
        prescribed = sample_motion(motion, substeps, dt, {name: t.pose for name, t in motion.items()})
        engine = fused.FusedEngine(cloth.build_model()._replace(stages=stages), state, prescribed)
        assert engine.torch_parts is None, f"not on the engine: {engine.torch_parts.parts}"
        job = engine.job(state, torch.full((substeps,), dt), prescribed)
        varied = {field for field in job.inputs if field != engine.builder.dt}  # the step itself is not differentiated
        results, records = execution.forward(job, 1)
        seeds = {f: scale_seeds(draw_noise(t.shape, k, t.dtype), t) for k, (f, t) in enumerate(results.items())}
        gradients = execution.reverse(job, records, 1, seeds, varied)
        dots = {f: draw_scaled_tangents(f, job, gradients[f], directions) for f in varied}
        _, moved = execution.tangent(job, dots, directions)
        forward = sum((seeds[f].unsqueeze(1) * t).flatten(2).sum(-1) for f, t in moved.items())
        parts = [(gradients[f].unsqueeze(1) * dots[f]).flatten(2).sum(-1) for f in varied]
        return float(((forward - sum(parts)).abs() / sum(part.abs() for part in parts)).max())


def scale_seeds(seed: Tensor, value: Tensor) -> Tensor:
    """Return seeds over the size of the values that they multiply."""
    return seed / value.abs().mean(1, keepdim=True).clamp(min=1e-12)


def draw_scaled_tangents(field, job, gradient: Tensor, directions: int) -> Tensor:
    """Return random tangents [scenes, directions, rows, comps] over the gradient's size, so that all inputs count."""
    dots = draw_noise((len(gradient), directions, *gradient.shape[1:]), field.id, gradient.dtype)
    if len(job.inputs[field]) == 1:
        dots = dots[:1].expand_as(dots)
    size = gradient.norm()
    return (dots / size if float(size) > 0 else dots).contiguous()


# -- moving states ----------------------------------------------------------------------------


def make_moving_state(cloth: tc.Cloth, scenes: tuple[int, ...] = (), strain: float = 0.03, seed: int = 0) -> ClothState:
    """Return a state with curvature of both signs: rotated, strained, sheared, creased and moving."""
    rest = cloth.rest_state().x
    size = (rest.amax(0) - rest.amin(0)).max()
    u, w = (2 * torch.pi * (rest[:, :2] - rest.amin(0)[:2]) / size).unbind(-1)
    bend = torch.stack([0.1 * torch.sin(w), 0.1 * torch.cos(2 * u), torch.sin(u) + torch.cos(w + u)], dim=-1)
    x = rest + 0.04 * size * bend + 0.5 * strain * rest @ draw_noise((3, 3), seed)
    edge = size / len(rest) ** 0.5
    x = x + strain * edge * draw_noise((*scenes, *x.shape), seed + 1)
    turn = torch.linalg.qr(draw_noise((3, 3), seed + 2))[0]
    turn = turn * torch.linalg.det(turn)
    return cloth.state((x @ turn.mT).to(rest), 0.5 * draw_noise(x.shape, seed + 3).to(rest))


def make_moving_hand(cloth_time: float, knots: int = 3, scenes: tuple[int, ...] = ()) -> Trajectory:
    """Return the trajectory of a hand that moves and turns."""
    pose = torch.eye(4).repeat(*scenes, knots, 1, 1)
    angle = torch.linspace(0, 0.1, knots)
    pose[..., 0, 0], pose[..., 0, 1] = angle.cos(), -angle.sin()
    pose[..., 1, 0], pose[..., 1, 1] = angle.sin(), angle.cos()
    pose[..., :3, 3] = 1e-3 * draw_noise((*scenes, knots, 3), 11).to(pose)
    times = torch.linspace(0, cloth_time, knots, dtype=torch.float64)
    return Trajectory(times, pose, torch.ones(knots, dtype=torch.bool))


def draw_noise(shape, seed: int, dtype: torch.dtype = torch.float64) -> Tensor:
    """Return standard normal numbers that do not depend on the global generator."""
    return torch.randn(tuple(shape), generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype)
