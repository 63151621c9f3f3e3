"""What tension.json keeps beside the estimates: the law, the errors of its numbers, and how far it misses forces."""

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
from ..io.result_files import number, read_result
from .specimens import AbstractSpecimen, Response, Trellis, Uniaxial, curves

RESULT = "tension.json"
LAWS = {law.__name__: law for law in (AEP, OrthotropicAEP, StiffeningAEP)}
SHORTEST = 1e-6  # m, of a specimen
SPECIMENS = {kind.__name__: kind for kind in (Uniaxial, Trellis)}


@dataclass(frozen=True)
class Pulled:
    """One fitted table: its specimen, and how far the law is from its readings.

    ``missed``: root mean square error of the force, over the root of mean times largest rise above the preload; and of
    the lateral strain, over the root of its mean times largest size; None where not measured. ``left_out``: of the law
    fitted to the other tables, without what the errors of its numbers explain; None where that was not tried, or they
    explain it all, which tells nothing of the law.
    """

    angle: float  # rad
    length: float  # m
    width: float  # m
    preload: float  # N
    strain: float  # largest
    missed: dict[str, float | None]
    left_out: dict[str, float | None] | None = None


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
    tables: list[Pulled]

    def as_dict(self) -> dict[str, Any]:
        """The entry "model" of tension.json; empty for laws and specimens that cannot be written as numbers."""
        law, kind = type(self.material).__name__, type(self.specimen).__name__
        if LAWS.get(law) is not type(self.material) or SPECIMENS.get(kind) is not type(self.specimen):
            return {}
        values = {name: _plain(getattr(self.material, name)) for name in _arguments(type(self.material))}
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
        """What the law reads at a table's displacements; standard errors [N] of force and strain by the covariance."""
        start = torch.stack([self.material.get_submodule(name).raw.detach() for name in self.fitted])  # type: ignore

        def rows(raw: Tensor) -> Tensor:
            entries = {f"material.{name}.raw": raw[k] for k, name in enumerate(self.fitted)}
            return torch.stack(curves(self.material, entries, self.specimen, [table])[0])

        slopes = torch.autograd.functional.jacobian(rows, start, vectorize=True)  # [2, N, K]
        variance = torch.einsum("rnk,kl,rnl->rn", slopes, self.covariance, slopes)
        with torch.no_grad():
            value = Response(*rows(start))
        force, lateral = variance.clamp(min=0).sqrt()
        return value, force, lateral

    def preload(self, table: ForceDisplacement) -> tuple[float, float]:
        """N, of a specimen that was clamped as the fitted ones were, taut by the same strain; and its deviation."""
        strains = [self.specimen.taut(self.material, table_of(t)) for t in self.tables]
        mean, spread = float(np.mean(strains)), float(np.std(strains, ddof=1)) if len(strains) > 1 else 0.0
        if mean == 0:
            return 0.0, 0.0
        with torch.no_grad():
            at = torch.tensor([mean, mean + spread], dtype=torch.float64)
            low, high = self.specimen.respond(self.material, self.material.coefficients(), table, at).force.tolist()
        return low, high - low


def missed(table: ForceDisplacement, curve: Response, known: tuple[Tensor, Tensor] | None = None) -> dict[str, Any]:
    """``Pulled.missed`` of a curve; ``known``: standard errors [N] of force and strain whose share is taken off."""
    out: dict[str, Any] = {"force": None, "lateral": None}
    for k, (kind, seen, base) in enumerate(
        (("force", table.force, table.preload), ("lateral", table.lateral_strain, 0.0))
    ):
        if seen is None:
            continue
        rows = np.isfinite(seen)
        square = (curve[k].detach().numpy()[rows] - seen[rows]) ** 2
        if known is not None:
            square = square - known[k].numpy()[rows] ** 2
            if square.mean() <= 0:
                continue
        rise = np.abs(seen[rows] - base)
        out[kind] = math.sqrt(square.mean() / (rise.mean() * rise.max()))
    return out


def table_of(kept: Pulled) -> ForceDisplacement:
    """The specimen of a fitted table, without its readings."""
    ends = np.array([0.0, kept.strain * kept.length])
    return ForceDisplacement(
        length=kept.length,
        width=kept.width,
        angle=kept.angle,
        preload=kept.preload,
        displacement=ends,
        force=np.full(2, np.nan),
    )


def pulled(tables: Sequence[ForceDisplacement], found: Sequence[Response]) -> list[Pulled]:
    """Entries of fitted tables."""
    return [
        Pulled(float(t.angle), t.length, t.width, t.preload, float(t.strain.max()), missed(t, c))
        for t, c in zip(tables, found, strict=True)
    ]


def with_left_out(model: TensionModel, left_out: Sequence[dict[str, float | None]]) -> TensionModel:
    """With what was missed of each table when it was not fitted."""
    return replace(model, tables=[replace(t, left_out=m) for t, m in zip(model.tables, left_out, strict=True)])


def read_model(path: str | Path) -> TensionModel:
    """The model of a saved fit: tension.json, or the folder that holds it.

    Raises:
        InvalidInput: there is no such file.
        RecordingError: it cannot be read, or does not hold what is needed.
    """
    expected = f"a law among {', '.join(LAWS)} with its numbers"
    again = "fit again with fit_tension and save"
    return read_result(path, RESULT, lambda content: _model(content["model"]), expected, again)


def _model(kept: dict[str, Any]) -> TensionModel:
    names = [str(name) for name in kept["fitted"]]
    values: dict[str, Any] = {
        name: value if isinstance(value, str) else number(value, name=name) for name, value in kept["values"].items()
    }
    material = LAWS[kept["material"]](**values).to(torch.float64)
    for name in names:
        if not isinstance(getattr(material, name), PhysicalParameter):
            raise ValueError(f"{name} is no parameter")
    rows = [[number(value, name="covariance") for value in row] for row in kept["covariance"]]
    if [len(row) for row in rows] != [len(names)] * len(names):
        raise ValueError(f"a covariance of {len(rows)} rows, fitted are {len(names)} numbers")
    covariance = torch.tensor(rows, dtype=torch.float64)
    if bool((covariance.diagonal() < 0).any()):
        raise ValueError("a negative variance")
    tables = [_pulled(table) for table in kept["tables"]]
    if not tables:
        raise ValueError("no tables")
    return TensionModel(material, SPECIMENS[kept["specimen"]](), names, covariance, tables)


def _pulled(kept: dict[str, Any]) -> Pulled:
    number(kept["angle"], name="angle")
    for name, least in {"length": SHORTEST, "width": SHORTEST, "preload": 0.0, "strain": 0.0}.items():
        number(kept[name], least, name)
    left_out = kept.get("left_out")
    for missed in (kept["missed"], *([] if left_out is None else [left_out])):
        for name in ("force", "lateral"):
            if missed[name] is not None:
                number(missed[name], 0.0, f"missed {name}")
    return Pulled(**kept)


def _arguments(law: type[AbstractMaterial]) -> list[str]:
    """Of the constructor; a lasting set is refused by specimens anyway."""
    return [name for name in inspect.signature(law).parameters if name != "plastic"]


def _plain(value: Any) -> float | str | None:
    """As JSON; None for a value per triangle."""
    if isinstance(value, PhysicalParameter):
        return float(value.value) if value.raw.ndim == 0 else None
    return value
