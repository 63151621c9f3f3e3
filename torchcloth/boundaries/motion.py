"""Trajectories at knots, resolved on the integrator's substeps.

By operations that wake no threads of torch's (others do for a few hundred numbers: its search, indexing, square roots,
determinants): those keep processors from the engine for milliseconds.
"""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor

from .._utils.caching import LRUCache, bytes_of
from .._utils.linalg import cross, dot, interpolate_hermite, find_last_knot
from ..errors import InvalidInput
from ..types import Trajectory
from .base import PrescribedMotion


def check_trajectory(trajectory: Trajectory, name: str) -> None:
    """Refuse a trajectory that cannot be followed.

    Raises:
        InvalidInput: shapes, time order, ``closed`` that is not bool, non-finite poses, or turns over 90 degrees
            between knots.
    """
    where = f"motion[{name!r}]"
    if not isinstance(trajectory, Trajectory) or not all(isinstance(part, Tensor) for part in trajectory):
        parts = trajectory if isinstance(trajectory, Trajectory) else (trajectory,)
        got = ", ".join(type(part).__name__ for part in parts)
        raise InvalidInput(where, got=got, expected="a Trajectory of tensors t, pose and closed")
    _CHECKED_TRAJECTORIES.get_by_value(trajectory, partial(_check, trajectory, where))


_CHECKED_TRAJECTORIES: LRUCache[None] = LRUCache(16 * 2**20, lambda _: 0)  # what was checked


def _check(trajectory: Trajectory, where: str) -> None:
    t, pose, closed = trajectory
    if t.ndim != 1 or len(t) < 2 or pose.shape[-3:] != (len(t), 4, 4) or closed.shape != t.shape:
        raise InvalidInput(
            where,
            got=f"t {tuple(t.shape)}, pose {tuple(pose.shape)}, closed {tuple(closed.shape)}",
            expected="t [K], pose [..., K, 4, 4], closed [K] with K >= 2",
        )
    if closed.dtype != torch.bool:
        got, remedy = str(closed.dtype).removeprefix("torch."), "for example closed > 0.5"
        raise InvalidInput(f"{where}.closed", got=got, expected="bool", remedy=remedy)
    if not t.is_floating_point() or not bool(torch.isfinite(t).all()):
        got = "NaN or infinite times" if t.is_floating_point() else str(t.dtype).removeprefix("torch.")
        raise InvalidInput(f"{where}.t", got=got, expected="finite seconds, floating point")
    if not bool((t[1:] > t[:-1]).all()):
        raise InvalidInput(f"{where}.t", got="times that do not increase", expected="strictly increasing seconds")
    if not pose.is_floating_point() or not bool(torch.isfinite(pose).all()):
        got = "NaN or infinite entries" if pose.is_floating_point() else str(pose.dtype)
        raise InvalidInput(f"{where}.pose", got=got, expected="finite poses")
    if not pose.numel():
        raise InvalidInput(f"{where}.pose", got=f"none, shape {tuple(pose.shape)}", expected="one scene at least")
    rotation = pose.detach()[..., :3, :3]
    error = (rotation @ rotation.mT - torch.eye(3).to(rotation)).abs().amax()
    row = (pose.detach()[..., 3, :] - pose.new_tensor([0.0, 0.0, 0.0, 1.0])).abs().amax()
    if float(row) > 1e-2:  # as of rotations; it has no effect
        raise InvalidInput(
            f"{where}.pose",
            got="a last row that is not 0 0 0 1",
            expected="rigid poses [R p; 0 1]",
            remedy="transpose them, where they are stored column by column",
        )
    if float(error) > 1e-2 or bool((dot(cross(*rotation.unbind(-1)[:2]), rotation[..., 2]) < 0).any()):
        raise InvalidInput(f"{where}.pose", got="matrices that are not rotations", expected="rigid poses [R p; 0 1]")
    turn = (rotation[..., 1:, :, :] * rotation[..., :-1, :, :]).sum((-2, -1))  # trace of the relative rotation
    if bool((turn < 1.0).any()):
        raise InvalidInput(
            f"{where}.pose",
            got="a turn of over 90 degrees between knots",
            expected="smaller steps",
            remedy="give the trajectory at more knots",
        )


