"""``fit_tension``: force readings of a tension machine are data too, through the same solver as recordings."""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..._utils.files import write_text
from ..._utils.torch_modes import own_gradients
from ...cloth import Cloth
from ...episodes.unknowns import Unknown, available, collect, needs_contact, overrides
from ...errors import InvalidInput
from ...parameters import PhysicalParameter
from ...recordings import ForceDisplacement
from ..estimators import levenberg_marquardt
from ..result import set_identified
from ..uncertainty.estimates import Estimate
from ..uncertainty.replicates import FEWEST, scatter
from ..uncertainty.reporting import doubts, estimates
from .model import RESULT, TensionModel, pulled
from .specimens import AbstractSpecimen, Response, Uniaxial, curves

RESOLUTION = 1e-3  # of a table's largest reading: no kind of reading is taken to be better
SECTIONS = 4  # of a curve, in each of which readings err together
MISSED = 0.05  # of a table's largest reading, beyond which the law is said to miss it
CONVENTION = (
    "SI units. errors: force and lateral strain, computed minus measured, as a share of the largest reading of their "
    "table. std: standard error; it allows for errors that are correlated along a curve, and by what three tables or "
    "more at one angle differ, not for a wrong law. "
    "identifiable: std below a quarter of the value (of a typical amplitude, where the amplitude is smaller)."
)


def _places(table: ForceDisplacement) -> Tensor:
    """[N] int64, how far along its curve a reading is, in "frames": errors follow a law's shape."""
    at = torch.as_tensor(np.asarray(table.displacement, dtype=float))
    along = (at - at.min()) / (at.max() - at.min()).clamp(min=1e-30)
    return (
        (along * SECTIONS * levenberg_marquardt.WINDOW)
        .floor()
        .clamp(max=SECTIONS * levenberg_marquardt.WINDOW - 1)
        .long()
    )


