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
from .atomic_write import write_folder_atomically
from .files import Folder

TENSION_FORMAT, TENSION_VERSION = "torchcloth-tension", 1
TENSION_TABLE_FILE, TENSION_ROWS_FILE = "table.json", "table.csv"
MAX_SPECIMEN_LENGTH_M = 5.0  # the same number in millimetres is a loop of yarn
MAX_REPEAT = 1e6  # larger numbers are no count of pulls, and above 2^53 no whole number is itself
MAX_STRAIN = 5.0  # above it, displacements are not in the unit of the length
_TENSION_COLUMNS = ("repeat", "displacement", "force", "lateral_strain")


@dataclass(frozen=True, eq=False, kw_only=True)
class ForceDisplacement:
    """Readings of one kind of specimen, pulled once or several times.

    ``displacement`` counts from the first reading, at which the specimen already carries ``preload``. With gauge marks
    it is their change of distance, and ``length`` is their distance.

    Attributes:
        length: m, between the clamps or marks at the first reading.
        width: m, of cloth that carries the force.
        angle: rad, from the warp to the direction of pull.
        displacement: [N] m.
        force: [N] N.
        lateral_strain: [N], change of width over width, NaN where not seen.
        repeat: [N] int, which pull a row belongs to; None: there is one.
        preload: N, at displacement 0.
        provenance: "measured" or "synthetic: <generator>".
        licence: of the data.
        path: where it was read from; None while only in memory.
        extra: further keys of table.json.
    """

    length: float
    width: float
    angle: float
    displacement: np.ndarray
    force: np.ndarray
    lateral_strain: np.ndarray | None = None
    repeat: np.ndarray | None = None
    preload: float = 0.0
    provenance: str = "measured"
    licence: str | None = None
    path: Path | None = None
    extra: dict[str, Any] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.force)

    @property
    def strain(self) -> np.ndarray:
        """Strain [N], displacement over length."""
        return self.displacement / self.length

    def select_rows(self, chosen: np.ndarray | slice) -> ForceDisplacement:
        """Return the table with the chosen rows only, by mask, index or slice."""
        picked = {key: value[chosen] for key, value in _arrays(self).items()}
        return ForceDisplacement(**{**_scalars(self), **picked, "path": self.path, "extra": self.extra})

    def select_repeats(self, *numbers: int) -> ForceDisplacement:
        """Return the table with some of its pulls only."""
        repeat = np.zeros(len(self), dtype=int) if self.repeat is None else self.repeat
        return self.select_rows(np.isin(repeat, numbers))


def read_tension(path: str | Path) -> ForceDisplacement:
    """Read a table folder.

    Raises:
        RecordingError: a file is missing, damaged, or not in SI units.
    """
    return _read(Folder(Path(path)))


def write_tension(table: ForceDisplacement, path: str | Path, *, overwrite: bool = False) -> Path:
    """Write a table folder atomically; a table that cannot be read back is refused.

    Raises:
        RecordingError: the target exists, or the table would be refused by ``read_tension``, or the disk fails.
    """

    def fill(part: Path, shown: Path) -> None:
        meta = {"format": TENSION_FORMAT, "version": TENSION_VERSION, **_scalars(table), **table.extra}
        (part / TENSION_TABLE_FILE).write_text(json.dumps(meta, indent=1, allow_nan=False) + "\n", encoding="utf-8")
        columns = _arrays(table)
        with (part / TENSION_ROWS_FILE).open("w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(columns)
            cells = zip(*(np.asarray(c).tolist() for c in columns.values()), strict=True)
            writer.writerows([["" if cell != cell else repr(cell) for cell in row] for row in cells])
        _read(Folder(part, display_path=shown))

    return write_folder_atomically(Path(path), fill, marker=TENSION_TABLE_FILE, overwrite=overwrite)


def _read(folder: Folder) -> ForceDisplacement:
    meta = folder.read_json(TENSION_TABLE_FILE)
    identity = meta.text("format"), meta.number("version")
    if identity != (TENSION_FORMAT, TENSION_VERSION):
        raise RecordingError(
            f"{meta.place} is another format", got=identity, expected=f"{TENSION_FORMAT} {TENSION_VERSION}"
        )
    columns = _columns(folder.read_text(TENSION_ROWS_FILE), folder.location(TENSION_ROWS_FILE))
    table = ForceDisplacement(
        length=meta.number("length", above=0, maximum=MAX_SPECIMEN_LENGTH_M, suspect="millimetres"),
        width=meta.number("width", above=0, maximum=MAX_SPECIMEN_LENGTH_M, suspect="millimetres"),
        angle=meta.number("angle", minimum=-np.pi, maximum=np.pi, suspect="degrees"),
        preload=meta.optional(meta.number, "preload", minimum=0.0) or 0.0,
        provenance=meta.text("provenance"),
        licence=meta.optional(meta.text, "licence"),
        path=folder.display_path,
        extra=meta.unknown_keys(),
        **columns,
    )
    if not np.any(table.force):
        raise RecordingError(
            f"{folder.location(TENSION_ROWS_FILE)}: force",
            got="0 in every row",
            expected="forces",
            remedy="was the load cell connected?",
        )
    with np.errstate(over="ignore"):  # of a length that hardly is one
        worst = float(np.abs(table.strain).max())
    if worst > MAX_STRAIN:
        raise RecordingError(
            f"{folder.location(TENSION_ROWS_FILE)}: displacement looks like millimetres",
            got=f"a strain of {worst:.3g}",
            expected=f"at most {MAX_STRAIN:g}",
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
    if not {"displacement", "force"} <= set(head) <= set(_TENSION_COLUMNS) or len(set(head)) < len(head):
        raise RecordingError(f"{place} has other columns", got=head, expected=f"some of {', '.join(_TENSION_COLUMNS)}")
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
        out[name] = checks.check_array(numbers, f"{place}: {name}", (len(body),), nan=unseen)
    if "repeat" in out:
        if (out["repeat"] != np.round(out["repeat"])).any() or np.abs(out["repeat"]).max() > MAX_REPEAT:
            raise RecordingError(f"{place}: repeat is not whole", expected="0, 1, 2, ...")
        out["repeat"] = out["repeat"].astype(int)
    return out


def _scalars(table: ForceDisplacement) -> dict[str, Any]:
    """Content of table.json besides the format and the extra keys."""
    keys = ("length", "width", "angle", "preload", "provenance", "licence")
    return {key: getattr(table, key) for key in keys if getattr(table, key) is not None}


def _arrays(table: ForceDisplacement) -> dict[str, np.ndarray]:
    """Columns that are present, in the file's order."""
    return {key: np.asarray(getattr(table, key)) for key in _TENSION_COLUMNS if getattr(table, key) is not None}
