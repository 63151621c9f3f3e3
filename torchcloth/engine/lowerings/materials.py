"""Membrane laws, also from rest shapes other than the pattern.

A material with a lowering here obeys ``DirectorMaterial``'s law across the sheet, which ``contact`` relies on.
"""

from __future__ import annotations

from typing import cast

from ...materials import AEP, NormYield, OrthotropicAEP, StiffeningAEP
from ..builder import SubstepBuilder, UnsupportedPart, lowering_of, lowers


def lower_material(builder: SubstepBuilder) -> None:
    """Add the membrane stress of the triangles, as ``dynamics.elasticity.membrane_stress`` computes it.

    Raises:
        UnsupportedPart: the material or its plasticity has no kernels.
    """
    model, t = builder.model, builder.triangles
    law = lowering_of(model.material)
    if law is None:
        raise UnsupportedPart(f"material {type(model.material).__name__}")
    kernel, coefficients = law(builder)
    if model.inverse_rest_deformation is None and "material" not in builder.memory:
        t.add_corner_forces(f"{kernel}_forces", *t.x, t.shape, t.area, *coefficients)
        return
    surface, growth, plastic_set = t.surface, None, None
    if model.inverse_rest_deformation is not None:
        growth = t.parameter(model.inverse_rest_deformation)
        surface = t.loop.call("elastic_deformation", surface, growth)
    if "material" in builder.memory:
        plastic_set = _update_plastic_set(builder, surface)
        surface = t.loop.call("elastic_deformation", surface, plastic_set)
    columns = t.loop.call(f"{kernel}_stress", surface, *coefficients)
    if plastic_set is not None:
        columns = t.loop.call("pull_back_stress", columns, plastic_set)
    if growth is not None:
        columns = t.loop.call("rest_deformation_pullback", columns, growth)
    t.add_stress(columns)


def _update_plastic_set(builder: SubstepBuilder, surface: list[int]) -> list[int]:
    plastic = getattr(builder.model.material, "plastic", None)
    if type(plastic) is not NormYield:
        raise UnsupportedPart(f"plasticity {type(plastic).__name__}")
    t, memory = builder.triangles, builder.memory["material"]
    limit = t.parameter(builder.model.coefficients.limit)
    plastic_set = t.loop.call("norm_yield", surface, t.loop.load(memory.start), limit)
    t.loop.store(plastic_set, memory.end)
    return plastic_set


@lowers(AEP)
def lower_isotropic(builder: SubstepBuilder) -> tuple[str, list[list[int]]]:
    """Return (name of the law, registers of its coefficients)."""
    t, c = builder.triangles, builder.model.coefficients
    return "aep", [t.parameter(c.mu), t.parameter(c.lam)]


@lowers(OrthotropicAEP, StiffeningAEP)
def lower_orthotropic(builder: SubstepBuilder) -> tuple[str, list[list[int]]]:
    """Return (name of the law, registers of its coefficients)."""
    t, c = builder.triangles, builder.model.coefficients
    coefficients = [t.parameter(v) for v in (c.mu, c.lam, c.balance, c.warp, c.weft, c.warp_toe, c.weft_toe)]
    reach = cast("OrthotropicAEP", builder.model.material).stiffening_reach
    return "orthotropic", [*coefficients, t.loop.load(builder.number(reach))]