@dataclass(frozen=True, eq=False)
class TensionFit:
    """The result of ``fit_tension``.

    Attributes:
        parameters: estimates by name.
        correlation: of the fitted parameters, name -> name -> correlation.
        errors: one entry per table: rms and largest error of force and of lateral strain, before and after.
        curves: what the fitted law reads, one `Response` per table.
        warnings: what to mistrust, in sentences.
        iterations: accepted steps.
        keys: module path by name of the fitted parameters.
        model: the fitted law with its covariance, which predicts other specimens (see ``predict_tension``).
    """

    parameters: dict[str, Estimate]
    correlation: dict[str, dict[str, float]]
    errors: list[dict[str, float]]
    curves: list[Response] = field(repr=False)
    warnings: list[str]
    iterations: int
    keys: dict[str, str]
    model: TensionModel = field(repr=False)

    def save(self, folder: str | Path) -> Path:
        """Write tension.json into ``folder``, atomically; returns its path."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        content: dict[str, Any] = {
            "parameters": {name: asdict(estimate) for name, estimate in self.parameters.items()},
            "correlation": self.correlation,
            "errors": self.errors,
            "convention": CONVENTION,
            "warnings": self.warnings,
            "iterations": self.iterations,
            "model": self.model.as_dict(),
        }
        return write_text(folder / RESULT, json.dumps(content, indent=1, allow_nan=False) + "\n")

    def apply(self, cloth: Cloth) -> Cloth:
        """Set the fitted values in ``cloth``, leaving what is not identifiable as it is; returns it."""
        return set_identified(cloth, self.keys, self.parameters)


@own_gradients()
def fit_tension(
    cloth: Cloth,
    tables: ForceDisplacement | Sequence[ForceDisplacement],
    parameters: Sequence[str] | None = None,
    *,
    specimen: AbstractSpecimen | None = None,
    contraction: bool = True,
    iterations: int = 50,
) -> TensionFit:
    """Fit the membrane parameters of a cloth to readings of a tension machine.

    Args:
        cloth: model and start values; only its material is used, and it is left unchanged (see ``TensionFit.apply``).
        tables: readings of specimens of the same cloth.
        parameters: public names, e.g. ["youngs_modulus", "shear_modulus"]; None: all of the membrane law that are not
            zero.
        specimen: how they deform; None: ``Uniaxial()``.
        contraction: fit measured lateral strains too, not only forces.
        iterations: at most this many.

    Returns:
        Estimates with standard errors, and how far the law is from every table.

    Raises:
        InvalidInput: unknown names, no tables, or specimens that do not suit ``specimen``.
        SimulationDiverged: no equilibrium with the start values.
    """
    tables = [tables] if isinstance(tables, ForceDisplacement) else list(tables)
    _check(tables, iterations)
    if isinstance(parameters, str):
        parameters = [parameters]
    cloth = copy.deepcopy(cloth).to(torch.float64).requires_grad_(False)
    names = _membrane(cloth) if parameters is None else list(parameters)
    unknowns = collect(cloth, names, None)
    if not unknowns:
        raise InvalidInput("parameters", got="none", expected="at least one name")
    readings = _Readings(cloth, unknowns, tables, specimen or Uniaxial(), contraction)
    seen: list[Tensor] = []

    def note(at: levenberg_marquardt.Iterate) -> bool:
        seen.append(at.raw)
        return False

    found = levenberg_marquardt.minimise(readings.problem(), readings.start, iterations, note)
    if readings.weigh(found.linear.value):
        seen.pop()  # where the second search begins
        found = levenberg_marquardt.minimise(readings.problem(), found.raw, iterations, note)
    return _statements(readings, found, len(seen) - 1)


def _check(tables: list[ForceDisplacement], iterations: int) -> None:
    if not tables or not isinstance(iterations, int) or iterations < 1:
        raise InvalidInput("tables or iterations", got=f"{len(tables)}, {iterations}", expected="at least one of each")
    for k, table in enumerate(tables):
        for name in ("length", "width"):
            if not 0 < getattr(table, name) < math.inf:
                raise InvalidInput(f"tables[{k}].{name}", got=f"{getattr(table, name)} m", expected="a length > 0")
        if not (table.force > table.preload).any():
            got = f"none above the preload, {table.preload:g} N"
            raise InvalidInput(f"tables[{k}].force", got=got, expected="a pull")
        if table.lateral_strain is not None and not (np.abs(table.lateral_strain) > 0).any():
            raise InvalidInput(
                f"tables[{k}].lateral_strain", got="no change of width", expected="some", remedy="use None"
            )


def _membrane(cloth: Cloth) -> list[str]:
    """Parameters of the material that are not zero and do not belong to contact."""
    own = {name: path for name, path in available(cloth).items() if path.startswith("material.")}
    modules = {name: cloth.get_submodule(path) for name, path in own.items() if not needs_contact(cloth, path)}
    director = ("contact_stiffness", "shear_stiffness", "cone")
    return [n for n, m in modules.items() if isinstance(m, PhysicalParameter) and bool(m.value) and n not in director]


class _Readings:
    """Tables as the residuals that Gauss-Newton works on: shares of each table's largest reading."""

    def __init__(
        self,
        cloth: Cloth,
        unknowns: list[Unknown],
        tables: list[ForceDisplacement],
        specimen: AbstractSpecimen,
        contraction: bool,
    ) -> None:
        self.cloth, self.unknowns, self.tables, self.specimen = cloth, unknowns, tables, specimen
        self.contraction, self.lateral_scale = contraction, 1.0
        self.start = torch.tensor([u.start for u in unknowns], dtype=torch.float64)
        frame, patch, lateral = [], [], []
        for k, (of, kind, measured) in enumerate(self._measured()):
            places = _places(tables[of])[np.isfinite(measured)]
            frame.append(places + k * (SECTIONS + 1) * levenberg_marquardt.WINDOW)  # windows do not reach across curves
            patch.append(torch.full((len(places),), k))
            lateral.append(torch.full((len(places),), kind == "lateral"))
        self.frame, self.patch, self.lateral = torch.cat(frame), torch.cat(patch), torch.cat(lateral)
        self.table = torch.tensor([of for of, *_ in self._measured()])[self.patch]  # of every row

    def weigh(self, value: Tensor) -> bool:
        """Let forces and lateral strains count by how well each kind is met at a first fit; whether there are both."""
        if not bool(self.lateral.any()):
            return False
        force, lateral = (float(value[rows].square().mean().sqrt()) for rows in (~self.lateral, self.lateral))
        self.lateral_scale = max(lateral, RESOLUTION) / max(force, RESOLUTION)
        return True

    def curves(self, raw: Tensor) -> list[Response]:
        """Responses at the unknowns ``raw`` [K]."""
        return curves(self.cloth.material, overrides(self.unknowns, raw), self.specimen, self.tables)  # type: ignore

    def problem(self) -> levenberg_marquardt.Problem:
        """The callbacks of Gauss-Newton."""
        return levenberg_marquardt.Problem(
            linearise=self.linearise,
            evaluate=lambda raw: (self._values(raw), self.patch),
            clip=lambda raw: torch.tensor([u.clip(float(r)) for u, r in zip(self.unknowns, raw, strict=True)]).to(raw),
            prior_mean=self.start,
            prior_std=torch.tensor([u.prior_std for u in self.unknowns], dtype=torch.float64),
            longest=torch.tensor([u.longest_step for u in self.unknowns], dtype=torch.float64),
            noise=RESOLUTION,
        )

    def linearise(self, raw: Tensor) -> levenberg_marquardt.Linearised:
        """Residuals and their exact derivatives."""
        value, slopes = self._values(raw), torch.autograd.functional.jacobian(self._rows, raw, vectorize=True)
        return levenberg_marquardt.Linearised(value, slopes, torch.ones_like(value), self.frame, self.patch)

    def _values(self, raw: Tensor) -> Tensor:
        with torch.no_grad():
            return self._rows(raw)

    def _rows(self, raw: Tensor) -> Tensor:
        scale = {"force": 1.0, "lateral": self.lateral_scale}
        return torch.cat([rows / scale[kind] for kind, rows in self._misses(self.curves(raw))])

    def _misses(self, curves: list[Response]) -> list[tuple[str, Tensor]]:
        """Of every reading that there is, by curve."""
        computed = {"force": [curve.force for curve in curves], "lateral": [curve.lateral_strain for curve in curves]}
        return [(kind, _share(computed[kind][of], measured)) for of, kind, measured in self._measured()]

    def _measured(self) -> list[tuple[int, str, Any]]:
        """(number of its table, kind, readings) of every curve: force, then lateral strain where it was seen."""
        out: list[tuple[int, str, Any]] = []
        for k, table in enumerate(self.tables):
            out.append((k, "force", table.force))
            if self.contraction and table.lateral_strain is not None:
                out.append((k, "lateral", table.lateral_strain))
        return out


