"""Membrane laws."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ...materials import AEP
from ..lowering import Lowering, Unfused


def lower(low: Lowering) -> None:
    """Membrane stress of the triangles."""
    law = _LAWS.get(type(low.model.material))
    if law is None or low.model.rest is not None or "material" in low.memory:
        raise Unfused(f"material {type(low.model.material).__name__}")
    low.triangles.stress(law(low, low.model.coefficients))


def _isotropic(low: Lowering, c: Any) -> list[int]:
    t = low.triangles
    return t.loop.call("aep", t.surface, t.parameter(c.mu), t.parameter(c.lam))


_LAWS: dict[type, Callable[[Lowering, Any], list[int]]] = {AEP: _isotropic}
