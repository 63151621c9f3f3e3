"""Knits in tension: a fit to repeats 1 and 2 predicts force and contraction of repeat 3."""

from __future__ import annotations

import numpy as np
import pytest

from torchcloth.identification import Uniaxial, fit_tension
from torchcloth.identification.tension.fit import table_errors
from torchcloth.recordings import read_tension, write_tension
from torchcloth.training.validation.realdata import knits

pytestmark = pytest.mark.realdata

MAX_LIGHT_FORCE_N = 5.0  # over 0.07 to 0.15 m: what a robot pulls with; one stiffening number is enough below


@pytest.fixture
def fabrics(measured_in):
    return knits.read_fabrics(measured_in("knit_tension"))


def test_readings(measured_in, tmp_path):
    """16 samples, three repeats each, through the disk; forces rise with strain apart from remains of spikes."""
    samples = knits.read_tables(measured_in("knit_tension"))
    assert len(samples) == 16
    for name, table in samples.items():
        back = read_tension(write_tension(table, tmp_path / name))
        assert np.array_equal(back.lateral_strain, table.lateral_strain)
        assert set(back.repeat) == {1, 2, 3}
        assert 0.03 < back.length < 0.12
        assert back.width < 0.2
        pins_are_too_far_apart = back.extra["distance of the lateral pins (m)"] > 1.1 * back.width
        assert pins_are_too_far_apart == (name == knits.SUSPECT_SAMPLE), (
            "pins cannot be farther apart than the cloth is wide"
        )
        assert 0 <= back.force.min() < 2
        assert 10 < back.force.max() <= 30
        for k in (1, 2, 3):
            pull = back.select_repeats(k)
            assert (np.diff(pull.displacement) > 0).all()
            assert (np.diff(pull.force) > -0.6).all(), "apart from the steps of a load cell that is read by camera"
            assert pull.lateral_strain[-1] < -0.02, "it narrows"


def predict_third_repeat(fabric):
    """Return the errors of repeat 3 in both directions, predicted from repeats 1 and 2, and the fit."""
    small_forces = [table.select_rows(table.force < MAX_LIGHT_FORCE_N) for table in fabric]
    fit = fit_tension(
        knits.initial_cloth(), [table.select_repeats(1, 2) for table in small_forces], knits.KNIT_PARAMETERS
    )
    cloth = knits.initial_cloth()
    for name, path in fit.keys.items():
        cloth.get_submodule(path).set(fit.parameters[name].value)
    third = [table.select_repeats(3) for table in small_forces]
    return [table_errors(table, Uniaxial().curve(cloth.material, table)) for table in third], fit


@pytest.mark.parametrize("name", ["Acrylic_Yarn_Stockinette", "Acrylic_Yarn_Seed", "Pearlized_Cotton_Seed"])
def test_third_repeat_is_predicted(fabrics, name):
    """RMS 4 to 9 % of the largest force and 3 to 20 % of the largest contraction, up to 5 N."""
    third_repeat_errors, fit = predict_third_repeat(fabrics[name])
    for direction in third_repeat_errors:
        assert direction["force_rms"] < 0.10
        assert direction["lateral_rms"] < 0.22
    assert fit.parameters["poisson_ratio"].identifiable
    assert 0.15 < fit.parameters["poisson_ratio"].value < 0.45


def test_ribs_are_missed(fabrics):
    """A rib unfolds: it opens by 140 % along X, and its contraction along Y is half of what a sheet's law gives."""
    third_repeat_errors, fit = predict_third_repeat(fabrics["Acrylic_Yarn_Rib"])
    assert third_repeat_errors[1]["lateral_rms"] > 0.3
    assert any("the law misses a force" in w for w in fit.warnings)
