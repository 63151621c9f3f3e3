"""Tables of numbers as text, such as CSV files of any logger, and the times in them.

A table may have a header or none, comments, and any of the usual separators. A unit of time that no header states is
guessed from the intervals.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from ...errors import RecordingError
from .imported import MAX_SHOWN_CHARACTERS, NANOSECONDS_PER_SECOND, read_text

TimeUnit = Literal["s", "ms", "us", "ns"]
NANOSECONDS_BY_UNIT: dict[TimeUnit, int] = {"s": NANOSECONDS_PER_SECOND, "ms": 10**6, "us": 10**3, "ns": 1}
UNIT_NAMES: dict[TimeUnit, str] = {"s": "seconds", "ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}
UNIT_WORDS: dict[TimeUnit, frozenset[str]] = {  # words of a header that state the unit of its column
    "s": frozenset(("s", "sec", "secs", "second", "seconds")),
    "ms": frozenset(("ms", "msec", "msecs", "millis", "millisecond", "milliseconds")),
    "us": frozenset(("us", "usec", "usecs", "micros", "microsecond", "microseconds")),
    "ns": frozenset(("ns", "nsec", "nsecs", "nanos", "nanosec", "nanosecs", "nanosecond", "nanoseconds")),
}
STAMP_WORDS = (frozenset(("stamp", "timestamp", "timestamps")), frozenset(("time", "times", "secs", "sec")))
SHORT_STAMP_WORDS = frozenset(("t", *(word for words in UNIT_WORDS.values() for word in words)))
MAX_STAMP_NS = 2**62
SEPARATORS = "\t;,"
_DECIMAL_COMMA_PATTERN = re.compile(r"[-+]?\d+,\d+(?:[eE][-+]?\d+)?")


class Table(NamedTuple):
    """The rows of a text file.

    Attributes:
        path: of the file.
        heads: of the columns; None without a header.
        rows: cells of each row, as many in each.
        notes: what was left out.
    """

    path: Path
    heads: tuple[str, ...] | None
    rows: list[list[str]]
    notes: tuple[str, ...]

    def column(self, index: int) -> list[str]:
        """Return the cells of a column."""
        return [row[index] for row in self.rows]

    def numbers(self, columns: Sequence[int]) -> np.ndarray:
        """Return columns [N, C] as numbers.

        Raises:
            RecordingError: a cell is no finite number.
        """
        values = np.array([[_to_number(row[k]) for k in columns] for row in self.rows])
        bad = np.argwhere(~np.isfinite(values))
        if len(bad):
            row, column = (int(i) for i in bad[0])
            got = repr(self.rows[row][columns[column]][:MAX_SHOWN_CHARACTERS])
            what = f"{self.path}: {self.name_column(columns[column])} of row {row + 1}"
            raise RecordingError(what, got=got, expected="a finite number", remedy="repair or remove that row")
        return values

    def name_column(self, index: int) -> str:
        """Return the name of a column for messages."""
        return f"column {index + 1}" if self.heads is None else f"column {self.heads[index]!r}"


def read_table(path: Path) -> Table:
    """Read a table; a row that was cut off at the end of the file is left out.

    Raises:
        RecordingError: the file holds no table, or its rows have different numbers of cells.
    """
    lines = [line.strip() for line in read_text(path).splitlines()]
    first = next((line for line in lines if line and line[0] not in "#%" and _is_data(line)), None)
    if first is None:
        raise RecordingError(f"{path} holds no table", expected="rows of numbers", remedy="check the path")
    separator = next((s for s in SEPARATORS if s in first), None)
    heads: tuple[str, ...] | None = None
    rows: list[list[str]] = []
    for line in filter(None, lines):
        is_comment = line[0] in "#%"
        cells = _split(line.lstrip("#% ") if is_comment else line, separator)
        if not is_comment and any(_is_number(cell) for cell in cells):
            rows.append(cells)
        elif not rows:
            heads = tuple(cells)
        elif not is_comment:
            got = repr(line[:MAX_SHOWN_CHARACTERS])
            raise RecordingError(f"{path} is no table", got=got, expected="numbers in each row", remedy="remove it")
    if not rows:
        raise RecordingError(f"{path} holds no table", expected="rows of numbers", remedy="check its separators")
    notes = []
    if len(rows) > 1 and len(rows[-1]) < len(rows[0]):
        rows.pop()
        notes.append(f"{path.name}: its last row was cut off and is left out")
    wrong = next((k for k, row in enumerate(rows) if len(row) != len(rows[0])), None)
    if wrong is not None:
        got = f"{len(rows[wrong])} cells in row {wrong + 1}"
        raise RecordingError(f"{path} is no table", got=got, expected=f"{len(rows[0])}, as in the first row")
    return Table(path, heads if heads is not None and len(heads) == len(rows[0]) else None, rows, tuple(notes))


def split_words(head: str) -> list[str]:
    """Return the words of a column's head, in lower case."""
    return re.findall(r"[a-z]+|\d+", re.sub(r"([a-z])([A-Z])", r"\1 \2", head).lower())


