"""``fit_tension``: fit force readings of a tension machine, through the same solver as recordings."""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..._utils.files import write_text
from ..._utils.torch_modes import isolated_grad_mode
from ...cloth import Cloth
from ...episodes.unknowns import (
    Unknown,
    collect_unknowns,
    find_scalar_parameters,
    make_state_entries,
    needs_contact,
)
from ...errors import InvalidInput
from ...parameters import PhysicalParameter
from ...recordings import ForceDisplacement
from ..estimators import levenberg_marquardt
from ..estimators.levenberg_marquardt import DEFAULT_NOISE_MODEL, SOLVER_SETTINGS
from ..fit_warnings import identifiability_warnings
from ..result import set_identifiable
from ..uncertainty.estimates import Estimate, make_estimates
from ..uncertainty.replicates import MIN_REPLICATES, jackknife_variance
from .model import TENSION_FILE_NAME, TENSION_SCHEMA, TensionModel, summarise_tables
from .specimens import AbstractSpecimen, Response, Uniaxial, compute_responses

READING_RESOLUTION = 1e-3  # least standard deviation of any kind of reading, relative to a table's largest
SECTIONS_PER_CURVE = 4  # sections of a curve in which the errors of readings are correlated
MIN_NOTABLE_MISFIT = 0.05  # relative to a table's largest reading, above which there is a warning
DIRECTOR_PARAMETERS = ("contact_stiffness", "shear_stiffness", "cone")  # they act only between layers
TENSION_CONVENTION = (
    "SI units. errors: force and lateral strain, computed minus measured, as a fraction of the largest reading of "
    "their table. std: standard error. It accounts for errors that are correlated along a curve, and for the scatter "
    "between three or more tables at one angle. It does not account for a wrong law. identifiable: std is below 25 % "
    "of the larger of the value and its typical size. It is also below half of the prior's standard deviation in the "
    "unconstrained coordinate, unless the prior was measured."
)


@dataclass(frozen=True, eq=False)
class TensionFit:
    """The result of ``fit_tension``.

    Attributes:
        parameters: estimates by name.
        correlation: of the fitted parameters, name -> name -> correlation.
        errors: one entry per table: rms and largest error of force and of lateral strain, before and after.
        curves: responses of the fitted law, one per table.
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
        """Write tension.json into ``folder`` atomically, and return its path."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        content: dict[str, Any] = {
            "schema": TENSION_SCHEMA,
            "parameters": {name: asdict(estimate) for name, estimate in self.parameters.items()},
            "correlation": self.correlation,
            "errors": self.errors,
            "convention": TENSION_CONVENTION,
            "warnings": self.warnings,
            "iterations": self.iterations,
            "model": self.model.as_dict(),
        }
        return write_text(folder / TENSION_FILE_NAME, json.dumps(content, indent=1, allow_nan=False) + "\n")

    def apply(self, cloth: Cloth) -> Cloth:
        """Set the identified values in ``cloth``, leave the others as they are, and return it."""
        return set_identifiable(cloth, self.keys, self.parameters)


@isolated_grad_mode()
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
        contraction: fit measured lateral strains, too.
        iterations: largest number of iterations.

    Returns:
        Estimates with standard errors, and how far the law is from every table.

    Raises:
        InvalidInput: unknown names, no tables, or specimens that do not suit ``specimen``.
        SimulationDiverged: no equilibrium with the start values.
    """
    tables = [tables] if isinstance(tables, ForceDisplacement) else list(tables)
    _check_tables(tables, iterations)
    if isinstance(parameters, str):
        parameters = [parameters]
    cloth = copy.deepcopy(cloth).to(torch.float64).requires_grad_(False)
    names = _membrane_parameters(cloth) if parameters is None else list(parameters)
    unknowns = collect_unknowns(cloth, names, None)
    if not unknowns:
        raise InvalidInput("parameters", got="none", expected="at least one name")
    readings = _Readings(cloth, unknowns, tables, specimen or Uniaxial(), contraction)
    accepted: list[Tensor] = []

    def on_iterate(at: levenberg_marquardt.Iterate) -> bool:
        accepted.append(at.raw)
        return False

    # Few angles leave combinations of parameters that creep to the optimum. Where such a search stops early, the error
    # of an angle that was left out looks explained by errors of the parameters, and the law's error is missing.
    settings = replace(SOLVER_SETTINGS, max_small_steps=iterations)
    final = levenberg_marquardt.minimise(readings.problem(), readings.start, iterations, on_iterate, settings=settings)
    if readings.balance_kinds(final.linear.residual):
        accepted.pop()  # the second search begins there
        final = levenberg_marquardt.minimise(readings.problem(), final.raw, iterations, on_iterate, settings=settings)
    return _assemble_result(readings, final, len(accepted) - 1)


def _check_tables(tables: list[ForceDisplacement], iterations: int) -> None:
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


def _membrane_parameters(cloth: Cloth) -> list[str]:
    """Names of the material's parameters that are not zero and do not belong to contact."""
    paths = {name: path for name, path in find_scalar_parameters(cloth).items() if path.startswith("material.")}
    modules = {name: cloth.get_submodule(path) for name, path in paths.items() if not needs_contact(cloth, path)}
    return [
        name
        for name, module in modules.items()
        if isinstance(module, PhysicalParameter) and bool(module.value) and name not in DIRECTOR_PARAMETERS
    ]


