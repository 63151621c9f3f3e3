"""Membrane laws."""

from __future__ import annotations

from ...materials import AEP
from ..lowering import Lowering, Unfused


def lower(low: Lowering) -> None:
    """Membrane stress of the triangles."""
    law = _SHEETS.get(type(low.model.material))
    if law is None or low.model.rest is not None or "material" in low.memory:
        raise Unfused(f"material {type(low.model.material).__name__}")
    kernel, names = law
    t, c = low.triangles, low.model.coefficients
    coefficients = [t.parameter(getattr(c, name)) for name in names]
    t.forces(t.loop.call(kernel, *t.x, t.shape, t.area, *coefficients))


_SHEETS: dict[type, tuple[str, tuple[str, ...]]] = {AEP: ("aep", ("mu", "lam"))}
