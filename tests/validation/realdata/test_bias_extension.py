"""Bias extension of a glass weave: how far one shear modulus goes."""

from __future__ import annotations

import numpy as np
import pytest

from torchcloth.identification import Trellis, fit_tension
from torchcloth.recordings import read_tension, write_tension
from torchcloth.training.validation.realdata import bias_extension

pytestmark = pytest.mark.realdata


@pytest.fixture
def table(measured_in):
    return bias_extension.table(measured_in("bias_extension"))


@pytest.fixture
def shear(table) -> np.ndarray:
    """[N] degrees, of the middle, if it is a trellis."""
    return np.degrees(Trellis().angle(table).numpy())


def computed(table, shear, most: float):
    """Force [N] at all readings from one modulus that was fitted up to ``most`` degrees, and G h [N/m]."""
    fit = fit_tension(bias_extension.start(), table.rows(shear < most), ["shear_modulus"], specimen=Trellis())
    found = fit.apply(bias_extension.start())
    estimate = fit.parameters["shear_modulus"]
    force = Trellis().curve(found.material, table).force.detach().numpy()
    return force, estimate.value * bias_extension.THICKNESS, estimate.std * bias_extension.THICKNESS


def test_through_the_disk(table, tmp_path):
    back = read_tension(write_tension(table, tmp_path / "table"))
    assert np.array_equal(back.displacement, table.displacement)
    assert 80 < np.degrees(float(Trellis().angle(back).max())) < 90, "more than yarns can turn: they slip at the end"


def test_one_modulus_fails_at_both_ends(table, shear):
    """G h = 25 N/m, fitted up to 40 degrees: within 20 % from 16 to 58 degrees, half at 8, a third too much past 66."""
    force, stiffness, std = computed(table, shear, 40)
    assert stiffness == pytest.approx(24.7, abs=2)
    assert std < 0.2 * stiffness  # of a law that misses the curve at both ends; a quarter is no estimate
    ratio = force / table.force
    assert np.abs(ratio[(shear > 15.5) & (shear < 58)] - 1).max() < 0.2
    assert (ratio[shear < 8] < 0.6).all(), "friction at the crossings, about 1 N, has no place in an elastic law"
    assert (ratio[shear > 66] > 1.25).all(), "the trellis locks at 90 degrees, real yarns slip"


def test_the_modulus_hangs_on_the_range(table, shear):
    """Friction at small angles passes for stiffness: 52 N/m below 10 degrees, 25 below 40."""
    small, large = (computed(table, shear, most)[1] for most in (10, 40))
    assert small > 1.7 * large
