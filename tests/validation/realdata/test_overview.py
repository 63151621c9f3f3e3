"""The overview: two quick adapters alone, and all of them through the command."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from torchcloth import recordings
from torchcloth.training.validation.realdata import overview

pytestmark = pytest.mark.realdata


def test_rows(measured_in, tmp_path):
    out = tmp_path / "bias_extension"
    row = overview.summarise_bias_extension(measured_in("bias_extension"), out)
    assert row.size == "43 rows"
    assert "24.7 N/m" in row.estimate
    assert (tmp_path / "bias_extension.png").stat().st_size > 10_000
    assert len(recordings.read_tension(out / "glass_plain")) == 43
    row = overview.summarise_cantilever(measured_in("cantilever"), tmp_path / "cantilever")
    assert row.estimate == "tip (0.222, -0.113) m"


@pytest.mark.slow
def test_all(realdata, tmp_path):
    command = [sys.executable, "-m", overview.__name__, "--out", tmp_path, "--source", realdata]
    process = subprocess.run(list(map(str, command)), capture_output=True, text=True, timeout=600)
    assert process.returncode == 0, process.stderr
    rows = json.loads((tmp_path / "overview.json").read_text())
    assert [row["source"] for row in rows] == [line for line in (r["source"] for r in rows) if line in process.stdout]
    assert len(rows) == len(overview.ADAPTERS)
    assert len(list(tmp_path.glob("*.png"))) == 6
    assert len(list(Path(tmp_path).glob("iri_cloth_swings/*/episode.json"))) == 30
