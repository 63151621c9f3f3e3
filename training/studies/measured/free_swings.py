"""IRI swings: drag and added mass that give the free swings of 20 runs their frequency and decay.

The strokes before are simulated, so that a swing begins as it did, but only the free part after the stop is compared:
small swings, where a whole run is mostly large and fast ones. Two numbers from two numbers, by repeated proportion.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ...validation.realdata import swings
from .swing_predictions import drawn, frequency_and_decay, predict
from .swings import DENSITY, EFFECTS, NAMES

BEGIN = {"air.normal": 10.0, "added.length": 0.113, "damping.rate": 0.0}
ROUNDS, DRAWS = 5, 20


def match(source: Path, names: Sequence[str], fast: bool) -> dict[str, Any]:
    """The values, their ratios to the areal density with errors by drawing runs again, and how well they match.

    A small swing has the frequency f0 / sqrt(1 + mu) with mu the added mass, and its quadratic decay goes as
    delta f / (1 + mu) with delta the drag; both are exact in the limit, and their steps are repeated.
    """
    air, values = swings.AIR, dict(BEGIN)
    for left in reversed(range(1 if fast else ROUNDS)):
        runs = [predict(source, name, {"model": values}) for name in names]
        seen = frequency_and_decay([run["measured"] for run in runs], drawn(len(runs), DRAWS))
        reached = frequency_and_decay([run["model"] for run in runs], drawn(len(runs), 1))
        if left:
            values = _next(values, seen, reached, air / DENSITY)
    mass, drag = (air / DENSITY * values[name] for name in ("added.length", "air.normal"))
    mass_std = 2 * (1 + mass) * seen["frequency_std"] / seen["frequency"]
    drag_std = drag * seen["decay_std"] / seen["decay"]
    said = zip(EFFECTS, ((drag, drag_std), (mass, mass_std)), strict=False)
    ratios = {
        name: {"value": v, "std": s, "low": v - 1.96 * s, "high": v + 1.96 * s, "identifiable": s < 0.25 * v}
        for name, (v, s) in said
    }
    return {"values": values, "ratios": ratios, "measured": seen, "reached": reached}


def _next(
    values: dict[str, float], seen: dict[str, float], reached: dict[str, float], scale: float
) -> dict[str, float]:
    """By proportion."""
    before = 1 + scale * values["added.length"]
    faster = reached["frequency"] / seen["frequency"]
    after = before * faster**2
    drag = values["air.normal"] * seen["decay"] / reached["decay"] * after / before * faster
    return dict(zip(NAMES, (drag, max(0.0, (after - 1) / scale), 0.0), strict=True))
