"""Tension: nylon at angles that were not fitted, and the third pull of knits from the first two."""

from __future__ import annotations

from dataclasses import asdict
from math import radians
from pathlib import Path
from typing import Any

import numpy as np

from torchcloth.identification import cross_validate, fit_tension, predict_tension, make_specimen
from torchcloth.identification.tension.model import TensionModel
from torchcloth.recordings import ForceDisplacement

from ...validation.realdata import knits as knit_adapter
from ...validation.realdata import nylon as nylon_adapter

NYLON, KNITS = "nylon_offaxis_tension", "knit_tension"
LIGHT = 5.0  # N, over 0.07 to 0.15 m of knit: what a robot pulls with
BETWEEN = (15, 60, 75)  # degrees, that were not measured here
STRAINS = (0.01, 0.02, 0.04)
EVERY = {True: 8, False: 2}  # rows of nylon; fast, whole


def nylon(source: Path, out: Path, fast: bool) -> dict[str, Any]:
    """The four angles together, each from the other three, and angles between; saves the fit for `torchcloth predict`.

    The interval of an angle that was left out takes the law's part from the others, each left out of those three.
    """
    adapter = nylon_adapter
    tables = {angle: t.select_rows(slice(None, None, EVERY[fast])) for angle, t in adapter.tables(source).items()}
    pulls, names = list(tables.values()), adapter.NAMES
    fit = fit_tension(adapter.start(), pulls, names)
    *parts, whole = cross_validate(fit, adapter.start(), pulls)
    whole.save(out)
    left_out = {}
    for angle, part in zip(tables, parts, strict=True):
        *_, nested = cross_validate(part, adapter.start(), [t for a, t in tables.items() if a != angle])
        model = nested.model
        unknown = [name for name in names if not part.parameters[name].identifiable]
        left_out[str(angle)] = predict_tension(model, tables[angle]).as_dict() | {"not_identifiable": unknown}
    return {
        "parameters": {name: asdict(fit.parameters[name]) for name in names},
        "fitted": {str(angle): predict_tension(whole.model, t).as_dict() for angle, t in tables.items()},
        "left_out": left_out,
        "between": {str(angle): at_strains(whole.model, angle) for angle in BETWEEN},
        "warnings": fit.warnings,
    }


def at_strains(model: TensionModel, angle: float) -> list[dict[str, float]]:
    """Force of a strip at an angle [degrees] and some strains, with the parts of its error."""
    table, std = make_specimen(model, radians(angle), strain=max(STRAINS), rows=101)
    found = predict_tension(model, table, std).force
    low, high = found.ci95
    rows = [int(np.abs(table.strain - strain).argmin()) for strain in STRAINS]
    parts = {"force": found.value, "parameters": found.parameter_std, "law": found.misfit_std, "setup": found.setup_std}
    parts |= {"low": low, "high": high, "strain": table.strain}
    return [{key: float(value[i]) for key, value in parts.items()} for i in rows]


def fabrics(source: Path, fast: bool) -> list[str]:
    """Names of the knits; fast: one."""
    found = sorted(knit_adapter.fabrics(source))
    return found[-1:] if fast else found


def knit(source: Path, out: Path, name: str) -> dict[str, Any]:
    """One fabric, both directions: fit of repeats 1 and 2, prediction of 3, and how far repeats are from each other."""
    adapter = knit_adapter
    light = [table.select_rows(table.force < LIGHT) for table in adapter.fabrics(source)[name]]
    fit = fit_tension(adapter.start(), [table.select_repeats(1, 2) for table in light], adapter.NAMES)
    fit.save(out)
    third = [table.select_repeats(3) for table in light]
    return {
        "poisson_ratio": asdict(fit.parameters["poisson_ratio"]),
        "directions": {
            label: {"prediction": predict_tension(fit.model, seen).as_dict(), "floor": floor(table)}
            for label, seen, table in zip("XY", third, light, strict=True)
        },
        "warnings": fit.warnings,
    }


def floor(table: ForceDisplacement) -> dict[str, float]:
    """RMS of the third pull from the mean of the first two at the same displacement, as shares of its largest reading.

    No law that knows only these two pulls can be expected to come nearer.
    """
    third, out = table.select_repeats(3), {}
    for kind in ("force", "lateral_strain"):
        both = []
        for k in (1, 2):
            pull = table.select_repeats(k)
            order = np.argsort(pull.displacement)
            values = getattr(pull, kind)[order]
            at = pull.displacement[order]
            both.append(np.interp(third.displacement, at, values, left=np.nan, right=np.nan))
        seen = getattr(third, kind)
        off = seen - np.mean(both, axis=0)
        known = np.isfinite(off)
        out[kind.split("_")[0]] = float(np.sqrt((off[known] ** 2).mean()) / np.abs(seen[np.isfinite(seen)]).max())
    return out
