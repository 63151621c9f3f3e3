"""Helpers beside the tests; all of these need a compiler."""

import sys
from pathlib import Path

import pytest

from torchcloth.engine.library import Unbuilt, library

sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture(autouse=True)
def _built():
    try:
        library()
    except Unbuilt as miss:
        pytest.skip(str(miss))
