"""Causes of one's own, from a Python file that registers them."""

from __future__ import annotations

import runpy
import sys
import traceback
from collections.abc import Iterable
from pathlib import Path

from ..._utils.resume import digest
from ...episodes.world import Hypothesis
from ...errors import InvalidInput, TorchclothError
from . import hypotheses

_files: dict[Path, str] = {}  # digest of the content and of what it imports, by path
_imports: dict[Path, set[Path]] = {}  # a second run of it in this process imports nothing any more
_NOT_ONES_OWN = {*sys.stdlib_module_names, "torchcloth"}
EXPECTED = "a Python file that calls torchcloth.diagnosis.register(Hypothesis(...))"


def register_file(path: str | Path) -> list[Hypothesis]:
    """Run a file that calls ``register``; returns what it registered.

    Raises:
        InvalidInput: no such file, one that fails, or one that registers nothing.
    """
    path = Path(path)
    if not path.is_file():
        remedy = "correct the path; docs/explanation/diagnosis.md has an example"
        raise InvalidInput("causes", got=f"no file {path}", expected=EXPECTED, remedy=remedy)
    before, beside = set(sys.modules), str(path.resolve().parent)
    sys.path.insert(0, beside)  # as Python has it for a script
    try:
        with hypotheses.noted() as found:
            runpy.run_path(str(path))
    except (Exception, SystemExit) as error:  # whatever a user's file does wrong
        lines = [part.lineno for part in traceback.extract_tb(error.__traceback__) if part.filename == str(path)]
        line = error.lineno if isinstance(error, SyntaxError) else lines[-1] if lines else None
        where = f"{path}{f', line {line}' if line else ''}"
        if isinstance(error, TorchclothError):
            what = f"{where}: {error.what}"
            raise InvalidInput(what, got=error.got, expected=error.expected, remedy=error.remedy) from None
        raise InvalidInput("causes", got=f"{type(error).__name__} in {where}: {error}", expected=EXPECTED) from None
    finally:
        sys.path.remove(beside)
    if not found:
        raise InvalidInput("causes", got=f"{path}, which registers nothing", expected=EXPECTED)
    imports = _imports.setdefault(path.resolve(), set())
    imports |= _sources(set(sys.modules) - before)
    _files[path.resolve()] = digest([p.read_bytes() for p in (path, *sorted(imports))])
    return found


def _sources(names: Iterable[str]) -> set[Path]:
    """Files of these modules that somebody may edit: of no installed package."""
    modules = (sys.modules.get(name) for name in names if name.partition(".")[0] not in _NOT_ONES_OWN)
    files = (Path(f).resolve() for m in modules if (f := getattr(m, "__file__", None)))
    return {f for f in files if f.suffix == ".py" and "site-packages" not in f.parts}


def digests() -> list[str]:
    """Of the files that were run, and of what they import: what a diagnosis that goes on depends on."""
    return sorted(_files.values())
