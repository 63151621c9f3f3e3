"""Adapters import each other by name, and sources are found by theirs."""

import sys
from collections.abc import Callable
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture
def measured_in(realdata: Path) -> Callable[[str], Path]:
    """The folder of a source by name; skips where it is absent."""

    def find(name: str) -> Path:
        if not (realdata / name).is_dir():
            pytest.skip(f"{realdata / name} is absent")
        return realdata / name

    return find
