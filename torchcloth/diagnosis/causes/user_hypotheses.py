"""Hypotheses from a user's Python file that registers them."""

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

_files: dict[Path, str] = {}  # digest of a file and of what it imports, by path
_imports: dict[Path, set[Path]] = {}  # what a file imports; a second run in this process imports nothing
_LIBRARY_MODULES = {*sys.stdlib_module_names, "torchcloth"}
EXPECTED_FILE = "a Python file that calls torchcloth.diagnosis.register(Hypothesis(...))"


def register_file(path: str | Path) -> list[Hypothesis]:
    """Run a file that calls ``register``, and return what it registered.

    Raises:
        InvalidInput: no such file, one that fails, or one that registers nothing.
    """
    path = Path(path)
    if not path.is_file():
        remedy = "correct the path; docs/how-to/diagnose.md has an example"
        raise InvalidInput("causes", got=f"no file {path}", expected=EXPECTED_FILE, remedy=remedy)
    before, folder = set(sys.modules), str(path.resolve().parent)
    sys.path.insert(0, folder)  # as Python does for a script
    try:
        with hypotheses.record_registrations() as registered:
            runpy.run_path(str(path))
    except (Exception, SystemExit) as error:  # whatever a user's file does wrong
        lines = [part.lineno for part in traceback.extract_tb(error.__traceback__) if part.filename == str(path)]
        line = error.lineno if isinstance(error, SyntaxError) else lines[-1] if lines else None
        where = f"{path}{f', line {line}' if line else ''}"
        if isinstance(error, TorchclothError):
            what = f"{where}: {error.what}"
            raise InvalidInput(what, got=error.got, expected=error.expected, remedy=error.remedy) from None
        raise InvalidInput(
            "causes", got=f"{type(error).__name__} in {where}: {error}", expected=EXPECTED_FILE
        ) from None
    finally:
        sys.path.remove(folder)
    if not registered:
        raise InvalidInput("causes", got=f"{path}, which registers nothing", expected=EXPECTED_FILE)
    imports = _imports.setdefault(path.resolve(), set())
    imports |= _list_sources(set(sys.modules) - before)
    _files[path.resolve()] = digest([p.read_bytes() for p in (path, *sorted(imports))])
    return registered


def _list_sources(names: Iterable[str]) -> set[Path]:
    """Return the files of modules that a user may edit, without installed packages."""
    modules = (sys.modules.get(name) for name in names if name.partition(".")[0] not in _LIBRARY_MODULES)
    files = (Path(f).resolve() for m in modules if (f := getattr(m, "__file__", None)))
    return {f for f in files if f.suffix == ".py" and "site-packages" not in f.parts}


def digest_user_files() -> list[str]:
    """Return digests of the files that were run and of what they import, on which a resumed diagnosis depends."""
    return sorted(_files.values())
