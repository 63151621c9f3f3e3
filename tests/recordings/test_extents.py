"""What was seen is of the cloth's size, or in another unit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from torchcloth import recordings as rec
from torchcloth.errors import RecordingError
from torchcloth.recordings.extents import check_size, of_another_size

FRAMES, POINTS = 5, 60


@pytest.fixture
def sheet():
    """0.3 m by 0.4 m, seen all over."""
    xyz = np.random.default_rng(0).random((FRAMES * POINTS, 3)) * [0.3, 0.4, 0.0]
    points = rec.PointClouds(np.arange(FRAMES) / 10, xyz, np.full(FRAMES, POINTS))
    cloth = rec.ClothInfo(areal_density=0.2, sheet=(0.3, 0.4))
    return rec.Recording(cloth=cloth, provenance="synthetic: test", points=points)


def times(recording, factor):
    return replace(recording, points=replace(recording.points, xyz=factor * recording.points.xyz))


def test_the_unit_is_guessed(sheet):
    check_size(sheet)
    for factor, said in ((1e-3, r"the cloud is 0\.00\d+ times as long as the cloth;"), (39.4, "as if in inches")):
        with pytest.raises(
            RecordingError, match=f"recording: .*{said}.*expected points of the cloth, in metres; check"
        ):
            check_size(times(sheet, factor))


def test_a_few_points_show_no_size(sheet):
    """One marker has none, nor has a cloth of unknown size."""
    first = rec.PointClouds(sheet.points.t, np.ones((FRAMES, 3)), np.ones(FRAMES, int))
    assert of_another_size(replace(sheet, points=first)) is None
    assert of_another_size(replace(times(sheet, 1e3), cloth=rec.ClothInfo(areal_density=0.2))) is None
