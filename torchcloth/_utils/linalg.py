"""Small vector algebra with finite derivatives at the states that occur (flat, at rest, zero friction); curves."""

from __future__ import annotations

import torch
from torch import Tensor

EXACT_CDIST_MODE = "donot_use_mm_for_euclid_dist"  # of cdist: squares of 30 m have no digits for millimetres in float32
SEARCHSORTED_GRAIN_SIZE = 200  # torch's SEARCHSORTED_GRAIN_SIZE: a search for more wakes its threads, which then keep processors busy


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Inner product over the last axis, kept: [..., 3], [..., 3] -> [..., 1]."""
    return (a * b).sum(-1, keepdim=True)


def cross(a: Tensor, b: Tensor) -> Tensor:
    """Vector product over the last axis: [..., 3], [..., 3] -> [..., 3]."""
    return torch.linalg.cross(a, b)


def matvec(a: Tensor, b: Tensor) -> Tensor:
    """Matrix times vector: [..., 3, 3], [..., 3] -> [..., 3]."""
    return (a @ b.unsqueeze(-1)).squeeze(-1)


def safe_norm(a: Tensor) -> Tensor:
    """Length over the last axis, kept; value and derivative 0 at a = 0 (the plain square root gives NaN there)."""
    squared = dot(a, a)
    zero = squared == 0
    return torch.where(zero, torch.zeros_like(squared), torch.where(zero, 1.0, squared).sqrt())


def apply_added_mass(added_mass_ratio: Tensor | None, change: Tensor) -> Tensor:
    """(1 + B) y: what changes the velocity of cloth by y [..., 3] and that of the air that moves along, per mass.

    ``resistance`` is B [..., 3, 3], the mass of that air over the cloth's own; None: there is none.
    """
    return change if added_mass_ratio is None else change + matvec(added_mass_ratio, change)


def solve_added_mass(added_mass_ratio: Tensor | None, change: Tensor) -> Tensor:
    """(1 + B)^-1 y, the inverse; written so that B = 0 changes nothing, bitwise."""
    return change if added_mass_ratio is None else change - added_mass_correction(added_mass_ratio, change)


def added_mass_correction(added_mass_ratio: Tensor, change: Tensor) -> Tensor:
    """(1 + B)^-1 B y: by how much the air lessens a change. By Cramer's rule: CUDA's solver waits for its verdict."""
    one = torch.eye(3, dtype=change.dtype, device=change.device)
    (a, b, c), y = (one + added_mass_ratio).unbind(-1), matvec(added_mass_ratio, change)
    sides = cross(b, c), cross(c, a), cross(a, b)
    return torch.cat([dot(side, y) for side in sides], -1) / dot(a, sides[0])


def rigid_displacement(motion: Tensor, x: Tensor) -> Tensor:
    """Where a rigid motion [..., 4, 4] takes points [..., N, 3] m, less the points, to the last digits.

    A small turn hardly shows beside the ones of its matrix (in float32 not at all below 0.3 mrad), so it is taken from
    the other entries: with w = sin(angle) axis, (R - 1) x = w x x + (w (w . x) - |w|^2 x) / (1 + cos(angle)). Turns of
    less than 90 degrees.
    """
    R = motion[..., None, :3, :3]
    w = 0.5 * torch.stack([R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], -1)
    squared = dot(w, w)
    bent = (dot(w, x) * w - squared * x) / (1 + (1 - squared).sqrt())
    return torch.linalg.cross(*torch.broadcast_tensors(w, x)) + bent + motion[..., None, :3, 3]


def find_last_knot(t: Tensor, times: Tensor) -> Tensor:
    """[N] index of the last of the knots ``t`` [K], increasing, at or before each of ``times`` [N]; -1: none."""
    return torch.cat([torch.searchsorted(t, some, right=True) for some in times.detach().split(SEARCHSORTED_GRAIN_SIZE)]) - 1


def interpolate_hermite(t: Tensor, value: Tensor, slope: Tensor, times: Tensor) -> Tensor:
    """[..., N, A, B] at ``times`` [N] of cubics between knots ``t`` [K], constant beyond.

    ``value`` and ``slope``, its derivative, are [..., K, A, B].
    """
    k, _, s = _between_knots(t, times)
    a, b, c, d = _cubics(t, value, slope, k)
    return torch.addcmul(a, s, torch.addcmul(b, s, torch.addcmul(c, s, d)))


def differentiate_hermite(t: Tensor, value: Tensor, slope: Tensor, times: Tensor) -> Tensor:
    """Derivative of ``hermite`` by ``times``; the first and last slope beyond."""
    k, step, s = _between_knots(t, times)
    _, b, c, d = _cubics(t, value, slope, k)
    return torch.addcmul(b, s, torch.addcmul(2 * c, 3 * s, d)) / step


def _cubics(t: Tensor, value: Tensor, slope: Tensor, k: Tensor) -> tuple[Tensor, ...]:
    """Coefficients [..., N, A, B] of each power, from the constant on, of the share of the way from the knots ``k``."""
    rise = value[..., 1:, :, :] - value[..., :-1, :, :]
    step = (t[1:] - t[:-1])[:, None, None]
    first, last = step * slope[..., :-1, :, :], step * slope[..., 1:, :, :]
    found = (value[..., :-1, :, :], first, 3 * rise - 2 * first - last, first + last - 2 * rise)
    return torch.stack(found, -3).index_select(-4, k).unbind(-3)


def _between_knots(t: Tensor, times: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """(knot before [N], to the next one [N, 1, 1], share of that way [N, 1, 1]) of ``times`` [N]; 0 and 1 beyond."""
    k = find_last_knot(t, times).clamp(0, len(t) - 2)
    step = (t[k + 1] - t[k])[:, None, None]
    return k, step, ((times - t[k])[:, None, None] / step).clamp(0.0, 1.0)
