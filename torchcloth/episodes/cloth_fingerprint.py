"""Everything that a cloth's simulations depend on, as a list that can be hashed."""

from __future__ import annotations

import inspect
from pathlib import Path

from ..cloth import Cloth


def is_library_part(kind: type) -> bool:
    """Tell whether a part is the library's or torch's, and no user's."""
    return kind.__module__.split(".")[0] in ("torchcloth", "torch")


def _read_source(kind: type) -> str:
    """Source of a user's part. Empty for parts of the library, whose version is hashed elsewhere, or if unreadable."""
    if is_library_part(kind):
        return ""
    try:
        return Path(inspect.getfile(kind)).read_text(encoding="utf-8")
    except (TypeError, OSError, UnicodeDecodeError):
        return ""


def cloth_fingerprint_parts(cloth: Cloth) -> list[object]:
    """List tensors by name, classes and sources of the parts, and their attributes that are numbers or strings."""
    tensors = [part for pair in (*cloth.named_parameters(), *cloth.named_buffers()) for part in pair]
    attributes = [
        (path, name, value)
        for path, part in cloth.named_modules()
        for name, value in vars(part).items()
        if name != "training" and not name.startswith("_") and isinstance(value, (bool, int, float, str, tuple))
    ]
    classes = [(path, f"{type(part).__module__}.{type(part).__qualname__}") for path, part in cloth.named_modules()]
    sources = [_read_source(kind) for kind in dict.fromkeys(type(part) for part in cloth.modules())]
    return [
        *classes,
        *sources,
        *tensors,
        *attributes,
        cloth.mesh.rest.tobytes(),
        cloth.mesh.faces.tobytes(),
        cloth.contact,
        cloth.engine,
    ]