def _share(computed: Tensor, measured: Any) -> Tensor:
    """Differences over the largest reading, rows without a reading left out."""
    data = torch.as_tensor(measured).to(computed.dtype)
    seen = torch.isfinite(data)
    return (computed[seen] - data[seen]) / data[seen].abs().max()


def _statements(readings: _Readings, found: levenberg_marquardt.Iterate, iterations: int) -> TensionFit:
    covariance = _covariance(readings, found)
    said = estimates(readings.cloth, readings.unknowns, found.raw, covariance)
    with torch.no_grad():
        before, after = readings.curves(readings.start), readings.curves(found.raw)
    errors = [
        {f"{key}_{when}": value for when, c in (("before", b), ("after", a)) for key, value in misses(t, c).items()}
        for t, b, a in zip(readings.tables, before, after, strict=True)
    ]
    keys = {u.name: u.key.removesuffix(".raw") for u in readings.unknowns}
    warnings = [] if found.converged else [f"stopped after {iterations} iterations before converging"]
    warnings += doubts(said)
    warnings += [
        f"table {k}: the law misses a force by {100 * e['force_max_after']:.0f} % of the largest; no error covers that"
        for k, e in enumerate(errors)
        if e["force_max_after"] > MISSED
    ]
    model = _model(readings, found, covariance)
    return TensionFit(said.parameters, said.correlation, errors, after, warnings, iterations, keys, model)


def _covariance(readings: _Readings, found: levenberg_marquardt.Iterate) -> Tensor:
    """[K, K]; a specimen that is stiffer is so along its whole curve, which shows where several are alike."""
    problem = readings.problem()
    own = levenberg_marquardt.covariance(problem, found)
    angles = [round(table.angle, 6) for table in readings.tables]
    several = [k for k, angle in enumerate(angles) if angles.count(angle) >= FEWEST]
    if not several:
        return own
    number = torch.full((len(angles),), len(several))
    number[several] = torch.arange(len(several))
    kinds = sorted(set(angles))
    strata = torch.tensor([kinds.index(angles[k]) for k in several])
    return levenberg_marquardt.at_least(own, scatter(problem, found, number[readings.table], strata))


def _model(readings: _Readings, found: levenberg_marquardt.Iterate, covariance: Tensor) -> TensionModel:
    """The law with its fitted values, and what is known of its errors."""
    cloth = copy.deepcopy(readings.cloth)
    own = [k for k, u in enumerate(readings.unknowns) if u.key.startswith("material.")]
    for unknown, raw in zip(readings.unknowns, found.raw, strict=True):
        cloth.get_submodule(unknown.key.removesuffix(".raw")).set(unknown.value(float(raw)))  # type: ignore
    with torch.no_grad():
        tables = pulled(readings.tables, readings.curves(found.raw))
    names = [readings.unknowns[k].key.removeprefix("material.").removesuffix(".raw") for k in own]
    return TensionModel(cloth.material, readings.specimen, names, covariance[own][:, own], tables)  # type: ignore


def misses(table: ForceDisplacement, curve: Response) -> dict[str, float]:
    """RMS and largest error of a curve, as shares of the table's largest readings."""
    out = {}
    for name, computed, measured in (
        ("force", curve.force, table.force),
        ("lateral", curve.lateral_strain, table.lateral_strain),
    ):
        if measured is not None:
            share = _share(computed.detach(), measured)
            out |= {f"{name}_rms": float(share.square().mean().sqrt()), f"{name}_max": float(share.abs().max())}
    return out
