"""Force and displacement of a strip in a tension machine: a folder with table.json (the specimen) and table.csv (rows).

{"format": "torchcloth-tension", "version": 1, "length": 0.097, "width": 0.027, "angle": 0.785398, "preload": 0.15,
 "provenance": "measured", "licence": "...", ...}                     # lengths m, angle rad, preload N

repeat,displacement,force,lateral_strain                              # -, m, N, -; the last column may be absent
0,0.0,0.15,
0,0.00005,0.24,-0.0002
"""

from __future__ import annotations

import csv
import io
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import RecordingError
from . import checks
from .atomic_write import place
from .files import Folder

FORMAT, VERSION = "torchcloth-tension", 1
META, ROWS = "table.json", "table.csv"
LONGEST = 5.0  # m, of a specimen; the same number in millimetres is a loop of yarn
LARGEST_STRAIN = 5.0  # beyond which displacements are plainly not in the length's unit
_COLUMNS = ("repeat", "displacement", "force", "lateral_strain")


@dataclass(frozen=True, eq=False, kw_only=True)
class ForceDisplacement:
    """Readings of one kind of specimen, pulled once or several times.

    ``displacement`` counts from the first reading, where the specimen already carries ``preload``; with gauge marks it
    is their change of distance, and ``length`` their distance.
    """

    length: float  # m, between the clamps or marks at the first reading
    width: float  # m of cloth that carries the force
    angle: float  # rad, from the warp to the direction of pull
    displacement: np.ndarray  # [N] m
    force: np.ndarray  # [N] N
    lateral_strain: np.ndarray | None = None  # [N] -, change of width over width, NaN where not seen
    repeat: np.ndarray | None = None  # [N] int, which pull a row belongs to; None: one
    preload: float = 0.0  # N, at displacement 0
    provenance: str = "measured"
    licence: str | None = None
    path: Path | None = None  # where it was read from; None while only in memory
    extra: dict[str, Any] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.force)

    @property
    def strain(self) -> np.ndarray:
        """[N] -, displacement over length."""
        return self.displacement / self.length

    def rows(self, chosen: np.ndarray) -> ForceDisplacement:
        """The table with the chosen rows only, by mask or index."""
        picked = {key: value[chosen] for key, value in _arrays(self).items()}
        return ForceDisplacement(**{**_scalars(self), **picked, "path": self.path, "extra": self.extra})

    def repeats(self, *numbers: int) -> ForceDisplacement:
        """The table with some of its pulls only."""
        own = np.zeros(len(self), dtype=int) if self.repeat is None else self.repeat
        return self.rows(np.isin(own, numbers))


def read_tension(path: str | Path) -> ForceDisplacement:
    """Read a table folder.

    Raises:
        RecordingError: a file is missing, damaged, or not in SI units; one line says what, got, expected, remedy.
    """
    return _read(Folder(Path(path)))


def write_tension(table: ForceDisplacement, path: str | Path, *, overwrite: bool = False) -> Path:
    """Write a table folder atomically; what cannot be read back is refused.

    Raises:
        RecordingError: the target exists, or the table would be refused by `read_tension`, or the disk fails.
    """

    def fill(part: Path, shown: Path) -> None:
        meta = {"format": FORMAT, "version": VERSION, **_scalars(table), **table.extra}
        (part / META).write_text(json.dumps(meta, indent=1, allow_nan=False) + "\n", encoding="utf-8")
        columns = _arrays(table)
        with (part / ROWS).open("w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(columns)
            cells = zip(*(np.asarray(c).tolist() for c in columns.values()), strict=True)
            writer.writerows([["" if cell != cell else repr(cell) for cell in row] for row in cells])
        _read(Folder(part, shown=shown))

    return place(Path(path), fill, marker=META, overwrite=overwrite)


def _read(folder: Folder) -> ForceDisplacement:
    meta = folder.json(META)
    found = meta.text("format"), meta.number("version")
    if found != (FORMAT, VERSION):
        raise RecordingError(f"{meta.place} is another format", got=found, expected=f"{FORMAT} {VERSION}")
    columns = _columns(folder.text(ROWS), folder.place(ROWS))
    table = ForceDisplacement(
        length=meta.number("length", above=0, most=LONGEST, suspect="millimetres"),
        width=meta.number("width", above=0, most=LONGEST, suspect="millimetres"),
        angle=meta.number("angle", least=-np.pi, most=np.pi, suspect="degrees"),
        preload=meta.maybe(meta.number, "preload", least=0.0) or 0.0,
        provenance=meta.text("provenance"),
        licence=meta.maybe(meta.text, "licence"),
        path=folder.shown,
        extra=meta.left(),
        **columns,
    )
    if not np.any(table.force):
        raise RecordingError(
            f"{folder.place(ROWS)}: force",
            got="0 in every row",
            expected="forces",
            remedy="was the load cell connected?",
        )
    worst = float(np.abs(table.strain).max())
    if worst > LARGEST_STRAIN:
        raise RecordingError(
            f"{folder.place(ROWS)}: displacement looks like millimetres",
            got=f"a strain of {worst:.3g}",
            expected=f"at most {LARGEST_STRAIN:g}",
            remedy="use metres",
        )
    return table


def _columns(text: str, place: str) -> dict[str, np.ndarray]:
    """The table's columns by name, checked."""
    try:
        lines = list(csv.reader(io.StringIO(text), strict=True))
    except csv.Error as error:
        raise RecordingError(f"{place} is not CSV", got=error, remedy="restore or repair it") from error
    head, body = (lines[0], lines[1:]) if lines else ([], [])
    if not {"displacement", "force"} <= set(head) <= set(_COLUMNS) or len(set(head)) < len(head):
        raise RecordingError(f"{place} has other columns", got=head, expected=f"some of {', '.join(_COLUMNS)}")
    if len(body) < 2:
        raise RecordingError(f"{place} is too short", got=f"{len(body)} row(s)", expected="at least 2")
    for number, row in enumerate(body, 2):
        if len(row) != len(head):
            raise RecordingError(f"{place} line {number}", got=f"{len(row)} cells", expected=f"{len(head)}")
    out = {}
    for name, cells in zip(head, zip(*body, strict=True), strict=True):
        unseen = name == "lateral_strain"
        try:
            numbers = np.array([float(c) if c or not unseen else np.nan for c in cells])
        except ValueError as error:
            raise RecordingError(f"{place}: {name} is not numbers", got=error, remedy="repair that row") from None
        out[name] = checks.array(numbers, f"{place}: {name}", (len(body),), nan=unseen)
    if "repeat" in out:
        if (out["repeat"] != np.round(out["repeat"])).any():
            raise RecordingError(f"{place}: repeat is not whole", expected="0, 1, 2, ...")
        out["repeat"] = out["repeat"].astype(int)
    return out


def _scalars(table: ForceDisplacement) -> dict[str, Any]:
    """What table.json holds beside the format and the extras."""
    keys = ("length", "width", "angle", "preload", "provenance", "licence")
    return {key: getattr(table, key) for key in keys if getattr(table, key) is not None}


def _arrays(table: ForceDisplacement) -> dict[str, np.ndarray]:
    """Columns that are there, in the file's order."""
    return {key: np.asarray(getattr(table, key)) for key in _COLUMNS if getattr(table, key) is not None}
