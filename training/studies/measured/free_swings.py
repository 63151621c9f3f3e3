"""IRI swings: drag and added mass that match frequency and decay of the free swings of 20 runs.

The strokes before a swing are simulated, so that it starts as in the recording. Only the free part after the stop is
compared, where swings are small; most of a whole run are large and fast swings. Two parameters are found from two
measurements by repeated proportion.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from torchcloth._utils.constants import STANDARD_AIR_DENSITY_KG_PER_M3, Z_95
from torchcloth.episodes.unknowns import IDENTIFIABILITY_CRITERIA

from .swing_predictions import bootstrap_indices, frequency_and_decay, predict
from .swings import FITTED_NAMES, NOMINAL_DENSITY_KG_PER_M2, RATIO_UNITS

START_VALUES = {"air.normal": 10.0, "added.length": 0.113, "damping.rate": 0.0}
PROPORTION_ROUNDS, BOOTSTRAP_DRAWS = 5, 20


def match(source: Path, names: Sequence[str], fast: bool) -> dict[str, Any]:
    """Match drag and added mass; return the values, their ratios to the areal density, and the match.

    A small swing has the frequency f0 / sqrt(1 + mu) with the added mass mu. Its quadratic decay is proportional to
    delta f / (1 + mu) with the drag delta. Both hold in the limit of small swings, so the steps are repeated. Standard
    errors are from a bootstrap over the runs.
    """
    air, values = STANDARD_AIR_DENSITY_KG_PER_M3, dict(START_VALUES)
    for remaining in reversed(range(1 if fast else PROPORTION_ROUNDS)):
        runs = [predict(source, name, {"model": values}) for name in names]
        measured = frequency_and_decay([run["measured"] for run in runs], bootstrap_indices(len(runs), BOOTSTRAP_DRAWS))
        simulated = frequency_and_decay([run["model"] for run in runs], bootstrap_indices(len(runs), 1))
        if remaining:
            values = _next(values, measured, simulated, air / NOMINAL_DENSITY_KG_PER_M2)
    mass, drag = (air / NOMINAL_DENSITY_KG_PER_M2 * values[name] for name in ("added.length", "air.normal"))
    mass_std = 2 * (1 + mass) * measured["frequency_std"] / measured["frequency"]
    drag_std = drag * measured["decay_std"] / measured["decay"]
    named = zip(RATIO_UNITS, ((drag, drag_std), (mass, mass_std)), strict=False)
    ratios = {
        name: {
            "value": v,
            "std": s,
            "low": v - Z_95 * s,
            "high": v + Z_95 * s,
            "identifiable": IDENTIFIABILITY_CRITERIA.is_precise(s, v, 0.0),
        }
        for name, (v, s) in named
    }
    return {"values": values, "ratios": ratios, "measured": measured, "reached": simulated}


def _next(
    values: dict[str, float], measured: dict[str, float], simulated: dict[str, float], scale: float
) -> dict[str, float]:
    """Return the next values by proportion."""
    before = 1 + scale * values["added.length"]
    faster = simulated["frequency"] / measured["frequency"]
    after = before * faster**2
    drag = values["air.normal"] * measured["decay"] / simulated["decay"] * after / before * faster
    return dict(zip(FITTED_NAMES, (drag, max(0.0, (after - 1) / scale), 0.0), strict=True))
