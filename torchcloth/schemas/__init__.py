"""JSON Schemas (draft 2020-12) of the files that torchcloth reads and writes, and the check against them."""

from __future__ import annotations

import json
import reprlib
from collections.abc import Iterator
from functools import cache
from importlib import resources
from typing import Any

SCHEMA_NAMES = ("episode", "identification", "diagnosis", "plan")
_JSON_TYPES = {
    "array": "a list",
    "boolean": "true or false",
    "integer": "a whole number",
    "null": "null",
    "number": "a number",
    "object": "an object",
    "string": "text",
}


@cache
def load_schema(name: str) -> dict[str, Any]:
    """Load the JSON Schema of a file.

    Args:
        name: one of ``SCHEMA_NAMES``.
    """
    return json.loads((resources.files(__name__) / f"{name}.schema.json").read_text(encoding="utf-8"))


def check_structure(content: Any, name: str) -> None:
    """Check the structure of a file's content.

    Args:
        content: as ``json.loads`` returns it.
        name: one of ``SCHEMA_NAMES``.

    Raises:
        ValueError: the first difference from the schema, as "PLACE VALUE where EXPECTED should be".
    """
    error = next(iter(_sort_errors(content, name)), None)
    if error is not None:
        raise ValueError(_describe_error(error))


def list_keys(name: str, *path: str) -> list[str]:
    """Return the keys of an object in a file, in the order of its schema.

    Args:
        name: one of ``SCHEMA_NAMES``.
        path: keys that lead to the object; "*" leads through a name that the user chooses.
    """
    node = load_schema(name)
    for key in path:
        node = node["additionalProperties"] if key == "*" else node["properties"][key]
    return list(node["properties"])


def _sort_errors(content: Any, name: str) -> Iterator[Any]:
    from jsonschema import Draft202012Validator

    errors = Draft202012Validator(load_schema(name)).iter_errors(content)
    yield from sorted(errors, key=lambda e: (e.validator != "required", list(map(str, e.absolute_path))))


def _describe_error(error: Any) -> str:
    place = ".".join(map(str, error.absolute_path))
    if error.validator == "required":
        missing = next(key for key in error.validator_value if key not in error.instance)
        return f"no {missing!r}" + (f" in {place}" if place else "")
    value = f"{place} {reprlib.repr(error.instance)}".lstrip()
    return f"{value} where {_describe_expected(error.validator, error.validator_value, error.message)} should be"


def _describe_expected(keyword: str, wanted: Any, message: str) -> str:
    if keyword == "type":
        return " or ".join(_JSON_TYPES[t] for t in ([wanted] if isinstance(wanted, str) else wanted))
    if keyword in ("minimum", "maximum", "exclusiveMinimum", "exclusiveMaximum"):
        sign = {"minimum": ">=", "maximum": "<=", "exclusiveMinimum": ">", "exclusiveMaximum": "<"}[keyword]
        return f"a number {sign} {wanted:g}"
    if keyword in ("minItems", "maxItems"):
        return f"a list of {'at least' if keyword == 'minItems' else 'at most'} {wanted}"
    if keyword in ("enum", "const"):
        return " or ".join(map(repr, wanted if keyword == "enum" else [wanted]))
    return f"a value that follows the schema ({reprlib.repr(message)})"