def check_covers_times(trajectory: Trajectory, name: str, start: float, end: float) -> None:
    """Refuse a trajectory that does not cover [start, end] s.

    Raises:
        InvalidInput: it begins later or ends earlier.
    """
    t = trajectory.t.detach()
    slack = 1e-6 + 4 * torch.finfo(t.dtype).eps * abs(end)
    if float(t[0]) > start + slack or float(t[-1]) < end - slack:
        raise InvalidInput(
            f"motion[{name!r}].t",
            got=f"[{float(t[0]):g}, {float(t[-1]):g}] s",
            expected=f"to cover the frame times [{start:g}, {end:g}] s",
        )


def interpolate_poses(trajectory: Trajectory, times: Tensor) -> Tensor:
    """Poses [..., N, 4, 4] at ``times`` [N] s: cubic Hermite on positions and rotation columns, orthonormalised.

    C1, so that the held cloth sees no velocity jumps at the knots; differentiable in the knots' poses. Times are
    counted from the first of ``times`` before they get the poses' precision: float32 has no room for substeps far
    from 0.
    """
    pose, origin = trajectory.pose, times[:1]
    t, times = ((some - origin).to(pose) for some in (trajectory.t.to(times), times))
    if len(t) == 1:
        return pose.expand(*pose.shape[:-3], len(times), 4, 4)
    told = torch.cat([pose[..., :3, :2], pose[..., :3, 3:]], dim=-1)  # the third column follows from the first two
    mixed = interpolate_hermite(t, told, _slopes(t, told), times)
    first = mixed[..., 0]
    first = first * dot(first, first).rsqrt()
    second = mixed[..., 1]
    second = second - dot(first, second) * first
    second = second * dot(second, second).rsqrt()
    rotation = torch.stack([first, second, cross(first, second)], dim=-1)
    top = torch.cat([rotation, mixed[..., 2:]], dim=-1)
    return torch.cat([top, pose.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*top.shape[:-2], 1, 4)], dim=-2)


def sample_trajectory(trajectory: Trajectory, times: Tensor) -> PrescribedMotion:
    """Increments of motion over the substeps between consecutive ``times`` [N + 1] s, in the poses' precision.

    They are resolved in float64: what float32 loses of a substep is alike in all of them, and would carry a body that
    stands still by a millimetre a second. Fits ask for the same again and again: nobody may write to one.
    """
    return _SAMPLED_TRAJECTORIES.get_by_value((*trajectory, times), partial(_sample_trajectory, trajectory, times))


_SAMPLED_TRAJECTORIES: LRUCache[PrescribedMotion] = LRUCache(64 * 2**20, lambda d: bytes_of(d.increment, d.pose))


def _sample_trajectory(trajectory: Trajectory, times: Tensor) -> PrescribedMotion:
    given = trajectory.pose
    pose = interpolate_poses(trajectory._replace(pose=given.double()), times)
    before, after = pose[..., :-1, :, :], pose[..., 1:, :, :]
    turn = after[..., :3, :3] @ before[..., :3, :3].mT
    shift = after[..., :3, 3:] - turn @ before[..., :3, 3:]
    increment = torch.cat([torch.cat([turn, shift], dim=-1), after[..., 3:, :]], dim=-2)
    t = trajectory.t.to(times)
    knot = find_last_knot(t, times[:-1] + _slack(trajectory.t)).clamp(min=0)
    closed = trajectory.closed.cpu()[knot.cpu()]
    return PrescribedMotion(increment.to(given), after.to(given), tuple(closed.tolist()))


def _slack(t: Tensor) -> float:
    """s, by which a knot [K] may seem to be later than it is: 0.3 is 0.30000001 in float32."""
    own = t.detach()
    rounding = 4 * torch.finfo(own.dtype).eps * float(own.abs().max())
    return max(1e-9, min(rounding, 0.5 * float(own.diff().min()))) if len(own) > 1 else max(1e-9, rounding)


def _slopes(t: Tensor, value: Tensor) -> Tensor:
    """Derivative at each knot [..., K, A, B] 1/s: central differences weighted for uneven knots."""
    h = (t[1:] - t[:-1])[:, None, None]
    secant = (value[..., 1:, :, :] - value[..., :-1, :, :]) / h
    if len(t) == 2:
        return secant.expand_as(value)
    inner = (h[1:] * secant[..., :-1, :, :] + h[:-1] * secant[..., 1:, :, :]) / (h[1:] + h[:-1])
    return torch.cat([secant[..., :1, :, :], inner, secant[..., -1:, :, :]], dim=-3)
