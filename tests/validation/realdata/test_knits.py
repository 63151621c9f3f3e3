"""Knits in tension: what is fitted to repeats 1 and 2 predicts force and contraction of repeat 3."""

from __future__ import annotations

import numpy as np
import pytest

from torchcloth.identification import Uniaxial, fit_tension
from torchcloth.identification.tension.fit import misses
from torchcloth.recordings import read_tension, write_tension
from torchcloth.training.validation.realdata import knits

pytestmark = pytest.mark.realdata

LIGHT = 5.0  # N, over 0.07 to 0.15 m: what a robot pulls with, and where one stiffening number is enough


@pytest.fixture
def fabrics(measured_in):
    return knits.fabrics(measured_in("knit_tension"))


def test_readings(measured_in, tmp_path):
    """16 samples, three repeats each, through the disk; forces rise with strain but for the spikes' remains."""
    samples = knits.tables(measured_in("knit_tension"))
    assert len(samples) == 16
    for name, table in samples.items():
        back = read_tension(write_tension(table, tmp_path / name))
        assert np.array_equal(back.lateral_strain, table.lateral_strain)
        assert set(back.repeat) == {1, 2, 3}
        assert 0.03 < back.length < 0.12
        assert back.width < 0.2
        beside = back.extra["pins apart across (m)"] > 1.1 * back.width
        assert beside == (name == knits.SUSPECT), "pins cannot be farther apart than the cloth is wide"
        assert 0 <= back.force.min() < 2
        assert 10 < back.force.max() <= 30
        for k in (1, 2, 3):
            pull = back.repeats(k)
            assert (np.diff(pull.displacement) > 0).all()
            assert (np.diff(pull.force) > -0.6).all(), "but for the steps of a load cell that is read by camera"
            assert pull.lateral_strain[-1] < -0.02, "it narrows"


def predict(fabric):
    """Errors of repeat 3 in both directions, from repeats 1 and 2; and the fit."""
    light = [table.rows(table.force < LIGHT) for table in fabric]
    fit = fit_tension(knits.start(), [table.repeats(1, 2) for table in light], knits.NAMES)
    found = knits.start()
    for name, path in fit.keys.items():
        found.get_submodule(path).set(fit.parameters[name].value)
    kept = [table.repeats(3) for table in light]
    return [misses(table, Uniaxial().curve(found.material, table)) for table in kept], fit


@pytest.mark.parametrize("name", ["Acrylic_Yarn_Stockinette", "Acrylic_Yarn_Seed", "Pearlized_Cotton_Seed"])
def test_held_out_repeat(fabrics, name):
    """RMS 4 to 9 % of the largest force and 3 to 20 % of the largest contraction, up to 5 N."""
    held, fit = predict(fabrics[name])
    for direction in held:
        assert direction["force_rms"] < 0.10
        assert direction["lateral_rms"] < 0.22
    assert fit.parameters["poisson_ratio"].identifiable
    assert 0.15 < fit.parameters["poisson_ratio"].value < 0.45


def test_ribs_are_missed(fabrics):
    """A rib folds: it opens by 140 % along X, and its contraction along Y is half of what one sheet's law gives."""
    held, fit = predict(fabrics["Acrylic_Yarn_Rib"])
    assert held[1]["lateral_rms"] > 0.3
    assert any("the law misses a force" in w for w in fit.warnings)
