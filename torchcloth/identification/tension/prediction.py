"""What a fitted law says of a specimen that was not pulled, with an interval; and how well it says it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ...cloth import Cloth
from ...errors import InvalidInput
from ...recordings import ForceDisplacement
from ..estimators.levenberg_marquardt import NORMAL
from .fit import TensionFit, fit_tension
from .model import Pulled, TensionModel, missed, with_left_out

ROWS = 41
SAME = 0.01  # rad, within which an angle is one that was fitted
SLACK = 1.02  # of the largest fitted strain, beyond which a curve is said to be extrapolated
CONVENTION = (
    "SI units, angle in degrees from the warp. std_parameters: standard error that the fit's covariance gives (delta "
    "method); it allows for errors correlated along a curve. std_law: standard deviation of what the law misses; its "
    "square grows in proportion to the force's rise above the preload, or to the lateral strain. At fitted angles it "
    "is what is missed of all fitted tables; at others what is missed of tables that were left out of the fit (those "
    "between other tables' angles, where the angle is between fitted ones), less what the errors of the parameters "
    "explain. std_setup: of a preload that was not given: it is then the force at the mean strain at which fitted "
    "tables began, within their scatter. std: all parts, as independent. ci95: 1.96 std. lateral_strain: null where "
    "no fitted table had it. measured: errors as shares of the largest reading; covered: share of readings in ci95."
)


@dataclass(frozen=True, eq=False)
class Band:
    """A predicted quantity [N] with the parts of its standard deviation."""

    value: np.ndarray
    parameters: np.ndarray
    law: np.ndarray
    setup: np.ndarray

    @property
    def std(self) -> np.ndarray:
        """All parts, as independent."""
        return np.sqrt(self.parameters**2 + self.law**2 + self.setup**2)

    @property
    def ci95(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper end."""
        return self.value - NORMAL * self.std, self.value + NORMAL * self.std

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        low, high = self.ci95
        parts = {"value": self.value, "std_parameters": self.parameters, "std_law": self.law, "std_setup": self.setup}
        parts["std"] = self.std
        return {key: part.tolist() for key, part in parts.items()} | {"ci95": [low.tolist(), high.tolist()]}

    def judge(self, seen: np.ndarray) -> dict[str, float]:
        """RMS and largest error as shares of the largest reading, and the share of readings inside the interval."""
        rows = np.isfinite(seen)
        largest = np.abs(seen[rows]).max(initial=0.0)
        if not largest > 0:
            raise InvalidInput(
                "readings", got="nothing but zeros", expected="some that are not", remedy="leave them out"
            )
        share = np.abs(self.value - seen)[rows] / largest
        low, high = self.ci95
        inside = (seen >= low) & (seen <= high)
        return {
            "rms": float((share**2).mean() ** 0.5),
            "max": float(share.max()),
            "covered": float(inside[rows].mean()),
        }


@dataclass(frozen=True, eq=False)
class TensionPrediction:
    """The result of ``predict_tension``.

    Attributes:
        table: the specimen, its displacements, and its readings where there are any.
        force: N.
        lateral_strain: None where no fitted table had it.
        law_from: which tables the law's part was taken from, in words.
        warnings: what to mistrust, in sentences.
    """

    table: ForceDisplacement
    force: Band
    lateral_strain: Band | None
    law_from: str
    warnings: list[str]

    def judged(self) -> dict[str, dict[str, float]]:
        """``Band.judge`` by kind, of what was measured."""
        both = (("force", self.force, self.table.force), ("lateral", self.lateral_strain, self.table.lateral_strain))
        return {
            kind: band.judge(seen)
            for kind, band, seen in both
            if band is not None and seen is not None and bool(np.isfinite(seen).any())
        }

    def as_dict(self) -> dict[str, Any]:
        """The content of prediction.json."""
        t, lateral = self.table, self.lateral_strain
        return {
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
            "law_from": self.law_from,
            "measured": self.judged(),
            "warnings": self.warnings,
            "convention": CONVENTION,
        }


def predict_tension(model: TensionModel, table: ForceDisplacement, preload_std: float = 0.0) -> TensionPrediction:
    """The law's reading of a specimen with its interval.

    Args:
        model: of a fit (``TensionFit.model``, ``read_model``).
        table: specimen and displacements, e.g. of ``specimen_like``; forces may be NaN.
        preload_std: N, of the table's preload, where it was not measured.

    Raises:
        InvalidInput: a specimen that does not suit the fit's kind.
        SimulationDiverged: no equilibrium.
    """
    found, *stds = model.curve(table)
    other = model.curve(replace(table, preload=table.preload + preload_std))[0] if preload_std else found
    longest = _nearest(model.tables, table.angle).strain
    whole = model.curve(_until(table, longest))[0]
    chosen, law_from, warnings = _law_from(model.tables, table.angle)
    if table.strain.max() > SLACK * longest:
        warnings.append("the curve goes beyond the strains that were fitted near this angle: no error covers that")
    bands = []
    for kind, value, std, shifted, end, base in zip(
        ("force", "lateral"), found, stds, other, whole, (table.preload, 0.0), strict=True
    ):
        share, value = _share(chosen, kind), value.numpy()
        law = (share or 0.0) * np.sqrt(np.abs(value - base) * abs(float(end[-1]) - base))
        known = share is not None
        bands.append(Band(value, std.numpy(), law, np.abs(shifted.numpy() - value)) if known else None)
    return TensionPrediction(table, bands[0], bands[1], law_from, warnings)


