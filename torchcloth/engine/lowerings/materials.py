"""Membrane laws, from rest shapes other than the pattern."""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

from ...materials import AEP, NormYield, OrthotropicAEP, StiffeningAEP
from ..lowering import Lowering, Unfused


def lower(low: Lowering) -> None:
    """Membrane stress of the triangles, as in ``strain.membrane_stress``."""
    model, t = low.model, low.triangles
    law = _LAWS.get(type(model.material))
    if law is None:
        raise Unfused(f"material {type(model.material).__name__}")
    kernel, numbers = law(low)
    if model.rest is None and "material" not in low.memory:
        t.push(f"{kernel}_sheet", *t.x, t.shape, t.area, *numbers)
        return
    seen, growth, lasting = t.surface, None, None
    if model.rest is not None:
        growth = t.parameter(model.rest)
        seen = t.loop.call("seen_from", seen, growth)
    if "material" in low.memory:
        lasting = _flow(low, seen)
        seen = t.loop.call("seen_from", seen, lasting)
    columns = t.loop.call(kernel, seen, *numbers)
    if lasting is not None:
        columns = t.loop.call("pulled_back", columns, lasting)
    if growth is not None:
        columns = t.loop.call("grown", columns, growth)
    t.stress(columns)


def _flow(low: Lowering, seen: list[int]) -> list[int]:
    """The plastic set follows the surface."""
    plastic = getattr(low.model.material, "plastic", None)
    if type(plastic) is not NormYield:
        raise Unfused(f"plasticity {type(plastic).__name__}")
    t, memory = low.triangles, low.memory["material"]
    after = t.loop.call("norm_yield", seen, t.loop.load(memory.now), t.parameter(low.model.coefficients.limit))
    t.loop.put(after, memory.after)
    return after


def _isotropic(low: Lowering) -> tuple[str, list[list[int]]]:
    t, c = low.triangles, low.model.coefficients
    return "aep", [t.parameter(c.mu), t.parameter(c.lam)]


def _orthotropic(low: Lowering) -> tuple[str, list[list[int]]]:
    t, c = low.triangles, low.model.coefficients
    numbers = [t.parameter(v) for v in (c.mu, c.lam, c.balance, c.warp, c.weft, c.warp_toe, c.weft_toe)]
    reach = cast("OrthotropicAEP", low.model.material).stiffening_reach
    return "orthotropic", [*numbers, t.loop.load(low.number(reach))]


_LAWS: dict[type, Callable[[Lowering], tuple[str, list[list[int]]]]] = {
    AEP: _isotropic,
    OrthotropicAEP: _orthotropic,
    StiffeningAEP: _orthotropic,
}
