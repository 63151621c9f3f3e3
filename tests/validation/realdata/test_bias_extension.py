"""Bias extension of a glass weave: the range of one shear modulus."""

from __future__ import annotations

import numpy as np
import pytest

from torchcloth.identification import Trellis, fit_tension
from torchcloth.recordings import read_tension, write_tension
from torchcloth.training.validation.realdata import bias_extension

pytestmark = pytest.mark.realdata


@pytest.fixture
def table(measured_in):
    return bias_extension.read_table(measured_in("bias_extension"))


@pytest.fixture
def shear(table) -> np.ndarray:
    """Return the shear angles [N] degrees of the middle, as a trellis."""
    return np.degrees(Trellis().angle(table).numpy())


def fit_modulus(table, shear, max_angle: float):
    """Fit one modulus up to ``max_angle`` [degrees]; return the force at all readings [N], G h [N/m] and its std."""
    fit = fit_tension(
        bias_extension.initial_cloth(), table.select_rows(shear < max_angle), ["shear_modulus"], specimen=Trellis()
    )
    cloth = fit.apply(bias_extension.initial_cloth())
    estimate = fit.parameters["shear_modulus"]
    force = Trellis().curve(cloth.material, table).force.detach().numpy()
    return force, estimate.value * bias_extension.GLASS_THICKNESS_M, estimate.std * bias_extension.GLASS_THICKNESS_M


def test_through_the_disk(table, tmp_path):
    back = read_tension(write_tension(table, tmp_path / "table"))
    assert np.array_equal(back.displacement, table.displacement)
    assert 80 < np.degrees(float(Trellis().angle(back).max())) < 90, "more than yarns can rotate: they slip at the end"


def test_one_modulus_fails_at_both_ends(table, shear):
    """G h = 25 N/m, fitted up to 40 degrees: within 20 % from 16 to 58 degrees, half at 8, a third too much past 66."""
    force, stiffness, std = fit_modulus(table, shear, 40)
    assert stiffness == pytest.approx(24.7, abs=2)
    assert std < 0.2 * stiffness  # of a law that misses the curve at both ends; a quarter is no estimate
    ratio = force / table.force
    assert np.abs(ratio[(shear > 15.5) & (shear < 58)] - 1).max() < 0.2
    assert (ratio[shear < 8] < 0.6).all(), "friction at the crossings, about 1 N, is not in an elastic law"
    assert (ratio[shear > 66] > 1.25).all(), "the trellis locks at 90 degrees, real yarns slip"


def test_the_modulus_depends_on_the_range(table, shear):
    """Friction at small angles looks like stiffness: 52 N/m below 10 degrees, 25 below 40."""
    small, large = (fit_modulus(table, shear, angle)[1] for angle in (10, 40))
    assert small > 1.7 * large