def _frame_numbers(table: ForceDisplacement) -> Tensor:
    """[N] int64, a reading's place along its curve, in "frames": errors follow the shape of a law."""
    displacement = torch.as_tensor(np.asarray(table.displacement, dtype=float))
    along = (displacement - displacement.min()) / (displacement.max() - displacement.min()).clamp(min=1e-30)
    frames = SECTIONS_PER_CURVE * DEFAULT_NOISE_MODEL.frames_per_time_block
    return (along * frames).floor().clamp(max=frames - 1).long()


class _Readings:
    """Tables as the residuals that the solver works on: fractions of each table's largest reading."""

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
        gap = (SECTIONS_PER_CURVE + 1) * DEFAULT_NOISE_MODEL.frames_per_time_block  # blocks do not reach across curves
        frame, curve, is_lateral = [], [], []
        for k, (number, kind, measured) in enumerate(self._measured_curves()):
            numbers = _frame_numbers(tables[number])[np.isfinite(measured)]
            frame.append(numbers + k * gap)
            curve.append(torch.full((len(numbers),), k))
            is_lateral.append(torch.full((len(numbers),), kind == "lateral"))
        self.frame, self.curve_of_row, self.is_lateral = torch.cat(frame), torch.cat(curve), torch.cat(is_lateral)
        self.table_of_row = torch.tensor([number for number, *_ in self._measured_curves()])[self.curve_of_row]

    def balance_kinds(self, residual: Tensor) -> bool:
        """Weigh forces and lateral strains by the residuals of a first fit; return whether there are both."""
        if not bool(self.is_lateral.any()):
            return False
        force, lateral = (float(residual[rows].square().mean().sqrt()) for rows in (~self.is_lateral, self.is_lateral))
        self.lateral_scale = max(lateral, READING_RESOLUTION) / max(force, READING_RESOLUTION)
        return True

    def curves(self, raw: Tensor) -> list[Response]:
        """Compute responses at the unknowns ``raw`` [K]."""
        entries = make_state_entries(self.unknowns, raw)
        return compute_responses(self.cloth.material, entries, self.specimen, self.tables)  # type: ignore

    def problem(self) -> levenberg_marquardt.Problem:
        """Return the callbacks of the solver."""

        def clip(raw: Tensor) -> Tensor:
            return torch.tensor([u.clip(float(r)) for u, r in zip(self.unknowns, raw, strict=True)]).to(raw)

        return levenberg_marquardt.Problem(
            linearise=self.linearise,
            evaluate=lambda raw: (self._residuals_without_grad(raw), self.curve_of_row),
            clip=clip,
            prior_mean=self.start,
            prior_std=torch.tensor([u.prior_std for u in self.unknowns], dtype=torch.float64),
            max_step=torch.tensor([u.max_step for u in self.unknowns], dtype=torch.float64),
            noise_floor=READING_RESOLUTION,
        )

    def linearise(self, raw: Tensor) -> levenberg_marquardt.Linearised:
        """Compute residuals and their exact derivatives."""
        residual = self._residuals_without_grad(raw)
        slopes = torch.autograd.functional.jacobian(self._residuals, raw, vectorize=True)
        return levenberg_marquardt.Linearised(
            residual, slopes, torch.ones_like(residual), self.frame, self.curve_of_row
        )

    def _residuals_without_grad(self, raw: Tensor) -> Tensor:
        with torch.no_grad():
            return self._residuals(raw)

    def _residuals(self, raw: Tensor) -> Tensor:
        curves, scale = self.curves(raw), {"force": 1.0, "lateral": self.lateral_scale}
        computed = {"force": [c.force for c in curves], "lateral": [c.lateral_strain for c in curves]}
        parts = [
            _relative_errors(computed[kind][number], measured) / scale[kind]
            for number, kind, measured in self._measured_curves()
        ]
        return torch.cat(parts)

    def _measured_curves(self) -> list[tuple[int, str, Any]]:
        """(number of its table, kind, readings) of every curve: force, then lateral strain where it was measured."""
        out: list[tuple[int, str, Any]] = []
        for k, table in enumerate(self.tables):
            out.append((k, "force", table.force))
            if self.contraction and table.lateral_strain is not None:
                out.append((k, "lateral", table.lateral_strain))
        return out


