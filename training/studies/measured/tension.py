"""Tension: predictions of nylon at other angles, and of the third pull of knits from the first two."""

from __future__ import annotations

from dataclasses import asdict
from math import radians
from pathlib import Path
from typing import Any

import numpy as np

from torchcloth.identification import cross_validate, fit_tension, make_specimen, predict_tension
from torchcloth.identification.tension.model import TensionModel
from torchcloth.recordings import ForceDisplacement

from ...validation.realdata import knits as knit_adapter
from ...validation.realdata import nylon as nylon_adapter

NYLON_SOURCE, KNIT_SOURCE = "nylon_offaxis_tension", "knit_tension"
MAX_ROBOT_FORCE_N = 5.0  # over 0.07 to 0.15 m of knit, a typical pull of a robot
UNMEASURED_ANGLES_DEG = (15, 60, 75)
REPORTED_STRAINS = (0.01, 0.02, 0.04)
ROW_STRIDE = {True: 8, False: 2}  # of nylon rows, by ``fast``


def nylon(source: Path, out: Path, fast: bool) -> dict[str, Any]:
    """Fit four angles together, predict each from the other three, and predict angles between.

    The fit is saved for `torchcloth predict`. The model error in the interval of a left-out angle is from a nested
    cross-validation over the other three.
    """
    adapter = nylon_adapter
    rows = slice(None, None, ROW_STRIDE[fast])
    tables = {angle: table.select_rows(rows) for angle, table in adapter.read_tables(source).items()}
    pulls, names = list(tables.values()), adapter.NYLON_PARAMETERS
    fit = fit_tension(adapter.initial_cloth(), pulls, names)
    *parts, whole = cross_validate(fit, adapter.initial_cloth(), pulls)
    whole.save(out)
    left_out = {}
    for angle, part in zip(tables, parts, strict=True):
        *_, nested = cross_validate(part, adapter.initial_cloth(), [t for a, t in tables.items() if a != angle])
        model = nested.model
        unknown = [name for name in names if not part.parameters[name].identifiable]
        left_out[str(angle)] = predict_tension(model, tables[angle]).as_dict() | {"not_identifiable": unknown}
    return {
        "parameters": {name: asdict(fit.parameters[name]) for name in names},
        "fitted": {str(angle): predict_tension(whole.model, t).as_dict() for angle, t in tables.items()},
        "left_out": left_out,
        "between": {str(angle): at_strains(whole.model, angle) for angle in UNMEASURED_ANGLES_DEG},
        "warnings": fit.warnings,
    }


def at_strains(model: TensionModel, angle: float) -> list[dict[str, float]]:
    """Predict the force of a strip at an angle [degrees] and some strains, with the parts of its standard error."""
    table, std = make_specimen(model, radians(angle), strain=max(REPORTED_STRAINS), rows=101)
    prediction = predict_tension(model, table, std).force
    low, high = prediction.ci95
    rows = [int(np.abs(table.strain - strain).argmin()) for strain in REPORTED_STRAINS]
    parts = {
        "force": prediction.value,
        "parameters": prediction.parameter_std,
        "law": prediction.misfit_std,
        "setup": prediction.setup_std,
    }
    parts |= {"low": low, "high": high, "strain": table.strain}
    return [{key: float(value[i]) for key, value in parts.items()} for i in rows]


def fabrics(source: Path, fast: bool) -> list[str]:
    """Return the names of the knits; one if ``fast``."""
    prediction = sorted(knit_adapter.read_fabrics(source))
    return prediction[-1:] if fast else prediction


def knit(source: Path, out: Path, name: str) -> dict[str, Any]:
    """Fit repeats 1 and 2 of a fabric in both directions, predict repeat 3, and compute the scatter of repeats."""
    adapter = knit_adapter
    light = [table.select_rows(table.force < MAX_ROBOT_FORCE_N) for table in adapter.read_fabrics(source)[name]]
    fit = fit_tension(adapter.initial_cloth(), [table.select_repeats(1, 2) for table in light], adapter.KNIT_PARAMETERS)
    fit.save(out)
    third = [table.select_repeats(3) for table in light]
    return {
        "poisson_ratio": asdict(fit.parameters["poisson_ratio"]),
        "directions": {
            label: {"prediction": predict_tension(fit.model, readings).as_dict(), "floor": repeat_floor(table)}
            for label, readings, table in zip("XY", third, light, strict=True)
        },
        "warnings": fit.warnings,
    }


def repeat_floor(table: ForceDisplacement) -> dict[str, float]:
    """Return the RMS difference of the third pull from the mean of the first two, relative to its largest reading.

    A law that is fitted to these two pulls cannot be expected to come nearer.
    """
    third, out = table.select_repeats(3), {}
    for kind in ("force", "lateral_strain"):
        first_pulls = []
        for k in (1, 2):
            pull = table.select_repeats(k)
            order = np.argsort(pull.displacement)
            values = getattr(pull, kind)[order]
            at = pull.displacement[order]
            first_pulls.append(np.interp(third.displacement, at, values, left=np.nan, right=np.nan))
        readings = getattr(third, kind)
        deviation = readings - np.mean(first_pulls, axis=0)
        known = np.isfinite(deviation)
        out[kind.split("_")[0]] = float(
            np.sqrt((deviation[known] ** 2).mean()) / np.abs(readings[np.isfinite(readings)]).max()
        )
    return out
