"""A fitted membrane law with the errors of its numbers and its misfit, as tension.json stores it."""

from __future__ import annotations

import inspect
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...materials import AEP, AbstractMaterial, OrthotropicAEP, StiffeningAEP
from ...parameters import PhysicalParameter
from ...recordings import ForceDisplacement
from ..io.result_files import check_number, read_result
from .specimens import AbstractSpecimen, Response, Trellis, Uniaxial, compute_responses

TENSION_SCHEMA = "torchcloth.tension/1"
TENSION_FILE_NAME = "tension.json"
MATERIALS_BY_NAME = {law.__name__: law for law in (AEP, OrthotropicAEP, StiffeningAEP)}
SPECIMENS_BY_NAME = {kind.__name__: kind for kind in (Uniaxial, Trellis)}
MIN_SPECIMEN_LENGTH_M = 1e-6


@dataclass(frozen=True)
class FittedTable:
    """One fitted table: its specimen, and how far the law is from its readings.

    Attributes:
        angle: rad, from the warp.
        length: m.
        width: m.
        preload: N.
        strain: the largest.
        misfit: by kind. For "force": root mean square error over the root of mean times largest rise above the
            preload. For "lateral": over the root of mean times largest lateral strain. None where not measured.
        left_out_misfit: misfit of the law that was fitted to the other tables, without the part that the errors of its
            numbers explain. None where it was not computed, or where they explain all of it.
    """

    angle: float
    length: float
    width: float
    preload: float
    strain: float
    misfit: dict[str, float | None]
    left_out_misfit: dict[str, float | None] | None = None


@dataclass(frozen=True, eq=False)
class TensionModel:
    """A fitted law with the covariance of its unconstrained numbers.

    Attributes:
        material: at the fitted values.
        specimen: how specimens deform.
        fitted: names of the fitted parameters, all of the material.
        covariance: [K, K] of their unconstrained values.
        tables: what they were fitted to.
    """

    material: AbstractMaterial
    specimen: AbstractSpecimen
    fitted: list[str]
    covariance: Tensor
    tables: list[FittedTable]

    def as_dict(self) -> dict[str, Any]:
        """Return the entry "model" of tension.json; empty for laws and specimens that numbers cannot describe."""
        law, kind = type(self.material).__name__, type(self.specimen).__name__
        if MATERIALS_BY_NAME.get(law) is not type(self.material) or SPECIMENS_BY_NAME.get(kind) is not type(
            self.specimen
        ):
            return {}
        values = {name: _to_json(getattr(self.material, name)) for name in _argument_names(type(self.material))}
        if None in values.values():
            return {}
        return {
            "material": law,
            "values": values,
            "specimen": kind,
            "fitted": self.fitted,
            "covariance": self.covariance.tolist(),
            "tables": [asdict(table) for table in self.tables],
        }

    def curve(self, table: ForceDisplacement) -> tuple[Response, Tensor, Tensor]:
        """Return the law's response at a table's displacements, with standard errors of force [N] and strain [N]."""
        start = torch.stack([self.material.get_submodule(name).raw.detach() for name in self.fitted])  # type: ignore

        def respond(raw: Tensor) -> Tensor:
            entries = {f"material.{name}.raw": raw[k] for k, name in enumerate(self.fitted)}
            return torch.stack(compute_responses(self.material, entries, self.specimen, [table])[0])

        slopes = torch.autograd.functional.jacobian(respond, start, vectorize=True)  # [2, N, K]
        variance = torch.einsum("rnk,kl,rnl->rn", slopes, self.covariance, slopes)
        with torch.no_grad():
            response = Response(*respond(start))
        force_std, lateral_std = variance.clamp(min=0).sqrt()
        return response, force_std, lateral_std

    def preload(self, table: ForceDisplacement) -> tuple[float, float]:
        """Estimate the preload [N] of a specimen that was clamped as the fitted ones were, and its deviation [N].

        The fitted specimens' strains under their preloads give the mean and the scatter.
        """
        strains = [self.specimen.preload_strain(self.material, specimen_of_table(t)) for t in self.tables]
        mean, scatter = float(np.mean(strains)), float(np.std(strains, ddof=1)) if len(strains) > 1 else 0.0
        if mean == 0:
            return 0.0, 0.0
        with torch.no_grad():
            at = torch.tensor([mean, mean + scatter], dtype=torch.float64)
            low, high = self.specimen.respond(self.material, self.material.coefficients(), table, at).force.tolist()
        return low, high - low


