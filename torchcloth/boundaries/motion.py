"""Trajectories at knots, sampled on the substeps of the integrator.

Only operations that do not wake torch's threads are used, because these keep processors from the engine for
milliseconds. Search, indexing, square roots and determinants of a few hundred numbers wake them.
"""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor

from .._utils.caching import LRUCache, bytes_of
from .._utils.linalg import cross, dot, find_last_knot, interpolate_hermite
from .._utils.vectors import check_is_not_half
from ..errors import InvalidInput
from ..types import Trajectory
from .base import PrescribedMotion

MAX_SAMPLING_INTERVAL_S = 0.12  # knots nearer than this sample a smooth motion (10 Hz); others are waypoints
MAX_SAMPLING_RATIO = 4.0  # between neighbouring intervals of samples: three lost in a row


def check_trajectory(trajectory: Trajectory, name: str) -> None:
    """Check that a trajectory can be followed.

    Raises:
        InvalidInput: wrong shapes or time order, ``closed`` that is not bool, poses that are not finite, half
            precision, or turns of over 90 degrees between knots.
    """
    where = f"motion[{name!r}]"
    if not isinstance(trajectory, Trajectory) or not all(isinstance(part, Tensor) for part in trajectory):
        parts = trajectory if isinstance(trajectory, Trajectory) else (trajectory,)
        got = ", ".join(type(part).__name__ for part in parts)
        raise InvalidInput(where, got=got, expected="a Trajectory of tensors t, pose and closed")
    _CHECKED_TRAJECTORIES.get_by_value(trajectory, partial(_check, trajectory, where))


_CHECKED_TRAJECTORIES: LRUCache[None] = LRUCache(16 * 2**20, lambda _: 0)


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
    for name, tensor in (("t", t), ("pose", pose)):
        check_is_not_half(f"{where}.{name}", tensor)
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
    if float(row) > 1e-2:  # the tolerance of rotations; the row has no effect
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
    """Check that a trajectory covers [start, end] s.

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
    """Interpolate poses at ``times`` [N] s, [..., N, 4, 4]: cubic Hermite on positions and rotation columns.

    Knots closer than 0.12 s are samples of a smooth motion. Between others the path is monotone: it stays between them.
    Rotations are orthonormalised. The result is C1, so that the gripped cloth sees no velocity jumps at the knots, and
    differentiable in the knots' poses. Times are counted from the first of ``times`` before they are rounded to the
    poses' precision: float32 cannot resolve substeps far from 0.
    """
    pose, origin = trajectory.pose, times[:1]
    t, times = ((absolute - origin).to(pose) for absolute in (trajectory.t.to(times), times))
    if len(t) == 1:
        return pose.expand(*pose.shape[:-3], len(times), 4, 4)
    independent = torch.cat([pose[..., :3, :2], pose[..., :3, 3:]], dim=-1)  # the third axis follows from two
    mixed = interpolate_hermite(t, independent, _slopes(t, independent), times)
    first = mixed[..., 0]
    first = first * dot(first, first).rsqrt()
    second = mixed[..., 1]
    second = second - dot(first, second) * first
    second = second * dot(second, second).rsqrt()
    rotation = torch.stack([first, second, cross(first, second)], dim=-1)
    top = torch.cat([rotation, mixed[..., 2:]], dim=-1)
    return torch.cat([top, pose.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*top.shape[:-2], 1, 4)], dim=-2)


def sample_trajectory(trajectory: Trajectory, times: Tensor) -> PrescribedMotion:
    """Sample a trajectory on the substeps between consecutive ``times`` [N + 1] s, in the poses' precision.

    Increments are computed in float64: the rounding of float32 is the same in all substeps, and would move a body that
    stands still by a millimetre a second. Results are cached, as fits repeat the same motion: do not write to them.
    """
    return _SAMPLED_TRAJECTORIES.get_by_value((*trajectory, times), partial(_sample_trajectory, trajectory, times))


_SAMPLED_TRAJECTORIES: LRUCache[PrescribedMotion] = LRUCache(64 * 2**20, lambda d: bytes_of(d.increment, d.pose))


def _sample_trajectory(trajectory: Trajectory, times: Tensor) -> PrescribedMotion:
    knots = trajectory.pose
    pose = interpolate_poses(trajectory._replace(pose=knots.double()), times)
    before, after = pose[..., :-1, :, :], pose[..., 1:, :, :]
    turn = after[..., :3, :3] @ before[..., :3, :3].mT
    shift = after[..., :3, 3:] - turn @ before[..., :3, 3:]
    increment = torch.cat([torch.cat([turn, shift], dim=-1), after[..., 3:, :]], dim=-2)
    t = trajectory.t.to(times)
    knot = find_last_knot(t, times[:-1] + _time_tolerance(trajectory.t)).clamp(min=0)
    closed = trajectory.closed.cpu()[knot.cpu()]
    return PrescribedMotion(increment.to(knots), after.to(knots), tuple(closed.tolist()))


def _time_tolerance(t: Tensor) -> float:
    """Return by how much rounding may shift a knot of ``t`` [K] s: 0.3 is 0.30000001 in float32."""
    t = t.detach()
    rounding = 4 * torch.finfo(t.dtype).eps * float(t.abs().max())
    return max(1e-9, min(rounding, 0.5 * float(t.diff().min()))) if len(t) > 1 else max(1e-9, rounding)


def _slopes(t: Tensor, value: Tensor) -> Tensor:
    """Return the derivative at each knot, [..., K, A, B] 1/s: that of the parabola through it and its neighbours.

    Beside an interval that is no sampling interval the slopes are monotone (Fritsch and Carlson 1980), so that the path
    stays between its knots: two knots of a rest say that nothing moves between them. Monotone slopes everywhere would
    cut off the turning points between samples, by up to 1 mm at 30 Hz for 0.2 m at 1 Hz.
    """
    step = t[1:] - t[:-1]
    h = step[:, None, None]
    secant = (value[..., 1:, :, :] - value[..., :-1, :, :]) / h
    if len(t) == 2:
        return secant.expand_as(value)
    before, after = secant[..., :-1, :, :], secant[..., 1:, :, :]
    inner = (h[1:] * before + h[:-1] * after) / (h[1:] + h[:-1])
    bound = torch.where(before * after > 0, 3 * torch.minimum(before.abs(), after.abs()), 0.0)
    longer, shorter = torch.maximum(step[1:], step[:-1]), torch.minimum(step[1:], step[:-1])
    is_waypoint = (longer > MAX_SAMPLING_INTERVAL_S) | (longer > MAX_SAMPLING_RATIO * shorter)
    inner = torch.where(is_waypoint[:, None, None], torch.clamp(inner, -bound, bound), inner)
    return torch.cat([secant[..., :1, :, :], inner, secant[..., -1:, :, :]], dim=-3)
