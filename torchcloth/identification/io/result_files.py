"""Results on disk, read again: what is missing or damaged is said in one way."""

from __future__ import annotations

import json
import math
import reprlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from ...errors import InvalidInput, RecordingError

T = TypeVar("T")
LARGEST = 1e100  # stands for infinity: a whole number of any length can be compared with it, and not all be a float


def read_result(path: str | Path, name: str, parse: Callable[[dict[str, Any]], T], expected: str, again: str) -> T:
    """``parse`` of a JSON file; what it raises for a content that it cannot use becomes one error.

    Args:
        path: the file, or the folder that holds it.
        name: of the file.
        parse: of its content.
        expected: what a good file holds.
        again: how to make one.

    Raises:
        InvalidInput: there is no such file.
        RecordingError: it cannot be read, or does not hold what is needed.
    """
    path = Path(path)
    path = path / name if path.is_dir() else path
    try:
        content = json.loads(path.read_text())
    except FileNotFoundError:
        models = ", ".join(sorted(map(str, path.parent.glob("*.tcm"))))
        remedy = f"or a model: {models}" if models else ""
        raise InvalidInput(
            "fit", got=f"no {path}", expected=f"{name}, or the folder that holds it", remedy=remedy
        ) from None
    except (OSError, ValueError, RecursionError) as error:
        raise RecordingError(f"{path}: unreadable", got=error, remedy=again) from None
    try:
        return parse(content)
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError, RecursionError) as error:
        said = f"{path}: does not say which model was fitted"
        got = f"no {error}" if isinstance(error, KeyError) else error
        raise RecordingError(said, got=got, expected=expected, remedy=again) from None


def number(value: Any, least: float = -math.inf, name: str = "") -> float:
    """A finite number, not below ``least``; ``name`` is for the message.

    Raises:
        ValueError: it is not.
    """
    plain = isinstance(value, int | float) and not isinstance(value, bool)
    if not plain or not max(least, -LARGEST) <= value < LARGEST:
        what = f"{name} {reprlib.repr(value)}".lstrip()
        raise ValueError(f"{what} where a finite number{'' if least == -math.inf else f' >= {least:g}'} should be")
    return float(value)
