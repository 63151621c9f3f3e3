"""Measured tension of one nylon fabric, cut at 0, 30, 45 and 90 degrees to the warp, against the orthotropic law.

The specimen is simulated: one of its 12 strips of 2.25 x 97 mm, clamped at both ends, pattern turned by the angle,
pulled to equilibrium. The machine's preload at zero displacement is where the simulated curve begins, not a fit.
Four numbers are fitted to the four curves: E_warp h, E_weft h, G h and the warp's stiffening; `fit_tension` finds the
same without a mesh. Poisson's ratio is not
(0.01; the data's authors found -0.004). No isotropic law comes near: at 2 mm the forces differ by a factor of 5.7.
"""

import numpy as np
import pytest
import torch
from helpers.tension_strips import Strip

from torchcloth.identification import fit_tension
from torchcloth.identification.tension.fit import table_errors
from torchcloth.identification.tension.specimens import Uniaxial
from torchcloth.materials import OrthotropicAEP
from torchcloth.recordings import read_tension, write_tension
from torchcloth.training.validation.realdata.nylon import LENGTH, NAMES, STRIPS, WIDTH, H, start, tables

pytestmark = pytest.mark.realdata

FITTED = {"youngs_modulus": 15.21e6, "weft_modulus": 59.01e6, "shear_modulus": 2.908e6, "warp_stiffening": 21.8}
MARK = 5.0  # % of the curve's largest force


@pytest.fixture
def readings(measured_in):
    """Angle in degrees -> table."""
    return tables(measured_in("nylon_offaxis_tension"))


@pytest.fixture
def measured(readings):
    """Angle -> displacement [m] and force [N]."""
    return {angle: (table.displacement, table.force) for angle, table in readings.items()}


class Machine:
    """The four specimens of one material."""

    def __init__(self, measured, resolution=(41, 5)):
        self.measured = measured
        self.material = OrthotropicAEP(**{**FITTED, "poisson_ratio": 0.01, "thickness": H})
        self.strips = {
            angle: Strip(LENGTH, WIDTH, angle, self.material, resolution, clamped=True, crowded=0.9)
            for angle in measured
        }

    def errors(self, parameters):
        """Angle -> (simulated - measured force) in % of the largest measured, at each measured displacement."""
        from scipy.interpolate import CubicSpline

        for name, value in parameters.items():
            getattr(self.material, name).set(float(value))
        out = {}
        for angle, (u, force) in self.measured.items():
            knots = np.linspace(0.0, u[-1] + 0.25e-3, 8)
            pull, _ = self.strips[angle].pull(torch.as_tensor(knots[1:]))
            curve = CubicSpline(knots, np.append(0.0, STRIPS * pull.numpy()))
            fine = np.linspace(0.0, 0.5e-3, 2001)
            preload = np.interp(force[0], curve(fine), fine)
            out[angle] = 100 * (curve(u + preload) - force) / force.max()
        return out


def show(errors):
    """Printed with -s, and in the message of a failure."""
    rows = [f"{a:3d} deg: max {abs(e).max():.2f} %, RMS {(e**2).mean() ** 0.5:.2f} %" for a, e in errors.items()]
    print("\n" + "\n".join(rows))
    return "; ".join(rows)


def worst(errors):
    return max(float(abs(e).max()) for e in errors.values())


def fit(machine, start):
    """Least fourth powers through the simulation, since the mark is on the largest error; curves count the same."""
    from scipy.optimize import least_squares

    names, scale = list(start), np.array(list(start.values()))

    def residual(relative):
        errors = machine.errors(dict(zip(names, scale * relative, strict=True)))
        return np.concatenate([e * abs(e) / len(e) ** 0.5 for e in errors.values()])

    found = least_squares(residual, np.ones(len(names)), bounds=(0.05, 20.0), diff_step=1e-3, ftol=1e-4, xtol=1e-4)
    return dict(zip(names, scale * found.x, strict=True))


def test_fitted_law_reproduces_the_four_curves(measured):
    errors = Machine(measured).errors(FITTED)
    assert worst(errors) < MARK, show(errors)
    show(errors)


def test_result_does_not_hang_on_the_mesh(measured):
    some = {angle: measured[angle] for angle in (30, 45)}
    coarse, fine = (Machine(some, resolution).errors(FITTED) for resolution in ((41, 5), (61, 7)))
    for angle in some:
        assert abs(coarse[angle] - fine[angle]).max() < 0.3, "percent of the largest force"


@pytest.mark.slow
def test_fit_from_elsewhere_finds_the_same_four_numbers(measured):
    start = {"youngs_modulus": 25e6, "weft_modulus": 47e6, "shear_modulus": 4e6, "warp_stiffening": 5.0}
    machine = Machine(measured)
    found = fit(machine, start)
    assert found == pytest.approx(FITTED, rel=0.03)
    assert worst(machine.errors(found)) < MARK


@pytest.mark.slow
def test_without_stiffening_the_warp_is_missed(measured):
    machine = Machine(measured)
    machine.material.warp_stiffening.set(0.0)
    found = fit(machine, {"youngs_modulus": 25e6, "weft_modulus": 58e6, "shear_modulus": 3e6})
    errors = machine.errors(found)
    assert worst(errors) > MARK, show(errors)


def test_readings_through_the_disk(readings, tmp_path):
    for angle, table in readings.items():
        back = read_tension(write_tension(table, tmp_path / str(angle)))
        assert np.array_equal(back.force, table.force)
        assert back.angle == pytest.approx(np.radians(angle))


def test_fit_tension_finds_the_same_four_numbers(readings):
    """Within two standard errors of the fit through meshes, which is of fourth powers and within 5 %.

    Squares, and the prior of a stiffening of which few independent readings tell, leave 5.2 %.
    """
    fit = fit_tension(start(), list(readings.values()), NAMES)
    for name, value in FITTED.items():
        estimate = fit.parameters[name]
        assert abs(estimate.value - value) < 2 * estimate.std, name
        assert estimate.identifiable or name == "warp_stiffening"
    assert max(e["force_max_after"] for e in fit.errors) < 1.1 * MARK / 100
    assert any("warp_stiffening and youngs_modulus are confounded" in w for w in fit.warnings)


def test_a_direction_that_was_not_fitted_is_predicted(readings):
    """30 degrees from 0, 45 and 90: off by 10 % of its largest force (45 from the others: 11 %, 0 from them: 38 %)."""
    fit = fit_tension(start(), [readings[a].select_rows(slice(None, None, 4)) for a in (0, 45, 90)], NAMES)
    found = start()
    for name, path in fit.keys.items():
        found.get_submodule(path).set(fit.parameters[name].value)
    assert table_errors(readings[30], Uniaxial().curve(found.material, readings[30]))["force_max"] < 0.12
