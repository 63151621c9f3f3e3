"""Elastic strain of a sheet whose rest shape is not its pattern: grown, shrunk or plastically set."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from .._utils.linalg import cross
from ..errors import InvalidInput
from ..types import ClothState, Memory, Moment, Surface
from .model import Model

MATERIAL = "material"  # key of the plastic set among the internal variables


def evolve(model: Model, state: ClothState, s: Surface, dt: float, lost: Tensor | None = None) -> Memory:
    """Plastic set, internal friction and creases follow the cloth to where it is now, ``dt`` [s] later."""
    memory = dict(state.memory)
    if MATERIAL in memory:
        trial, _ = elastic(model, s, memory)
        memory[MATERIAL] = model.material.flow(model.coefficients, trial, memory[MATERIAL])
    for name, (effect, c) in model.effects.items():
        own = memory.get(f"effects.{name}")
        if own is not None:
            memory[f"effects.{name}"] = effect.evolve(c, Moment(state.x, state.v, s, model.mass, own, dt, lost))
    return memory


def elastic(model: Model, s: Surface, memory: Memory) -> tuple[Surface, Tensor | None]:
    """(elastic deformation F A, true rest area over the pattern's or None for 1)."""
    share = None
    if model.rest is not None:
        s = _seen_from(s, model.rest)
        share = 1 / _determinant(model.rest)
    return (_seen_from(s, memory[MATERIAL]) if MATERIAL in memory else s), share


def membrane_stress(model: Model, s: Surface, memory: Memory) -> tuple[Tensor, Tensor]:
    """Columns of d(energy)/dF per area of the pattern [..., E, 3] N/m: P = P_E A^T, times the growth of the area."""
    strained, share = elastic(model, s, memory)
    p1, p2 = model.material.membrane_stress(model.coefficients, strained)
    for inverse in (memory.get(MATERIAL), model.rest):
        if inverse is not None:
            a11, a12, a21, a22 = inverse.split(1, dim=-1)
            p1, p2 = a11 * p1 + a12 * p2, a21 * p1 + a22 * p2
    return (p1, p2) if share is None else (share * p1, share * p2)


def inverse_growth(growths: Iterable[Tensor | None]) -> Tensor | None:
    """A = (G1 G2 ...)^-1 [..., E or 1, 4] by rows, of growths [..., E or 1, 2, 2]; None without any.

    Raises:
        InvalidInput: no area is left.
    """
    total = None
    for growth in growths:
        if growth is not None:
            total = growth if total is None else total @ growth
    if total is None:
        return None
    try:
        return torch.linalg.inv(total).flatten(-2)
    except torch.linalg.LinAlgError as error:  # pyright: ignore[reportPrivateImportUsage]
        got, expected = "a rest shape without area", "shrinkage below 1 and a skew within a right angle"
        raise InvalidInput("rest shape", got=got, expected=expected) from error


def grown_gradient(gradient: Tensor, rest: Tensor) -> Tensor:
    """Gradients of the shape functions in the true rest shape, weighted so that their squares are per pattern area."""
    inverse = rest.unflatten(-1, (2, 2))
    return gradient @ inverse * inverse.det().rsqrt()[..., None, None]


def _seen_from(s: Surface, inverse: Tensor) -> Surface:
    """The surface seen from another rest shape: F -> F A with A [..., E or 1, 4] by rows."""
    a11, a12, a21, a22 = inverse.split(1, dim=-1)
    f1, f2 = a11 * s.f1 + a21 * s.f2, a12 * s.f1 + a22 * s.f2
    return s._replace(f1=f1, f2=f2, cofactor1=cross(f2, s.n), cofactor2=cross(s.n, f1), J=_determinant(inverse) * s.J)


def _determinant(inverse: Tensor) -> Tensor:
    a11, a12, a21, a22 = inverse.split(1, dim=-1)
    return a11 * a22 - a12 * a21
