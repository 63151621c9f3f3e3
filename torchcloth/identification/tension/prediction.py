"""Predict the reading of a specimen that was not pulled, with an interval, and check how well that works."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..._utils.constants import Z_95
from ...cloth import Cloth
from ...errors import InvalidInput
from ...recordings import ForceDisplacement
from .fit import TensionFit, fit_tension
from .model import FittedTable, TensionModel, add_left_out_misfit, force_misfit

TENSION_PREDICTION_SCHEMA = "torchcloth.tension-prediction/1"
DEFAULT_CURVE_ROWS = 41
SAME_ANGLE_RAD = 0.01  # difference within which an angle is one that was fitted
MAX_STRAIN_RATIO = 1.02  # over the largest fitted strain, beyond which a curve is extrapolated
MAX_DIMENSION_RATIO = 1.001  # between fitted specimens whose dimensions agree
TENSION_PREDICTION_CONVENTION = (
    "SI units, angle in degrees from the warp. std_parameters: standard error by the fit's covariance (delta method); "
    "it accounts for errors that are correlated along a curve. std_misfit: standard deviation of the law's misfit. Its "
    "square grows in proportion to the force's rise above the preload, or to the lateral strain. At fitted angles it "
    "is the misfit of all fitted tables. At other angles it is the misfit of tables that were left out of the fit "
    "(those between other tables' angles, where the angle is between fitted ones), less the part that the errors of "
    "the parameters explain. std_setup: of a preload that was not given. It is then the force at the mean strain at "
    "which fitted tables began, within their scatter. std: all parts, as independent. ci95: 1.96 std. lateral_strain: "
    "null where no fitted table had it. measured: errors as fractions of the largest reading; coverage: fraction of "
    "readings in ci95."
)


@dataclass(frozen=True, eq=False)
class PredictionBand:
    """A predicted quantity [N] with the parts of its standard deviation.

    Attributes:
        value: [N].
        parameter_std: [N] by the covariance of the fitted parameters.
        misfit_std: [N] by the law's misfit.
        setup_std: [N] by a preload that was not given.
    """

    value: np.ndarray
    parameter_std: np.ndarray
    misfit_std: np.ndarray
    setup_std: np.ndarray

    @property
    def std(self) -> np.ndarray:
        """Standard deviation [N] of all parts, as independent."""
        return np.sqrt(self.parameter_std**2 + self.misfit_std**2 + self.setup_std**2)

    @property
    def ci95(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper end of the 95 % interval, [N] each."""
        return self.value - Z_95 * self.std, self.value + Z_95 * self.std

    def as_dict(self) -> dict[str, Any]:
        """Return the content for JSON."""
        low, high = self.ci95
        parts = {
            "value": self.value,
            "std_parameters": self.parameter_std,
            "std_misfit": self.misfit_std,
            "std_setup": self.setup_std,
            "std": self.std,
        }
        return {key: part.tolist() for key, part in parts.items()} | {"ci95": [low.tolist(), high.tolist()]}

    def compare(self, readings: np.ndarray) -> dict[str, float]:
        """Return rms and largest error as fractions of the largest reading, and the fraction inside the interval."""
        rows = np.isfinite(readings)
        largest = np.abs(readings[rows]).max(initial=0.0)
        if not largest > 0:
            raise InvalidInput(
                "readings", got="nothing but zeros", expected="some that are not", remedy="leave them out"
            )
        errors = np.abs(self.value - readings)[rows] / largest
        low, high = self.ci95
        is_inside = (readings >= low) & (readings <= high)
        return {
            "rms": float((errors**2).mean() ** 0.5),
            "max": float(errors.max()),
            "coverage": float(is_inside[rows].mean()),
        }


@dataclass(frozen=True, eq=False)
class TensionPrediction:
    """The result of ``predict_tension``.

    Attributes:
        table: the specimen, its displacements, and its readings where there are any.
        force: N.
        lateral_strain: None where no fitted table had it.
        misfit_source: tables from which the law's misfit was taken, in words.
        warnings: what to mistrust, in sentences.
    """

    table: ForceDisplacement
    force: PredictionBand
    lateral_strain: PredictionBand | None
    misfit_source: str
    warnings: list[str]

    def compare_with_readings(self) -> dict[str, dict[str, float]]:
        """Return ``PredictionBand.compare`` by kind of reading."""
        kinds = (("force", self.force, self.table.force), ("lateral", self.lateral_strain, self.table.lateral_strain))
        return {
            kind: band.compare(readings)
            for kind, band, readings in kinds
            if band is not None and readings is not None and bool(np.isfinite(readings).any())
        }

    def as_dict(self) -> dict[str, Any]:
        """Return the content of prediction.json."""
        t, lateral = self.table, self.lateral_strain
        return {
            "schema": TENSION_PREDICTION_SCHEMA,
            "specimen": {
                "angle": math.degrees(t.angle),
                "length": t.length,
                "width": t.width,
                "preload": t.preload,
            },
            "displacement": t.displacement.tolist(),
            "strain": t.strain.tolist(),
            "force": self.force.as_dict(),
            "lateral_strain": None if lateral is None else lateral.as_dict(),
            "misfit_source": self.misfit_source,
            "measured": self.compare_with_readings(),
            "warnings": self.warnings,
            "convention": TENSION_PREDICTION_CONVENTION,
        }