def find_time_columns(table: Table) -> tuple[int, int | None]:
    """Return the column of the times, and of their nanoseconds where these stand in a column of their own.

    Without a head that speaks of time it is the first column.
    """
    words = [split_words(head) for head in table.heads or ()]
    for k, columns in enumerate(words):
        rest = [w for w in columns if w not in UNIT_WORDS["s"]]
        for j, others in enumerate(words) if len(rest) < len(columns) else ():
            if [w for w in others if w not in UNIT_WORDS["ns"]] == rest and len(rest) < len(others):
                return k, j
    for ranked in STAMP_WORDS:
        for k, columns in enumerate(words):
            if ranked.intersection(columns):
                return k, None
    alone = (k for k, columns in enumerate(words) if columns and SHORT_STAMP_WORDS.issuperset(columns))
    return next(alone, 0), None


def read_stamps(table: Table, columns: tuple[int, int | None], max_interval_s: float, unit: TimeUnit | None) -> Stamps:
    """Read the times of a table.

    Args:
        table: of N rows.
        columns: of `find_time_columns`.
        max_interval_s: no two rows are farther apart on average, if the unit must be guessed.
        unit: of the times; None: as the head says, or guessed.
    """
    column, nanoseconds = columns
    texts = table.column(column)
    if nanoseconds is not None:
        texts = [f"{whole}.{part:0>9}" for whole, part in zip(texts, table.column(nanoseconds), strict=True)]
        unit = "s"
    words = set(split_words(table.heads[column])) if table.heads is not None else set()
    stated: list[TimeUnit] = [name for name, names in UNIT_WORDS.items() if words & names]
    known = unit or (stated[0] if stated else None)
    return to_stamps(texts, f"{table.path.name}: {table.name_column(column)}", max_interval_s, known)


class Stamps(NamedTuple):
    """Times of samples.

    Attributes:
        ns: [N] ns.
        notes: the unit, if it was guessed.
    """

    ns: np.ndarray
    notes: tuple[str, ...]


def to_stamps(texts: Sequence[str], place: str, max_interval_s: float, unit: TimeUnit | None) -> Stamps:
    """Convert texts to times; a unit that is not given follows from the median interval.

    Args:
        texts: N decimal numbers.
        place: where they are from, for messages.
        max_interval_s: no interval in seconds is longer. The same number counts for the other units: an interval of at
            least so many seconds is one in milliseconds, and so on.
        unit: of the times; None: guessed.

    Raises:
        RecordingError: a text is no time.
    """
    values = [_to_decimal(text, place) for text in texts]
    notes: tuple[str, ...] = ()
    if unit is not None:
        known = unit
    else:
        intervals = np.diff(sorted(float(value - values[0]) for value in values))
        intervals = intervals[intervals > 0]
        if not len(intervals):
            raise RecordingError(f"{place} is no time", got="one value throughout", expected="times that increase")
        step = float(np.median(intervals))
        longer: list[TimeUnit] = [name for k, name in enumerate(UNIT_NAMES) if step < max_interval_s * 1000**k]
        known = longer[0] if longer else "ns"
        notes = (f"{place}: times in {UNIT_NAMES[known]}, from their median step of {step:g}",)
    stamps = [int(value * NANOSECONDS_BY_UNIT[known]) for value in values]
    if max(map(abs, stamps)) > MAX_STAMP_NS:
        raise RecordingError(f"{place} is no time", got=texts[0][:MAX_SHOWN_CHARACTERS], expected=UNIT_NAMES[known])
    return Stamps(np.array(stamps, dtype=np.int64), notes)


def _split(line: str, separator: str | None) -> list[str]:
    cells = line.split() if separator is None else next(csv.reader([line], delimiter=separator))
    cells = [cell.strip().strip("'\"") for cell in cells]
    if separator not in (",", None):
        cells = [cell.replace(",", ".") if _DECIMAL_COMMA_PATTERN.fullmatch(cell) else cell for cell in cells]
    return cells[:-1] if separator is not None and len(cells) > 1 and not cells[-1] else cells


def _is_data(line: str) -> bool:
    return any(_is_number(cell.strip().strip("'\"")) for cell in re.split(r"[\s;,]+", line))


def _is_number(cell: str) -> bool:
    return not np.isnan(_to_number(cell)) or cell.lower() in ("nan", "-nan")


def _to_number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return float("nan")


def _to_decimal(text: str, place: str) -> Decimal:
    try:
        value = Decimal(text)
    except InvalidOperation:
        value = Decimal("NaN")
    if not value.is_finite() or abs(value) > MAX_STAMP_NS:
        expected = "a number of seconds, milliseconds, microseconds or nanoseconds"
        raise RecordingError(f"{place} is no time", got=repr(text[:MAX_SHOWN_CHARACTERS]), expected=expected)
    return value