def _until(table: ForceDisplacement, strain: float) -> ForceDisplacement:
    """The specimen at its first reading and at a strain."""
    ends = np.array([0.0, strain * table.length])
    return replace(table, displacement=ends, force=np.full(2, np.nan), lateral_strain=None, repeat=None)


def specimen_like(
    model: TensionModel,
    angle: float,
    *,
    length: float | None = None,
    width: float | None = None,
    preload: float | None = None,
    strain: float | None = None,
    rows: int = ROWS,
) -> tuple[ForceDisplacement, float]:
    """A specimen [angle in rad] that was not pulled, and the standard deviation of its preload [N].

    Length and width are by default those of the fitted tables, the largest strain that of the table nearest in angle,
    the preload as ``TensionModel.preload``.

    Raises:
        InvalidInput: a number out of its range, or not given while the fitted tables differ.
    """
    size = {
        "length": _common(model.tables, "length", length),
        "width": _common(model.tables, "width", width),
        "strain": _nearest(model.tables, angle).strain if strain is None else strain,
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


def cross_validated(
    fit: TensionFit, cloth: Cloth, tables: Sequence[ForceDisplacement], **options: Any
) -> Iterator[TensionFit]:
    """Fit again with one direction after the other left out; yields these fits, then ``fit`` knowing their errors.

    The last one says how far the law is from directions that were not fitted. The others are its parts, for those who
    want to see them, and for progress.

    Args:
        fit: of all tables.
        cloth, tables, options: as given to ``fit_tension``, but without ``parameters``: those of ``fit``; three
            directions or more.

    Raises:
        InvalidInput: fewer than three directions.
    """
    angles: list[float] = []
    for table in tables:
        if all(abs(_folded(table.angle) - a) >= SAME for a in angles):
            angles.append(_folded(table.angle))
    if len(angles) < 3:
        raise InvalidInput("tables", got=f"{len(angles)} directions", expected="three or more, to leave one out")
    left_out: list[dict[str, float | None]] = [{} for _ in tables]
    for angle in angles:
        own = [k for k, table in enumerate(tables) if abs(_folded(table.angle) - angle) < SAME]
        part = fit_tension(cloth, [t for k, t in enumerate(tables) if k not in own], list(fit.keys), **options)
        for k in own:
            left_out[k] = excess(part.model, tables[k])
        yield part
    yield replace(fit, model=with_left_out(fit.model, left_out))


def excess(model: TensionModel, table: ForceDisplacement) -> dict[str, float | None]:
    """``Pulled.left_out`` of a table that was not among the fitted ones."""
    curve, *known = model.curve(table)
    return missed(table, curve, (known[0], known[1]))


def _law_from(tables: list[Pulled], angle: float) -> tuple[list[dict[str, float | None]], str, list[str]]:
    """The shares to take the law's misfit from, where from in words, warnings."""
    if any(abs(_folded(t.angle) - _folded(angle)) < SAME for t in tables):
        return [t.missed for t in tables], "fitted tables, of which one has this angle", []
    tried = [t for t in tables if t.left_out is not None and any(x is not None for x in t.left_out.values())]
    if not tried:
        note = "the law's part is of fitted tables: a direction that was not fitted may be missed by more"
        return [t.missed for t in tables], "fitted tables", [note]
    angles = [_folded(t.angle) for t in tables]
    between = [t for t in tried if min(angles) < _folded(t.angle) < max(angles)]
    inside = min(angles) <= _folded(angle) <= max(angles)
    used = between if between and inside else tried
    warnings = [] if inside else ["the angle is outside of those that were fitted"]
    names = ", ".join(f"{math.degrees(_folded(t.angle)):.0f}" for t in used)
    return [_worse(t) for t in used], f"tables at {names} degrees, each left out of the fit", warnings


def _worse(table: Pulled) -> dict[str, float | None]:
    """Left out or fitted, whichever is missed by more."""
    both = {kind: (table.missed[kind], (table.left_out or {}).get(kind)) for kind in table.missed}
    return {kind: max((x for x in pair if x is not None), default=None) for kind, pair in both.items()}


def _share(chosen: list[dict[str, float | None]], kind: str) -> float | None:
    """Root mean square over tables; None where none was measured."""
    known = [share for one in chosen if (share := one[kind]) is not None]
    return math.sqrt(sum(share**2 for share in known) / len(known)) if known else None


def _nearest(tables: list[Pulled], angle: float) -> Pulled:
    """In angle."""
    return min(tables, key=lambda t: abs(_folded(t.angle) - _folded(angle)))


def _folded(angle: float) -> float:
    """[0, pi/2]: what an orthotropic cloth cannot tell apart is the same angle."""
    return abs((angle + math.pi / 2) % math.pi - math.pi / 2)


def _common(tables: list[Pulled], name: str, given: float | None) -> float:
    """A dimension of the fitted specimens, when they agree on it."""
    found = [getattr(t, name) for t in tables]
    if given is None and max(found) > 1.001 * min(found):
        has = f"the fit's specimens have {min(found):g} to {max(found):g}"
        raise InvalidInput(name, got="none", expected="a number in metres", remedy=has)
    return found[0] if given is None else given