def _relative_errors(computed: Tensor, measured: Any) -> Tensor:
    """Differences over the largest reading, without rows that have no reading."""
    data = torch.as_tensor(measured).to(computed.dtype)
    rows = torch.isfinite(data)
    return (computed[rows] - data[rows]) / data[rows].abs().max()


def _assemble_result(readings: _Readings, final: levenberg_marquardt.Iterate, iterations: int) -> TensionFit:
    covariance = _covariance(readings, final)
    estimates = make_estimates(readings.cloth, readings.unknowns, final.raw, covariance)
    with torch.no_grad():
        before, after = readings.curves(readings.start), readings.curves(final.raw)
    errors = [
        {f"{key}_{when}": e for when, c in (("before", b), ("after", a)) for key, e in table_errors(t, c).items()}
        for t, b, a in zip(readings.tables, before, after, strict=True)
    ]
    unfinished = (
        f"stopped after {iterations} iterations before converging: more of them may change the values, and the "
        "standard errors do not say by how much"
    )
    warnings = [] if final.converged else [unfinished]
    warnings += identifiability_warnings(estimates)
    warnings += [
        f"table {k}: the law misses a force by {100 * e['force_max_after']:.0f} % of the largest; no error covers that"
        for k, e in enumerate(errors)
        if e["force_max_after"] > MIN_NOTABLE_MISFIT
    ]
    return TensionFit(
        parameters=estimates.parameters,
        correlation=estimates.correlation,
        errors=errors,
        curves=after,
        warnings=warnings,
        iterations=iterations,
        keys={u.name: u.key.removesuffix(".raw") for u in readings.unknowns},
        model=_make_model(readings, final, covariance),
    )


def _covariance(readings: _Readings, final: levenberg_marquardt.Iterate) -> Tensor:
    """[K, K]; a specimen that is stiffer is so along its whole curve, which shows between tables of one angle."""
    problem = readings.problem()
    covariance = levenberg_marquardt.covariance(problem, final)
    angles = [round(table.angle, 6) for table in readings.tables]
    replicated = [k for k, angle in enumerate(angles) if angles.count(angle) >= MIN_REPLICATES]
    if not replicated:
        return covariance
    number = torch.full((len(angles),), len(replicated))
    number[replicated] = torch.arange(len(replicated))
    distinct_angles = sorted(set(angles))
    strata = torch.tensor([distinct_angles.index(angles[k]) for k in replicated])
    variances = jackknife_variance(problem, final, number[readings.table_of_row], strata)
    return levenberg_marquardt.inflate_covariance(covariance, variances)


def _make_model(readings: _Readings, final: levenberg_marquardt.Iterate, covariance: Tensor) -> TensionModel:
    """The law with its fitted values, and its errors."""
    cloth = copy.deepcopy(readings.cloth)
    index = [k for k, u in enumerate(readings.unknowns) if u.key.startswith("material.")]
    for unknown, raw in zip(readings.unknowns, final.raw, strict=True):
        cloth.get_submodule(unknown.key.removesuffix(".raw")).set(unknown.value(float(raw)))  # type: ignore
    with torch.no_grad():
        tables = summarise_tables(readings.tables, readings.curves(final.raw))
    names = [readings.unknowns[k].key.removeprefix("material.").removesuffix(".raw") for k in index]
    return TensionModel(cloth.material, readings.specimen, names, covariance[index][:, index], tables)  # type: ignore


def table_errors(table: ForceDisplacement, curve: Response) -> dict[str, float]:
    """Compute rms and largest error of a curve, as fractions of the table's largest readings."""
    out = {}
    for name, computed, measured in (
        ("force", curve.force, table.force),
        ("lateral", curve.lateral_strain, table.lateral_strain),
    ):
        if measured is not None:
            errors = _relative_errors(computed.detach(), measured)
            out |= {f"{name}_rms": float(errors.square().mean().sqrt()), f"{name}_max": float(errors.abs().max())}
    return out
