"""One rich synthetic episode that uses every part of the format."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.rich_recording import check_equal, make_recording

from torchcloth import recordings as rec


@pytest.fixture(scope="session")
def assert_same():
    return check_equal


@pytest.fixture
def recording(tmp_path) -> rec.Recording:
    return make_recording(tmp_path)


@pytest.fixture
def episode(recording, tmp_path) -> Path:
    return rec.write(recording, tmp_path / "ep")
