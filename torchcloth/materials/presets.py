"""Published fabrics, each with its source. What a source does not give stays empty: nothing is filled in.

Numbers are stress resultants [N/m] as published, and only they are observable; where a source gives no thickness the
moduli are made with a nominal 1 mm. Grades: A read in the primary document, B a full transcription, C secondary.
Arguments that neither the table nor the user gives keep the law's defaults. ``fabrics.csv`` beside this file is the
table. Numbers of the DiffCP paper have no unit there; their reading as kPa at 1 mm is stated with them.
"""

from __future__ import annotations

import csv
from functools import cache
from importlib import resources
from typing import Any, NamedTuple

from ..errors import InvalidInput

_Numbers = dict[str, float | None]

NOMINAL_THICKNESS_M = 1e-3  # m, thickness where none is published: stands in E = Y / h and drops out of every force


class Fabric(NamedTuple):
    """One row of the table; None where the source gives no number."""

    name: str
    fabric: str
    structure: str
    areal_density: float | None  # kg/m^2
    thickness: float | None  # m
    membrane_warp: float | None  # N/m, Young's modulus times thickness
    membrane_weft: float | None  # N/m
    membrane_shear: float | None  # N/m, in the plane
    poisson: float | None  # weft contraction under warp tension
    contact: float | None  # N/m, k h of the director
    sliding: float | None  # N/m, gamma h of the director
    bending_warp: float | None  # N m, for ``effects.Bending``
    bending_weft: float | None  # N m
    bending_hysteresis: float | None  # N, 2HB of KES
    drape: float | None  # %
    drape_nodes: float | None
    friction: float | None
    grade: str
    source: str
    note: str

    def isotropic(self, **changes: Any) -> dict[str, Any]:
        """Arguments of ``AEP``: what is published, then ``changes``.

        Raises:
            InvalidInput: the membrane stiffness is not published or not isotropic, and ``changes`` do not give it.
        """
        if "youngs_modulus" not in changes and self.membrane_warp != self.membrane_weft:
            raise InvalidInput(
                f"preset {self.name!r}",
                got=f"membrane stiffness {_shown(self.membrane_warp)} N/m warp, {_shown(self.membrane_weft)} N/m weft",
                expected="an isotropic fabric",
                remedy=f'use OrthotropicAEP.preset("{self.name}"), or give youngs_modulus=... [Pa]',
            )
        given = {"youngs_modulus": self.membrane_warp, **self._director()}
        if self.poisson is not None and "poisson_ratio" not in changes:
            self._checked(self.poisson)
        return self._arguments(given, self.poisson, ["youngs_modulus"], changes)

    def orthotropic(self, **changes: Any) -> dict[str, Any]:
        """Arguments of ``OrthotropicAEP``: what is published, then ``changes``.

        Raises:
            InvalidInput: a membrane stiffness is not published, and ``changes`` do not give it.
        """
        membrane = {
            "youngs_modulus": self.membrane_warp,
            "weft_modulus": self.membrane_weft,
            "shear_modulus": self.membrane_shear,
        }
        given = self._arguments({**membrane, **self._director()}, self.poisson, list(membrane), changes)
        if self.poisson is not None and "poisson_ratio" not in changes:  # the symmetric one, of the moduli as they are
            weft, warp = given["weft_modulus"], given["youngs_modulus"]
            given["poisson_ratio"] = self._checked(self.poisson * (weft / warp) ** 0.5)
        return given

    def _director(self) -> _Numbers:
        return {"contact_stiffness": self.contact, "shear_stiffness": self.sliding}

    def _arguments(
        self, resultants: _Numbers, poisson: float | None, needed: list[str], changes: dict[str, Any]
    ) -> dict[str, Any]:
        thickness = changes.get("thickness", self.thickness or NOMINAL_THICKNESS_M)
        if not thickness > 0:
            raise InvalidInput("thickness", got=f"{thickness} m", expected="a value > 0")
        given: dict[str, Any] = {"thickness": thickness}
        given |= {name: value / thickness for name, value in resultants.items() if value is not None}
        if poisson is not None:
            given["poisson_ratio"] = poisson
        missing = [name for name in needed if name not in {**given, **changes}]
        if missing:
            raise InvalidInput(
                f"preset {self.name!r} without {', '.join(missing)}",
                got=f"none from its source ({self.source})",
                expected="a value measured elsewhere",
                remedy="give " + ", ".join(f"{name}=... [Pa]" for name in missing),
            )
        return {**given, **changes}

    def _checked(self, poisson: Any) -> Any:
        """A field of moduli makes a field of them, which the material checks."""
        if isinstance(poisson, float) and not 0 < poisson < 0.5:
            raise InvalidInput(
                f"preset {self.name!r}",
                got=f"a published poisson_ratio of {self.poisson:g}, which is {poisson:.3g} with these moduli",
                expected="a value in (0, 0.5)",
                remedy="give poisson_ratio=...",
            )
        return poisson


_TEXT = ("name", "fabric", "structure", "grade", "source", "note")


@cache
def load_fabrics() -> dict[str, Fabric]:
    """All rows by name, in the order of the table."""
    text = resources.files("torchcloth.materials").joinpath("fabrics.csv").read_text(encoding="utf-8")
    _, *rows = csv.reader(text.splitlines())
    found = {}
    for row in rows:
        cells = zip(Fabric._fields, row, strict=True)
        values = {key: cell if key in _TEXT else float(cell) if cell else None for key, cell in cells}
        found[row[0]] = Fabric(**values)  # type: ignore[arg-type]
    return found


def find_fabric(name: str) -> Fabric:
    """The fabric called ``name``.

    Raises:
        InvalidInput: no such fabric.
    """
    if name not in load_fabrics():
        raise InvalidInput("fabric", got=repr(name), expected=f"one of {', '.join(load_fabrics())}")
    return load_fabrics()[name]


def format_table() -> str:
    """The numbers of all fabrics as text, with their grade; sources by ``find(name).source``."""
    columns = {
        "kg/m2": "areal_density",
        "warp N/m": "membrane_warp",
        "weft N/m": "membrane_weft",
        "shear N/m": "membrane_shear",
        "nu": "poisson",
        "k h N/m": "contact",
        "gamma h N/m": "sliding",
        "B warp N m": "bending_warp",
        "B weft N m": "bending_weft",
        "mu": "friction",
    }
    lines = [["name", "fabric", *columns, "grade"]]
    for f in load_fabrics().values():
        lines.append([f.name, f.fabric[:28], *(_shown(getattr(f, key)) for key in columns.values()), f.grade])
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join("  ".join(c.ljust(w) for c, w in zip(line, widths, strict=True)).rstrip() for line in lines)


def _shown(value: float | None) -> str:
    return "-" if value is None else f"{value:g}"
