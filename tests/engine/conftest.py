"""The fused engine needs a compiler, or to have been built."""

import sys
from pathlib import Path

import pytest

from torchcloth.engine.library import Unbuilt, library

sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture(autouse=True, scope="module")
def _engine(request):
    """Build it once."""
    try:
        library()
    except Unbuilt as miss:
        if request.path.name != "test_library.py":  # that file asks what happens then
            pytest.skip(f"no fused engine: {miss}")
