"""Everything that a cloth's simulations depend on, as a list that can be hashed."""

from __future__ import annotations

import inspect
from pathlib import Path

from ..cloth import Cloth


def _source(kind: type) -> str:
    """Of a part that is not the library's; empty where it is, which ``program`` knows, or where nobody can tell."""
    if kind.__module__.split(".")[0] in ("torchcloth", "torch"):
        return ""
    try:
        return Path(inspect.getfile(kind)).read_text(encoding="utf-8")
    except (TypeError, OSError, UnicodeDecodeError):
        return ""


def facts_of(cloth: Cloth) -> list[object]:
    """All that its simulations depend on: tensors by name, and what its parts keep as plain numbers and words."""
    tensors = [part for pair in (*cloth.named_parameters(), *cloth.named_buffers()) for part in pair]
    plain = [
        (path, name, value)
        for path, part in cloth.named_modules()
        for name, value in vars(part).items()
        if name != "training" and not name.startswith("_") and isinstance(value, (bool, int, float, str, tuple))
    ]
    kinds = [(path, f"{type(part).__module__}.{type(part).__qualname__}") for path, part in cloth.named_modules()]
    laws = [_source(kind) for kind in dict.fromkeys(type(part) for part in cloth.modules())]
    return [
        *kinds,
        *laws,
        *tensors,
        *plain,
        cloth.mesh.rest.tobytes(),
        cloth.mesh.faces.tobytes(),
        cloth.contact,
        cloth.engine,
    ]
