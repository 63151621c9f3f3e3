"""``inspect`` on measured episodes, whose faults were found by others before.

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
from torchcloth.training.validation.realdata import lifts as lifts_of
from torchcloth.training.validation.realdata import swings as swings_of

pytestmark = pytest.mark.realdata
RUNS = ("range30_rep3", "range30_rep9", "range60_rep3", "range60_rep5", "range60_rep8", "range90_rep1", "range90_rep6")
README_LAG = 0.32  # s


def swing(source: Path, run: str) -> rec.Recording:
    """One run's grid of nodes with its raw stamps, as if nobody had looked at them."""
    return replace(swings_of.episode(source, run), points=None, clock_offset=0.0)


def lift(source: Path, trial: str) -> rec.Recording:
    """One lift with all its points."""
    return lifts_of.episode(source, trial, crop=False)


@pytest.fixture
def swings(measured_in) -> Path:
    return measured_in("iri_cloth_swings")


@pytest.fixture
def lifts(measured_in) -> Path:
    return measured_in("lifted_cloth_clouds")


def test_the_swings_lag_by_0_32_s(swings):
    found = [inspect(swing(swings, run)) for run in RUNS]
    lags = np.array([f.lag.value for f in found])
    assert all(f.lag.told and f.lag.std < 0.02 for f in found)
    assert np.median(lags) == pytest.approx(README_LAG, abs=0.02)
    assert np.abs(lags - README_LAG).max() < 0.03
    assert all("clocks differ" in " ".join(f.notes) for f in found)
    rejected = np.array([f.frames["markers"].rejected.mean() for f in found])
    assert 0.03 < np.median(rejected) < 0.17
    noise = np.array([f.noise["markers"].std for f in found])
    assert 0.0005 < noise.min() < noise.max() < 0.006
    assert 0.001 < np.median(noise) < 0.004
    rates = np.array([f.streams["markers"].rate for f in found])
    assert np.median(rates) == pytest.approx(9, abs=1)
    assert all(f.streams["markers"].gaps > 0 for f in found)


@pytest.mark.slow
def test_all_swings(swings):
    """Median lag 0.330 s (0.312 to 0.359), noise 1.9 mm (0.4 to 7.5), 14 % of the frames rejected (6 to 32)."""
    names = [f"range{size}_rep{k}" for size in (30, 60, 90) for k in range(1, 11)]
    found = [inspect(swing(swings, name)) for name in names]
    lags = np.array([f.lag.value for f in found])
    assert np.median(lags) == pytest.approx(README_LAG, abs=0.015)
    assert (np.abs(lags - README_LAG) < 0.03).mean() > 0.9
    assert np.median([f.frames["markers"].rejected.mean() for f in found]) == pytest.approx(0.14, abs=0.02)
    assert np.median([f.noise["markers"].std for f in found]) == pytest.approx(0.0019, abs=0.0005)


@pytest.mark.parametrize("trial", ["lift_paper", "lift_tan"])
def test_the_lifts_crop_and_outliers(lifts, trial):
    report = inspect(lift(lifts, trial))
    found = report.frames["points"]
    assert found.cuts["z >"] == pytest.approx(0.075, abs=2e-4)
    assert 0.002 < found.removed["outliers"] / len(report.recording.points.xyz) < 0.02
    assert 0.002 < found.removed["clusters"] / len(report.recording.points.xyz) < 0.1
    # 25 frames of which the first show no cloth yet: nothing told, or nothing that its error does not cover
    assert not report.lag.told or abs(report.lag.value) < 2 * report.lag.std
    assert report.noise["points"].std < 0.001
    assert report.streams["points"].rate == pytest.approx(10)