def predict_tension(model: TensionModel, table: ForceDisplacement, preload_std: float = 0.0) -> TensionPrediction:
    """Predict the law's reading of a specimen with its interval.

    Args:
        model: of a fit (``TensionFit.model``, ``read_tension_model``).
        table: specimen and displacements, e.g. of ``make_specimen``; forces may be NaN.
        preload_std: standard deviation of the table's preload [N], where it was not measured.

    Raises:
        InvalidInput: a specimen that does not suit the fit's kind.
        SimulationDiverged: no equilibrium.
    """
    response, *stds = model.curve(table)
    shifted_table = replace(table, preload=table.preload + preload_std)
    shifted = model.curve(shifted_table)[0] if preload_std else response
    max_strain = _nearest_table(model.tables, table.angle).strain
    at_max_strain = model.curve(_specimen_until(table, max_strain))[0]
    misfits, source, warnings = _choose_misfits(model.tables, table.angle)
    if table.strain.max() > MAX_STRAIN_RATIO * max_strain:
        warnings.append("the curve goes beyond the strains that were fitted near this angle: no error covers that")
    bands = []
    for kind, value, std, shifted_value, end, base in zip(
        ("force", "lateral"), response, stds, shifted, at_max_strain, (table.preload, 0.0), strict=True
    ):
        misfit, value = _rms_misfit(misfits, kind), value.numpy()
        if misfit is None:
            bands.append(None)
            continue
        misfit_std = misfit * np.sqrt(np.abs(value - base) * abs(float(end[-1]) - base))
        bands.append(PredictionBand(value, std.numpy(), misfit_std, np.abs(shifted_value.numpy() - value)))
    return TensionPrediction(table, bands[0], bands[1], source, warnings)


def _specimen_until(table: ForceDisplacement, strain: float) -> ForceDisplacement:
    """The specimen at its first reading and at a strain."""
    ends = np.array([0.0, strain * table.length])
    return replace(table, displacement=ends, force=np.full(2, np.nan), lateral_strain=None, repeat=None)


def make_specimen(
    model: TensionModel,
    angle: float,
    *,
    length: float | None = None,
    width: float | None = None,
    preload: float | None = None,
    strain: float | None = None,
    rows: int = DEFAULT_CURVE_ROWS,
) -> tuple[ForceDisplacement, float]:
    """Return a specimen that was not pulled, and the standard deviation of its preload [N].

    Args:
        model: of a fit.
        angle: from the warp [rad].
        length: m; None: that of the fitted tables.
        width: m; None: that of the fitted tables.
        preload: N; None: ``TensionModel.preload``.
        strain: the largest; None: that of the table nearest in angle.
        rows: of the curve.

    Raises:
        InvalidInput: a number out of its range, or not given while the fitted tables differ.
    """
    size = {
        "length": _common_dimension(model.tables, "length", length),
        "width": _common_dimension(model.tables, "width", width),
        "strain": _nearest_table(model.tables, angle).strain if strain is None else strain,
    }
    for name, number in size.items():
        if not 0 < number < math.inf:
            raise InvalidInput(name, got=number, expected="a number > 0")
    if rows < 2:
        raise InvalidInput("rows", got=rows, expected="at least 2")
    if not abs(angle) <= math.pi:
        raise InvalidInput("angle", got=f"{math.degrees(angle):g} degrees", expected="-180 to 180")
    if preload is not None and not 0 <= preload < math.inf:
        raise InvalidInput("preload", got=preload, expected="a force >= 0 N")
    table = ForceDisplacement(
        length=size["length"],
        width=size["width"],
        angle=angle,
        displacement=np.linspace(0.0, size["strain"] * size["length"], rows),
        force=np.full(rows, np.nan),
        preload=preload or 0.0,
        provenance="predicted",
    )
    if preload is not None:
        return table, 0.0
    force, std = model.preload(table)
    return replace(table, preload=force), std


