"""Densely sampled joint motions through waypoints, the check of their limits, and the minimum-jerk profile."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchcloth.errors import InvalidInput

from .chain import JointLimits

LIMIT_ROUNDING = 1e-9  # rad or m, and relative for velocities: excess of a limit that is rounding


class SampledJointMotion(NamedTuple):
    """A joint motion at sample times; every waypoint is one of them.

    Attributes:
        t: [S] s.
        q: [..., S, J] rad or m.
        waypoint: [S] int64, the last waypoint at or before each sample.
    """

    t: Tensor
    q: Tensor
    waypoint: Tensor


def minimum_jerk(u: Tensor) -> Tensor:
    """Return the fraction of the path at fraction ``u`` of the time, for least jerk and rest at both ends.

    The polynomial is 10 u^3 - 15 u^4 + 6 u^5 (Flash and Hogan 1985).
    """
    return u**3 * (10 + u * (6 * u - 15))


def check_waypoints(q: Tensor, t: Tensor, **masks: Tensor | None) -> None:
    """Refuse waypoints ``q [..., K, J]`` that define no motion at times ``t [K]`` s.

    Raises:
        InvalidInput: wrong shapes, times that do not increase, numbers that are not finite, or masks that are not
            boolean.
    """
    if q.ndim < 2:
        raise InvalidInput("q has the wrong shape", got=tuple(q.shape), expected="(..., K, J)")
    knots = q.shape[-2]
    if knots < 2:
        raise InvalidInput(
            "q has too few waypoints", got=knots, expected="2 or more", remedy="repeat it to stand still"
        )
    if t.shape != (knots,):
        expected = f"({knots},), one time for each waypoint of q"
        raise InvalidInput("t has the wrong shape", got=tuple(t.shape), expected=expected)
    if not bool((t.diff() > 0).all() & t.isfinite().all()):
        raise InvalidInput("t must increase", got=t.tolist(), expected="finite and strictly increasing seconds")
    if not bool(q.isfinite().all()):
        raise InvalidInput("q is not finite", remedy="look for NaN in the waypoints")
    for name, mask in masks.items():
        if mask is not None and (mask.shape != (knots,) or mask.dtype != torch.bool):
            got = f"{mask.dtype} {tuple(mask.shape)}"
            raise InvalidInput(f"{name} has the wrong shape or type", got=got, expected=f"torch.bool ({knots},)")


def interpolate(q: Tensor, t: Tensor, stop: Tensor | None, period: float) -> SampledJointMotion:
    """Interpolate waypoints by cubic Hermite curves with Catmull-Rom velocities: C1, and linear in ``q``.

    Args:
        q: ``[..., K, J]`` waypoints.
        t: ``[K]`` s, their times; they may require grad.
        stop: ``[K]`` bool, waypoints at which every joint comes to rest; by default the first and the last.
        period: s, the longest time between two samples.
    """
    if not (math.isfinite(period) and period > 0):
        raise InvalidInput("period", got=period, expected="seconds above 0")
    knot = torch.arange(len(t), device=t.device)
    rests = (knot == 0) | (knot == len(t) - 1) if stop is None else stop.to(t.device)
    duration = t.diff()
    # The tolerance keeps a duration that is a whole number of periods, up to rounding, from gaining a sample.
    counts = (duration.detach() / period - 1e-6).ceil().clamp(min=1).long()
    interval = torch.repeat_interleave(knot[:-1], counts)
    first = torch.repeat_interleave(counts.cumsum(0) - counts, counts)
    u = (torch.arange(len(interval), device=t.device) - first) / counts[interval]
    u = torch.cat([u, u.new_ones(1)]).to(t.dtype)
    interval = torch.cat([interval, interval[-1:]])

    h = duration[interval]
    v = _velocities(q, duration).masked_fill(rests[:, None], 0.0)
    s, w = u[:, None], h[:, None]
    samples = (
        (1 + 2 * s) * (1 - s) ** 2 * q[..., interval, :]
        + s * (1 - s) ** 2 * w * v[..., interval, :]
        + s**2 * (3 - 2 * s) * q[..., interval + 1, :]
        + s**2 * (s - 1) * w * v[..., interval + 1, :]
    )
    waypoint = interval.clone()
    waypoint[-1] += 1
    return SampledJointMotion(t[interval] + u * h, samples, waypoint)


def _velocities(q: Tensor, duration: Tensor) -> Tensor:
    """Velocity at each waypoint: that of the parabola through it and its neighbours; at the ends, that of the line."""
    slope = q.diff(dim=-2) / duration[:, None]
    before, after = duration[:-1, None], duration[1:, None]
    inner = (after * slope[..., :-1, :] + before * slope[..., 1:, :]) / (before + after)
    return torch.cat([slope[..., :1, :], inner, slope[..., -1:, :]], dim=-2)


def check_limits(
    motion: SampledJointMotion, names: tuple[str, ...], units: tuple[str, ...], limits: JointLimits
) -> None:
    """Refuse a motion beyond a joint's hard position limits or its velocity limit.

    Velocities are differences of samples.

    Raises:
        InvalidInput: names the joint, the limit and the time.
    """
    q, t = motion.q.detach(), motion.t.detach()
    _refuse("position", q, t, limits.lower - LIMIT_ROUNDING, limits.upper + LIMIT_ROUNDING, names, units)
    velocity = q.diff(dim=-2) / t.diff()[:, None]
    bound = limits.velocity * (1 + LIMIT_ROUNDING)
    _refuse("velocity", velocity, t, -bound, bound, names, tuple(f"{unit}/s" for unit in units))


def _refuse(
    what: str, value: Tensor, t: Tensor, lower: Tensor, upper: Tensor, names: tuple[str, ...], units: tuple[str, ...]
) -> None:
    excess = torch.maximum(lower - value, value - upper)
    if not bool((excess > 0).any()):
        return
    at = int(excess.argmax())
    joint, sample = at % value.shape[-1], at // value.shape[-1] % value.shape[-2]
    unit = units[joint]
    raise InvalidInput(
        f"the motion breaks the {what} limit of joint {names[joint]!r} at t = {float(t[sample]):.4g} s",
        got=f"{float(value.flatten()[at]):.5g} {unit}",
        expected=f"{float(lower[joint]):.5g} to {float(upper[joint]):.5g} {unit}",
        remedy="change q or give it more time (check_limits=False skips this check)",
    )
