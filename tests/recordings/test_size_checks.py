"""What was seen is of the cloth's size, or in another unit."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from torchcloth import meshes
from torchcloth import recordings as rec
from torchcloth.errors import RecordingError
from torchcloth.recordings.size_checks import check_size, cloth_size, detect_wrong_size

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
    for factor, message in ((1e-3, r"the cloud is 0\.00\d+ times as long as the cloth;"), (39.4, "as if in inches")):
        with pytest.raises(
            RecordingError, match=f"recording: .*{message}.*expected points of the cloth, in metres; check"
        ):
            check_size(times(sheet, factor))


def test_a_few_points_show_no_size(sheet):
    """One marker has none, nor has a cloth of unknown size."""
    first = rec.PointClouds(sheet.points.t, np.ones((FRAMES, 3)), np.ones(FRAMES, int))
    assert detect_wrong_size(replace(sheet, points=first)) is None
    assert detect_wrong_size(replace(times(sheet, 1e3), cloth=rec.ClothInfo(areal_density=0.2))) is None


def test_a_cloth_that_lies_folded_is_as_long_as_its_pattern():
    mesh = meshes.rectangle(0.3, 0.3, resolution=(5, 5))
    folded = mesh.vertices * 1.0
    folded[:, 0] = np.abs(folded[:, 0] - 0.15)
    info = partial(rec.ClothInfo, areal_density=0.2, faces=mesh.faces)
    for uv in (mesh.uv, mesh.pattern):
        assert cloth_size(info(vertices=folded, uv=uv)) == pytest.approx((0.3 * 2**0.5, 0.09))
    assert cloth_size(info(vertices=folded)) == pytest.approx((np.hypot(0.15, 0.3), 0.09))  # all that is known of it
    assert cloth_size(info(vertices=mesh.vertices, uv=mesh.uv + 5.0)) == pytest.approx((0.3 * 2**0.5, 0.09))


def test_panels_that_lie_apart_in_the_pattern_are_no_longer_for_it():
    shirt = meshes.shirt()
    result, _ = cloth_size(
        rec.ClothInfo(areal_density=0.2, vertices=shirt.vertices, faces=shirt.faces, uv=shirt.pattern)
    )
    assert result == pytest.approx(np.linalg.norm(np.ptp(shirt.vertices, axis=0)))
