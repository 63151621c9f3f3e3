"""Elastic strain and stress of a sheet whose rest shape is not its pattern: grown, shrunk or plastically set.

With the deformation gradient F of the pattern, the elastic deformation is F_E = F A. A is the inverse of the rest
deformation, times the inverse of the plastic set where the material yields. Stored by rows: (A11, A12, A21, A22).
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from .._utils.linalg import cross
from ..errors import InvalidInput
from ..types import ClothState, EffectInputs, Memory, Surface
from .model import Model

MATERIAL_MEMORY_KEY = "material"  # the plastic set, among the internal variables


def update_memory(model: Model, state: ClothState, s: Surface, dt: float, compensation: Tensor | None = None) -> Memory:
    """Advance plastic set, internal friction and creases to the present deformation, ``dt`` [s] after the last time."""
    memory = dict(state.memory)
    if MATERIAL_MEMORY_KEY in memory:
        trial, _ = elastic_deformation(model, s, memory)
        memory[MATERIAL_MEMORY_KEY] = model.material.flow(model.coefficients, trial, memory[MATERIAL_MEMORY_KEY])
    for name, (effect, c) in model.effects.items():
        variables = memory.get(f"effects.{name}")
        if variables is not None:
            inputs = EffectInputs(state.x, state.v, s, model.mass, variables, dt, compensation)
            memory[f"effects.{name}"] = effect.update_memory(c, inputs)
    return memory


def elastic_deformation(model: Model, s: Surface, memory: Memory) -> tuple[Surface, Tensor | None]:
    """Return the elastic deformation F A, and the true rest area over the pattern's (None for 1)."""
    area_share = None
    if model.inverse_rest_deformation is not None:
        s = _change_rest_shape(s, model.inverse_rest_deformation)
        area_share = 1 / _determinant(model.inverse_rest_deformation)
    return (_change_rest_shape(s, memory[MATERIAL_MEMORY_KEY]) if MATERIAL_MEMORY_KEY in memory else s), area_share


def membrane_stress(model: Model, s: Surface, memory: Memory) -> tuple[Tensor, Tensor]:
    """Compute the columns of d(energy)/dF per area of the pattern, each [..., E, 3] N/m.

    P = P_E A^T, times the true rest area over the pattern's.
    """
    strained, area_share = elastic_deformation(model, s, memory)
    p1, p2 = model.material.membrane_stress(model.coefficients, strained)
    for inverse in (memory.get(MATERIAL_MEMORY_KEY), model.inverse_rest_deformation):
        if inverse is not None:
            a11, a12, a21, a22 = inverse.split(1, dim=-1)
            p1, p2 = a11 * p1 + a12 * p2, a21 * p1 + a22 * p2
    return (p1, p2) if area_share is None else (area_share * p1, area_share * p2)


def inverse_rest_deformation(deformations: Iterable[Tensor | None], warp_sign: Tensor | None) -> Tensor | None:
    """Return A = (G1 G2 ...)^-1 [..., E or 1, 4] by rows, of rest deformations [..., E or 1, 2, 2]; None without any.

    Args:
        deformations: of the pattern as it is drawn.
        warp_sign: [E or 1, 1], -1 where the material axes mirror a pattern that is drawn from behind; None: nowhere.

    Raises:
        InvalidInput: no area is left.
    """
    total = None
    for deformation in deformations:
        if deformation is not None:
            total = deformation if total is None else total @ deformation
    if total is None:
        return None
    try:
        inverse = torch.linalg.inv(total).flatten(-2)
    except torch.linalg.LinAlgError as error:  # pyright: ignore[reportPrivateImportUsage]
        got, expected = "a rest shape without area", "shrinkage below 1 and a skew within a right angle"
        raise InvalidInput("rest shape", got=got, expected=expected) from error
    if warp_sign is None:
        return inverse
    one = torch.ones_like(warp_sign)
    return inverse * torch.cat([one, warp_sign, warp_sign, one], dim=-1)


def rest_shape_gradient(gradient: Tensor, inverse: Tensor) -> Tensor:
    """Return shape-function gradients in the true rest shape, weighted so that squares are per area of the pattern.

    Args:
        gradient: [E, 3, 2] 1/m, of the pattern.
        inverse: [..., E or 1, 4], A by rows.
    """
    a = inverse.unflatten(-1, (2, 2))
    return gradient @ a * a.det().rsqrt()[..., None, None]


def _change_rest_shape(s: Surface, inverse: Tensor) -> Surface:
    """Return the surface as seen from another rest shape: F -> F A with A [..., E or 1, 4] by rows."""
    a11, a12, a21, a22 = inverse.split(1, dim=-1)
    f1, f2 = a11 * s.f1 + a21 * s.f2, a12 * s.f1 + a22 * s.f2
    return s._replace(f1=f1, f2=f2, cofactor1=cross(f2, s.n), cofactor2=cross(s.n, f1), J=_determinant(inverse) * s.J)


def _determinant(inverse: Tensor) -> Tensor:
    a11, a12, a21, a22 = inverse.split(1, dim=-1)
    return a11 * a22 - a12 * a21
