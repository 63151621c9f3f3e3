"""Checks that the JSON Schema of a file describes all of its content."""

import copy
import re
from typing import Any

from jsonschema import Draft202012Validator

from torchcloth.schemas import check_structure, load_schema


def find_undocumented_keys(content: Any, name: str) -> list[str]:
    """Return the paths of the keys that the schema does not name; reading ignores them."""
    strict = copy.deepcopy(load_schema(name))
    _close(strict)
    errors = [e for e in Draft202012Validator(strict).iter_errors(content)]
    errors += [inner for e in errors for inner in e.context or ()]
    closed = [e for e in errors if e.validator == "additionalProperties"]
    return [
        ".".join([*map(str, e.absolute_path), key])
        for e in closed
        for key in re.findall(r"'([^']+)'", e.message.split("(")[1])
    ]


def check_written(content: Any, name: str) -> None:
    """Check that a file follows its schema, and that the schema describes all of it."""
    check_structure(content, name)
    assert find_undocumented_keys(content, name) == []


def _close(node: Any) -> None:
    """Forbid further keys in all objects whose keys are listed."""
    if isinstance(node, dict):
        if "properties" in node and isinstance(node["properties"], dict) and node.get("type") is not None:
            node.setdefault("additionalProperties", False)
        for child in node.values():
            _close(child)
    elif isinstance(node, list):
        for child in node:
            _close(child)
