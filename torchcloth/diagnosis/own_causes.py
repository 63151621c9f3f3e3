"""Causes of one's own, from a Python file that registers them."""

from __future__ import annotations

import runpy
import traceback
from pathlib import Path

from ..errors import InvalidInput
from ..identification.journal import digest
from . import hypotheses
from .world import Hypothesis

_files: dict[str, str] = {}  # digest of the content, by path
EXPECTED = "a Python file that calls torchcloth.diagnosis.register(Hypothesis(...))"


def register_file(path: str | Path) -> list[Hypothesis]:
    """Run a file that calls ``register``; returns what it registered.

    Raises:
        InvalidInput: no such file, one that fails, or one that registers nothing.
    """
    path = Path(path)
    if not path.is_file():
        raise InvalidInput("causes", got=f"no file {path}", expected=EXPECTED)
    before = list(hypotheses.registered())
    try:
        runpy.run_path(str(path))
    except (Exception, SystemExit) as error:  # whatever a user's file does wrong
        lines = [part.lineno for part in traceback.extract_tb(error.__traceback__) if part.filename == str(path)]
        line = error.lineno if isinstance(error, SyntaxError) else lines[-1] if lines else None
        where = f"{path}{f', line {line}' if line else ''}"
        raise InvalidInput("causes", got=f"{type(error).__name__} in {where}: {error}", expected=EXPECTED) from None
    found = [h for h in hypotheses.registered() if h not in before]
    if not found:
        raise InvalidInput("causes", got=f"{path}, which registers nothing", expected=EXPECTED)
    _files[str(path.resolve())] = digest([path.read_bytes()])
    return found


def digests() -> list[str]:
    """Of the files that were run: what a diagnosis that goes on depends on."""
    return sorted(_files.values())