def cross_validate(
    fit: TensionFit, cloth: Cloth, tables: Sequence[ForceDisplacement], **options: Any
) -> Iterator[TensionFit]:
    """Fit again with one direction after the other left out.

    Yields these fits, for progress and inspection, and at last ``fit`` with their errors, which says how far the law is
    from directions that were not fitted.

    Args:
        fit: of all tables.
        cloth: as given to ``fit_tension``.
        tables: as given to ``fit_tension``; three directions or more.
        options: as given to ``fit_tension``, without ``parameters``: those of ``fit`` are used.

    Raises:
        InvalidInput: fewer than three directions.
    """
    angles: list[float] = []
    for table in tables:
        if all(abs(_fold_angle(table.angle) - a) >= SAME_ANGLE_RAD for a in angles):
            angles.append(_fold_angle(table.angle))
    if len(angles) < 3:
        raise InvalidInput("tables", got=f"{len(angles)} directions", expected="three or more, to leave one out")
    misfits: list[dict[str, float | None]] = [{} for _ in tables]
    for angle in angles:
        left_out = [k for k, table in enumerate(tables) if abs(_fold_angle(table.angle) - angle) < SAME_ANGLE_RAD]
        part = fit_tension(cloth, [t for k, t in enumerate(tables) if k not in left_out], list(fit.keys), **options)
        for k in left_out:
            misfits[k] = left_out_misfit(part.model, tables[k])
        yield part
    yield replace(fit, model=add_left_out_misfit(fit.model, misfits))


def left_out_misfit(model: TensionModel, table: ForceDisplacement) -> dict[str, float | None]:
    """Compute ``FittedTable.left_out_misfit`` of a table that was not among the fitted ones."""
    curve, force_std, lateral_std = model.curve(table)
    return force_misfit(table, curve, (force_std, lateral_std))


def _choose_misfits(tables: list[FittedTable], angle: float) -> tuple[list[dict[str, float | None]], str, list[str]]:
    """(misfits to take the law's error from, their source in words, warnings)."""
    angle, angles = _fold_angle(angle), [_fold_angle(t.angle) for t in tables]
    if any(abs(a - angle) < SAME_ANGLE_RAD for a in angles):
        return [t.misfit for t in tables], "fitted tables, of which one has this angle", []
    validated = [
        t for t in tables if t.left_out_misfit is not None and any(x is not None for x in t.left_out_misfit.values())
    ]
    if not validated:
        warning = "the law's part is of fitted tables: a direction that was not fitted may be missed by more"
        return [t.misfit for t in tables], "fitted tables", [warning]
    between = [t for t in validated if min(angles) < _fold_angle(t.angle) < max(angles)]
    is_between = min(angles) <= angle <= max(angles)
    used = between if between and is_between else validated
    warnings = [] if is_between else ["the angle is outside of those that were fitted"]
    names = ", ".join(f"{math.degrees(_fold_angle(t.angle)):.0f}" for t in used)
    return [_larger_misfit(t) for t in used], f"tables at {names} degrees, each left out of the fit", warnings


def _larger_misfit(table: FittedTable) -> dict[str, float | None]:
    """The larger one of both misfits, fitted or left out, by kind."""
    pairs = {kind: (table.misfit[kind], (table.left_out_misfit or {}).get(kind)) for kind in table.misfit}
    return {kind: max((x for x in pair if x is not None), default=None) for kind, pair in pairs.items()}


def _rms_misfit(misfits: list[dict[str, float | None]], kind: str) -> float | None:
    """Root mean square over tables; None where none was measured."""
    known = [value for misfit in misfits if (value := misfit[kind]) is not None]
    return math.sqrt(sum(value**2 for value in known) / len(known)) if known else None


def _nearest_table(tables: list[FittedTable], angle: float) -> FittedTable:
    return min(tables, key=lambda t: abs(_fold_angle(t.angle) - _fold_angle(angle)))


def _fold_angle(angle: float) -> float:
    """Map to [0, pi/2]: an orthotropic cloth is symmetric about its axes."""
    return abs((angle + math.pi / 2) % math.pi - math.pi / 2)


def _common_dimension(tables: list[FittedTable], name: str, stated: float | None) -> float:
    """A dimension of the fitted specimens, if none is stated and they agree on it."""
    values = [getattr(t, name) for t in tables]
    if stated is None and max(values) > MAX_DIMENSION_RATIO * min(values):
        remedy = f"the fit's specimens have {min(values):g} to {max(values):g}"
        raise InvalidInput(name, got="none", expected="a number in metres", remedy=remedy)
    return values[0] if stated is None else stated
