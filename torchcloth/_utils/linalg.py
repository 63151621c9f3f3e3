"""Vector algebra with finite derivatives at the states that occur (flat, at rest, zero friction), and cubic curves."""

from __future__ import annotations

import torch
from torch import Tensor

EXACT_CDIST_MODE = "donot_use_mm_for_euclid_dist"  # the matrix product has no digits for millimetres at 30 m in float32
# torch's own constant: a search for more values wakes its threads, which then keep processors busy for milliseconds
SEARCHSORTED_GRAIN_SIZE = 200


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Return the inner product over the last axis: [..., 3], [..., 3] -> [..., 1]."""
    return (a * b).sum(-1, keepdim=True)


def cross(a: Tensor, b: Tensor) -> Tensor:
    """Return the vector product over the last axis: [..., 3], [..., 3] -> [..., 3]."""
    return torch.linalg.cross(a, b)


def matvec(a: Tensor, b: Tensor) -> Tensor:
    """Return the product of matrix and vector: [..., 3, 3], [..., 3] -> [..., 3]."""
    return (a @ b.unsqueeze(-1)).squeeze(-1)


def safe_norm(a: Tensor) -> Tensor:
    """Return the length over the last axis, [..., 1]; value and derivative are 0 at a = 0.

    The plain square root has a NaN derivative there.
    """
    squared = dot(a, a)
    zero = squared == 0
    return torch.where(zero, torch.zeros_like(squared), torch.where(zero, 1.0, squared).sqrt())


def apply_added_mass(added_mass_ratio: Tensor | None, change: Tensor) -> Tensor:
    """Return (1 + B) y: the impulse per mass that changes the velocity of cloth and its added mass by y.

    Args:
        added_mass_ratio: B [..., 3, 3], mass of the air that moves along over the cloth's own; None without any.
        change: y [..., 3].
    """
    return change if added_mass_ratio is None else change + matvec(added_mass_ratio, change)


def solve_added_mass(added_mass_ratio: Tensor | None, change: Tensor) -> Tensor:
    """Return (1 + B)^-1 y, the inverse of ``apply_added_mass``; with B = 0 it changes nothing, bitwise."""
    return change if added_mass_ratio is None else change - added_mass_correction(added_mass_ratio, change)


def added_mass_correction(added_mass_ratio: Tensor, change: Tensor) -> Tensor:
    """Return (1 + B)^-1 B y, by how much the added mass reduces a change of velocity.

    By Cramer's rule: a CUDA solver would wait for its error flag.
    """
    one = torch.eye(3, dtype=change.dtype, device=change.device)
    (a, b, c), y = (one + added_mass_ratio).unbind(-1), matvec(added_mass_ratio, change)
    cofactors = cross(b, c), cross(c, a), cross(a, b)
    return torch.cat([dot(cofactor, y) for cofactor in cofactors], -1) / dot(a, cofactors[0])


def rigid_displacement(motion: Tensor, x: Tensor) -> Tensor:
    """Return by how much a rigid motion [..., 4, 4] moves points [..., N, 3] m, exact to the last digits.

    A small turn hardly shows on the diagonal of its matrix (in float32 not at all below 0.3 mrad), so it is taken from
    the other entries: with w = sin(angle) axis, (R - 1) x = w x x + (w (w . x) - |w|^2 x) / (1 + cos(angle)). Turns of
    less than 90 degrees only.
    """
    R = motion[..., None, :3, :3]
    w = 0.5 * torch.stack([R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], -1)
    squared = dot(w, w)
    second_order = (dot(w, x) * w - squared * x) / (1 + (1 - squared).sqrt())
    return torch.linalg.cross(*torch.broadcast_tensors(w, x)) + second_order + motion[..., None, :3, 3]


def find_last_knot(t: Tensor, times: Tensor) -> Tensor:
    """Return the index [N] of the last knot of ``t`` [K], increasing, at or before each of ``times`` [N]; -1: none."""
    parts = times.detach().split(SEARCHSORTED_GRAIN_SIZE)
    return torch.cat([torch.searchsorted(t, part, right=True) for part in parts]) - 1


def interpolate_hermite(t: Tensor, value: Tensor, slope: Tensor, times: Tensor) -> Tensor:
    """Interpolate with cubic Hermite polynomials; constant beyond the knots.

    Args:
        t: [K], knots, increasing.
        value: [..., K, A, B], values at the knots.
        slope: [..., K, A, B], derivatives at the knots.
        times: [N].

    Returns:
        [..., N, A, B] at ``times``.
    """
    k, _, s = _locate(t, times)
    a, b, c, d = _cubic_coefficients(t, value, slope, k)
    return torch.addcmul(a, s, torch.addcmul(b, s, torch.addcmul(c, s, d)))


def differentiate_hermite(t: Tensor, value: Tensor, slope: Tensor, times: Tensor) -> Tensor:
    """Return the derivative of ``interpolate_hermite`` with respect to ``times``; the end slopes beyond the knots."""
    k, step, s = _locate(t, times)
    _, b, c, d = _cubic_coefficients(t, value, slope, k)
    return torch.addcmul(b, s, torch.addcmul(2 * c, 3 * s, d)) / step


def _cubic_coefficients(t: Tensor, value: Tensor, slope: Tensor, k: Tensor) -> tuple[Tensor, ...]:
    """Return the coefficients [..., N, A, B] of s^0 to s^3 in the intervals that start at the knots ``k`` [N]."""
    rise = value[..., 1:, :, :] - value[..., :-1, :, :]
    step = (t[1:] - t[:-1])[:, None, None]
    start, end = step * slope[..., :-1, :, :], step * slope[..., 1:, :, :]
    coefficients = (value[..., :-1, :, :], start, 3 * rise - 2 * start - end, start + end - 2 * rise)
    return torch.stack(coefficients, -3).index_select(-4, k).unbind(-3)


def _locate(t: Tensor, times: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the interval's first knot [N], its length [N, 1, 1], and the fraction of it [N, 1, 1] in [0, 1]."""
    k = find_last_knot(t, times).clamp(0, len(t) - 2)
    step = (t[k + 1] - t[k])[:, None, None]
    return k, step, ((times - t[k])[:, None, None] / step).clamp(0.0, 1.0)
