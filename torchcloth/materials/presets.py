"""Published fabrics, each with its source. What a source does not give stays empty.

Numbers are stress resultants [N/m] as published; only they are observable. Where a source gives no thickness, moduli
are computed with a nominal 1 mm. Grades: A read in the primary document, B a full transcription, C secondary. Arguments
that neither the table nor the user gives keep the law's defaults. The table is ``fabrics.csv`` in this folder. Numbers
of the DiffCP paper have no unit there; the table says that they are read as kPa at 1 mm.
"""

from __future__ import annotations

import csv
from functools import cache
from importlib import resources
from typing import Any, NamedTuple

from ..errors import InvalidInput

_Numbers = dict[str, float | None]

NOMINAL_THICKNESS_M = 1e-3  # where none is published; it cancels in every force, because E = Y / h


class Fabric(NamedTuple):
    """One row of the table; a number is None where the source does not give it.

    Attributes:
        name: by which a preset is called.
        fabric: description.
        structure: weave or knit.
        areal_density: [kg/m^2].
        thickness: [m].
        membrane_warp: Young's modulus times thickness along the warp [N/m].
        membrane_weft: Young's modulus times thickness along the weft [N/m].
        membrane_shear: shear modulus times thickness in the plane [N/m].
        poisson: contraction of the weft under tension of the warp [-].
        contact: k h of the director [N/m].
        sliding: gamma h of the director [N/m].
        bending_warp: [N m], for ``effects.Bending``.
        bending_weft: [N m].
        bending_hysteresis: 2HB of KES [N].
        drape: drape coefficient [%].
        drape_nodes: number of folds in the drape test.
        friction: mu [-].
        grade: of the source, see above.
        source: citation.
        note: remarks.
    """

    name: str
    fabric: str
    structure: str
    areal_density: float | None
    thickness: float | None
    membrane_warp: float | None
    membrane_weft: float | None
    membrane_shear: float | None
    poisson: float | None
    contact: float | None
    sliding: float | None
    bending_warp: float | None
    bending_weft: float | None
    bending_hysteresis: float | None
    drape: float | None
    drape_nodes: float | None
    friction: float | None
    grade: str
    source: str
    note: str

    def isotropic(self, **changes: Any) -> dict[str, Any]:
        """Return the arguments of ``AEP``: what is published, then ``changes``.

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
            self._check_poisson(self.poisson)
        return self._arguments(given, self.poisson, ["youngs_modulus"], changes)

    def orthotropic(self, **changes: Any) -> dict[str, Any]:
        """Return the arguments of ``OrthotropicAEP``: what is published, then ``changes``.

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
            given["poisson_ratio"] = self._check_poisson(self.poisson * (weft / warp) ** 0.5)
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

    def _check_poisson(self, poisson: Any) -> Any:
        """Check a published number; where moduli are fields it is a field, which the material checks."""
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
    """Return all fabrics by name, in the order of the table."""
    text = resources.files("torchcloth.materials").joinpath("fabrics.csv").read_text(encoding="utf-8")
    _, *rows = csv.reader(text.splitlines())
    by_name = {}
    for row in rows:
        cells = zip(Fabric._fields, row, strict=True)
        values = {key: cell if key in _TEXT else float(cell) if cell else None for key, cell in cells}
        by_name[row[0]] = Fabric(**values)  # type: ignore[arg-type]
    return by_name


def find_fabric(name: str) -> Fabric:
    """Return the fabric called ``name``.

    Raises:
        InvalidInput: no such fabric.
    """
    if name not in load_fabrics():
        raise InvalidInput("fabric", got=repr(name), expected=f"one of {', '.join(load_fabrics())}")
    return load_fabrics()[name]


def format_table() -> str:
    """Format the numbers of all fabrics as text, with their grade; ``find_fabric(name).source`` has the source."""
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