def force_misfit(
    table: ForceDisplacement, curve: Response, known: tuple[Tensor, Tensor] | None = None
) -> dict[str, Any]:
    """Compute ``FittedTable.misfit`` of a curve.

    Args:
        table: with readings.
        curve: of the law.
        known: standard errors [N] of force and strain, whose part is subtracted.
    """
    misfit: dict[str, Any] = {"force": None, "lateral": None}
    kinds = (("force", table.force, table.preload), ("lateral", table.lateral_strain, 0.0))
    for k, (kind, measured, base) in enumerate(kinds):
        if measured is None:
            continue
        rows = np.isfinite(measured)
        square = (curve[k].detach().numpy()[rows] - measured[rows]) ** 2
        if known is not None:
            square = square - known[k].numpy()[rows] ** 2
            if square.mean() <= 0:
                continue
        rise = np.abs(measured[rows] - base)
        misfit[kind] = math.sqrt(square.mean() / (rise.mean() * rise.max()))
    return misfit


def specimen_of_table(table: FittedTable) -> ForceDisplacement:
    """Return the specimen of a fitted table, without its readings."""
    return ForceDisplacement(
        length=table.length,
        width=table.width,
        angle=table.angle,
        preload=table.preload,
        displacement=np.array([0.0, table.strain * table.length]),
        force=np.full(2, np.nan),
    )


def summarise_tables(tables: Sequence[ForceDisplacement], curves: Sequence[Response]) -> list[FittedTable]:
    """Return entries of fitted tables, from the law's curves."""
    return [
        FittedTable(float(t.angle), t.length, t.width, t.preload, float(t.strain.max()), force_misfit(t, c))
        for t, c in zip(tables, curves, strict=True)
    ]


def add_left_out_misfit(model: TensionModel, misfits: Sequence[dict[str, float | None]]) -> TensionModel:
    """Return the model with the misfit of each table when it was left out of the fit."""
    tables = [replace(t, left_out_misfit=m) for t, m in zip(model.tables, misfits, strict=True)]
    return replace(model, tables=tables)


def read_tension_model(path: str | Path) -> TensionModel:
    """Read the model of a saved fit: tension.json, or the folder that holds it.

    Raises:
        InvalidInput: there is no such file.
        RecordingError: it cannot be read, has another schema, or does not hold what is needed.
    """
    expected = f"a law among {', '.join(MATERIALS_BY_NAME)} with its numbers"
    remedy = "fit again with fit_tension and save"
    return read_result(
        path, TENSION_FILE_NAME, TENSION_SCHEMA, lambda content: _parse_model(content["model"]), expected, remedy
    )


def _parse_model(content: dict[str, Any]) -> TensionModel:
    names = [str(name) for name in content["fitted"]]
    values: dict[str, Any] = {
        name: value if isinstance(value, str) else check_number(value, name=name)
        for name, value in content["values"].items()
    }
    material = MATERIALS_BY_NAME[content["material"]](**values).to(torch.float64)
    for name in names:
        if not isinstance(getattr(material, name), PhysicalParameter):
            raise ValueError(f"{name} is no parameter")
    rows = [[check_number(value, name="covariance") for value in row] for row in content["covariance"]]
    if [len(row) for row in rows] != [len(names)] * len(names):
        raise ValueError(f"a covariance of {len(rows)} rows, fitted are {len(names)} numbers")
    covariance = torch.tensor(rows, dtype=torch.float64)
    if bool((covariance.diagonal() < 0).any()):
        raise ValueError("a negative variance")
    tables = [_parse_table(table) for table in content["tables"]]
    if not tables:
        raise ValueError("no tables")
    return TensionModel(material, SPECIMENS_BY_NAME[content["specimen"]](), names, covariance, tables)


def _parse_table(content: dict[str, Any]) -> FittedTable:
    check_number(content["angle"], name="angle")
    minima = {"length": MIN_SPECIMEN_LENGTH_M, "width": MIN_SPECIMEN_LENGTH_M, "preload": 0.0, "strain": 0.0}
    for name, minimum in minima.items():
        check_number(content[name], minimum, name)
    left_out = content.get("left_out_misfit")
    for misfit in (content["misfit"], *([] if left_out is None else [left_out])):
        for name in ("force", "lateral"):
            if misfit[name] is not None:
                check_number(misfit[name], 0.0, f"misfit {name}")
    return FittedTable(**content)


def _argument_names(law: type[AbstractMaterial]) -> list[str]:
    """Of the constructor; specimens refuse plasticity."""
    return [name for name in inspect.signature(law).parameters if name != "plastic"]


def _to_json(value: Any) -> float | str | None:
    """A number or string; None for a value per triangle."""
    if isinstance(value, PhysicalParameter):
        return float(value.value) if value.raw.ndim == 0 else None
    return value
