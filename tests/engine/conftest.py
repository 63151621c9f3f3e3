"""The fused engine needs a compiler, or to have been built."""

import sys
from pathlib import Path

import pytest

from torchcloth.engine.library import library

sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture(autouse=True, scope="module")
def _engine(request):
    """Build it once."""
    try:
        library()
    except RuntimeError as error:
        if "no C++ compiler" not in str(error):
            raise
        if request.path.name != "test_library.py":  # that file asks what happens then
            pytest.skip(str(error))
