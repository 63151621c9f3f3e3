"""What studies take from the repository's tests: another engine, and readers of measured data. They are no product."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from types import ModuleType

from torchcloth.errors import InvalidInput

TESTS = Path(__file__).resolve().parents[2] / "tests"


def folder(name: str) -> Path:
    """A folder of tests/, e.g. "independent".

    Raises:
        InvalidInput: an installed package without the repository around it.
    """
    if not (TESTS / name).is_dir():
        raise InvalidInput(
            "studies",
            got=f"no {TESTS / name}",
            expected="a checkout of the repository",
            remedy="work in a clone of the repository, after `make test`",
        )
    return TESTS / name


def module(name: str, file: str) -> ModuleType:
    """A module of a folder of tests/, e.g. ("realdata", "swings")."""
    path = str(folder(name))
    if path not in sys.path:
        sys.path.insert(0, path)
    return importlib.import_module(file)
