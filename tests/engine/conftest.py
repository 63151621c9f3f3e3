"""The fused engine needs a compiler, or to have been built."""

import sys
from pathlib import Path

import pytest

from torchcloth.engine.library import library

sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture(autouse=True, scope="session")
def _engine():
    """Build it once."""
    try:
        library()
    except RuntimeError as error:
        if "no C++ compiler" not in str(error):
            raise
        pytest.skip(str(error))
