"""``inspect`` on measured episodes with known faults.

The IRI swings' own README: stamps lag the tool by about 0.32 s, static noise 1 to 4 mm, frames to be rejected by arc
length. The lifted clouds were cropped by their authors at z = 0.075 m.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from torchcloth import recordings as rec
from torchcloth.inspection import inspect
from torchcloth.training.validation.realdata import lifts as lift_adapter
from torchcloth.training.validation.realdata import swings as swing_adapter

pytestmark = pytest.mark.realdata
INSPECTED_RUNS = (
    "range30_rep3",
    "range30_rep9",
    "range60_rep3",
    "range60_rep5",
    "range60_rep8",
    "range90_rep1",
    "range90_rep6",
)
README_LAG_S = 0.32


def read_raw_swing(source: Path, run: str) -> rec.Recording:
    """Return one run's grid of nodes with its raw stamps."""
    return replace(swing_adapter.read_episode(source, run), points=None, clock_offset=0.0)


def read_raw_lift(source: Path, trial: str) -> rec.Recording:
    """Return one lift with all its points."""
    return lift_adapter.read_episode(source, trial, crop=False)


@pytest.fixture
def swings(measured_in) -> Path:
    return measured_in("iri_cloth_swings")


@pytest.fixture
def lifts(measured_in) -> Path:
    return measured_in("lifted_cloth_clouds")


def test_the_swings_lag_by_0_32_s(swings):
    reports = [inspect(read_raw_swing(swings, run)) for run in INSPECTED_RUNS]
    lags = np.array([f.lag.value for f in reports])
    assert all(f.lag.is_determined and f.lag.std < 0.02 for f in reports)
    assert np.median(lags) == pytest.approx(README_LAG_S, abs=0.02)
    assert np.abs(lags - README_LAG_S).max() < 0.03
    assert all("clocks differ" in " ".join(f.notes) for f in reports)
    rejected = np.array([f.frames["markers"].rejected.mean() for f in reports])
    assert 0.03 < np.median(rejected) < 0.17
    noise = np.array([f.noise["markers"].std for f in reports])
    assert 0.0005 < noise.min() < noise.max() < 0.006
    assert 0.001 < np.median(noise) < 0.004
    rates = np.array([f.streams["markers"].rate for f in reports])
    assert np.median(rates) == pytest.approx(9, abs=1)
    assert all(f.streams["markers"].gaps > 0 for f in reports)


@pytest.mark.slow
def test_all_swings(swings):
    """Median lag 0.330 s (0.312 to 0.359), noise 1.9 mm (0.4 to 7.5), 14 % of the frames rejected (6 to 32)."""
    names = [f"range{size}_rep{k}" for size in (30, 60, 90) for k in range(1, 11)]
    reports = [inspect(read_raw_swing(swings, name)) for name in names]
    lags = np.array([f.lag.value for f in reports])
    assert np.median(lags) == pytest.approx(README_LAG_S, abs=0.015)
    assert (np.abs(lags - README_LAG_S) < 0.03).mean() > 0.9
    assert np.median([f.frames["markers"].rejected.mean() for f in reports]) == pytest.approx(0.14, abs=0.02)
    assert np.median([f.noise["markers"].std for f in reports]) == pytest.approx(0.0019, abs=0.0005)


@pytest.mark.parametrize("trial", ["lift_paper", "lift_tan"])
def test_the_lifts_crop_and_outliers(lifts, trial):
    report = inspect(read_raw_lift(lifts, trial))
    frames = report.frames["points"]
    assert frames.crop_planes["z >"] == pytest.approx(0.075, abs=2e-4)
    assert 0.002 < frames.removed["outliers"] / len(report.recording.points.xyz) < 0.02
    assert 0.002 < frames.removed["clusters"] / len(report.recording.points.xyz) < 0.1
    # 25 frames, of which the first show no cloth: the lag is undetermined, or its error covers zero
    assert not report.lag.is_determined or abs(report.lag.value) < 2 * report.lag.std
    assert report.noise["points"].std < 0.001
    assert report.streams["points"].rate == pytest.approx(10)
