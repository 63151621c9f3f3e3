"""Units in which people read errors: lengths in millimetres."""

from __future__ import annotations

DISPLAY_UNITS = {"m": (1e3, "mm"), "m/s": (1e3, "mm/s")}  # factor and unit, by SI unit


def in_display_unit(unit: str, value: float, std: float | None = None) -> str:
    """Format a number in ``unit`` for people, with its standard deviation where that is given."""
    factor, shown = DISPLAY_UNITS.get(unit, (1.0, unit))
    error = "" if std is None else f" ± {factor * std:.2g}"
    return f"{factor * value:.3g}{error} {shown}"
