"""Read result files; whatever is missing or damaged becomes one clear error."""

from __future__ import annotations

import json
import math
import reprlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from ...errors import InvalidInput, RecordingError

T = TypeVar("T")
MAX_NUMBER = 1e100  # stands for infinity: any whole number can be compared with it, but not every one fits a float


def read_result(
    path: str | Path, name: str, schema: str, parse: Callable[[dict[str, Any]], T], expected: str, remedy: str
) -> T:
    """Parse a JSON result file of the given schema.

    Args:
        path: the file, or the folder that holds it.
        name: of the file.
        schema: value that the file's key "schema" must have.
        parse: turns the content into the result.
        expected: what a good file holds, for messages.
        remedy: how to make one, for messages.

    Raises:
        InvalidInput: there is no such file.
        RecordingError: it cannot be read, has another schema, or does not hold what is needed.
    """
    path = Path(path)
    path = path / name if path.is_dir() else path
    try:
        content = json.loads(path.read_text(encoding="utf-8-sig"))
    except FileNotFoundError:
        models = ", ".join(sorted(map(str, path.parent.glob("*.tcm"))))
        alternative = f"or a model: {models}" if models else ""
        raise InvalidInput(
            "fit", got=f"no {path}", expected=f"{name}, or the folder that holds it", remedy=alternative
        ) from None
    except (OSError, ValueError, RecursionError) as error:
        raise RecordingError(f"{path}: unreadable", got=error, remedy=remedy) from None
    stated = content.get("schema") if isinstance(content, dict) else None
    if stated != schema:
        got = "none" if stated is None else reprlib.repr(stated)
        raise RecordingError(f"{path}: schema", got=got, expected=repr(schema), remedy=remedy)
    try:
        return parse(content)
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError, RecursionError) as error:
        got = f"no {error}" if isinstance(error, KeyError) else error
        raise RecordingError(
            f"{path}: does not say which model was fitted", got=got, expected=expected, remedy=remedy
        ) from None


def check_number(value: Any, minimum: float = -math.inf, name: str = "") -> float:
    """Check that a value is a finite number, not below ``minimum``, and return it as a float.

    Raises:
        ValueError: it is not; ``name`` is part of the message.
    """
    is_plain = isinstance(value, int | float) and not isinstance(value, bool)
    if not is_plain or not max(minimum, -MAX_NUMBER) <= value < MAX_NUMBER:
        what = f"{name} {reprlib.repr(value)}".lstrip()
        bound = "" if minimum == -math.inf else f" >= {minimum:g}"
        raise ValueError(f"{what} where a finite number{bound} should be")
    return float(value)
