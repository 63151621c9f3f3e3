"""The added stresses and moments of the sheet, each against a closed form."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

pytest.importorskip("mujoco", minversion="4.0")

from helpers.mujoco_sheets import SMALL_SHEET, WEIGHTLESS_SHEET, flat_positions, reset_term

from torchcloth.training.validation.independent.flex_sheet import SheetSpec, sheet_mesh
from torchcloth.training.validation.independent.membrane import Membrane, MembraneSpec, orthotropic_stiffness
from torchcloth.training.validation.independent.plate import InelasticBending, PlateBending, PlateSpec


def rolled(spec, curvature, axis=0):
    """Return a cylinder about v (axis 0) or u, with its centre on the side of the normal."""
    uv, _ = sheet_mesh(spec)
    a = uv[:, axis]
    bent = np.stack([np.sin(curvature * a) / curvature, (1 - np.cos(curvature * a)) / curvature], 1)
    out = np.empty((len(uv), 3))
    out[:, axis], out[:, 1 - axis], out[:, 2] = bent[:, 0], uv[:, 1 - axis], bent[:, 1]
    return out


def test_the_orthotropic_membrane_has_the_moduli_asked_for():
    c11, c12, c22 = orthotropic_stiffness(100.0, 0.3, 0.5)
    compliance = np.linalg.inv([[c11, c12], [c12, c22]])
    np.testing.assert_allclose(1 / np.diag(compliance), [100.0, 50.0])
    assert -compliance[0, 1] * 100.0 == pytest.approx(0.3)


@pytest.mark.parametrize(
    ("spec", "strain", "stress"),
    [
        (MembraneSpec(weft=0.5), (0, 0.02, 0), np.diff([100 / (1 - 0.09), 50 / (1 - 0.045)])[0] * 0.02),
        (MembraneSpec(stiffening=10.0), (0, 0.02, 0), 100 * 10 * 0.02**2),
        (MembraneSpec(stiffening=10.0), (0, -0.02, 0), 0.0),
        (MembraneSpec(shear=-0.5), (0, 0, 0.01), -0.5 * 100 / 2.6 * 0.02),
    ],
)
def test_a_uniform_strain_meets_the_stress_of_the_law(spec, strain, stress):
    sheet = replace(WEIGHTLESS_SHEET, membrane_stiffness=100.0)
    eu, ev, euv = strain
    stretch = np.linalg.cholesky(np.eye(2) + 2 * np.array([[eu, euv], [euv, ev]])).T  # F with F'F = 1 + 2 e
    uv, _ = sheet_mesh(sheet)
    x = np.column_stack([uv @ stretch.T, 0 * uv[:, 0]])
    term, _ = reset_term(Membrane(spec), sheet)
    force = term.force(0.0, x, 0 * x)
    pull = np.linalg.solve(stretch, force[uv[:, 1] > 0.2 - 1e-9].sum(0)[:2])  # on the upper edge: - F S n L
    which = 0 if euv else 1
    assert -pull[which] == pytest.approx(stress * 0.2, abs=1e-9)


def uneven(count):
    return tuple(np.interp(np.linspace(0, 1, count), [0, 0.2, 0.8, 1], [0, 0.05, 0.17, 0.2]))


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("lines", [lambda count: (), uneven])
def test_a_cylinder_stores_the_plate_s_energy_along_both_directions(axis, lines):
    sheet = SheetSpec(0.2, 0.2, nodes=(21, 17), lines_u=lines(21), lines_v=lines(17))
    term, _ = reset_term(PlateBending(PlateSpec(stiffness=1e-4, weft=-0.6)), sheet)
    x = rolled(sheet, 5.0, axis)
    energy = 0.5 * (x * (term.matrix @ x)).sum()
    assert energy == pytest.approx(0.5 * 1e-4 * (1, 0.4)[axis] * 25 * 0.04, rel=1e-3)


@pytest.mark.parametrize("lines", [(), uneven(7)])
def test_a_twisted_sheet_stores_the_plate_s_energy(lines):
    sheet = replace(SMALL_SHEET, lines_v=lines)
    term, _ = reset_term(PlateBending(PlateSpec(stiffness=1e-4)), sheet)
    x = flat_positions(sheet)
    x[:, 2] = 2.0 * x[:, 0] * x[:, 1]  # x_uv = 2
    assert 0.5 * (x * (term.matrix @ x)).sum() == pytest.approx(0.5 * 1e-4 * 2 * 4 * 0.04, rel=1e-9)


def test_rest_curvature_is_where_the_sheet_rests_and_turns_over_with_it():
    spec = PlateSpec(stiffness=1e-4, curl=5.0)
    sheet = SheetSpec(0.2, 0.2, nodes=(21, 5))
    for sign, left in ((1, 0.0), (-1, 2.0)):
        x = rolled(sheet, sign * 5.0)
        plate, curl = (
            reset_term(kind(spec), sheet, x)[0].force(0.0, x, 0 * x) for kind in (PlateBending, InelasticBending)
        )
        assert np.linalg.norm(plate + curl) == pytest.approx(
            left * np.linalg.norm(plate), abs=0.03 * np.linalg.norm(plate)
        )


def dissipated_work(term, sheet, shapes, skip):
    """Return the work that a term dissipates along a path of shapes, after the first ``skip``."""
    term, _ = reset_term(term, sheet, shapes[0])
    forces = [term.force(0.0, x, 0 * x) for x in shapes]
    steps = [(0.5 * (f + g) * (y - x)).sum() for (f, g), (x, y) in zip(pairwise(forces), pairwise(shapes), strict=True)]
    return -sum(steps[skip:])


def test_bending_friction_loses_the_loop_of_dahl_s_law():
    sheet, moment, threshold, most = SheetSpec(0.1, 0.1, nodes=(11, 5)), 2e-4, 5.0, 12.0
    bends = most * np.sin(np.linspace(0.5, 4.5, 801) * np.pi) + 1e-9
    shapes = [rolled(sheet, k) for k in bends]
    dissipated = dissipated_work(
        InelasticBending(PlateSpec(friction=moment)), sheet, shapes, 400
    )  # the second cycle is steady
    assert dissipated == pytest.approx(4 * moment * (most - threshold * np.tanh(most / threshold)) * 0.01, rel=0.02)


def test_shear_friction_loses_the_loop_of_dahl_s_law():
    sheet, full, threshold, most = SheetSpec(0.1, 0.1, nodes=(3, 3)), 2.0, 0.01, 0.04
    path = most * np.sin(np.linspace(0.5, 4.5, 801) * np.pi)
    uv, _ = sheet_mesh(sheet)
    shapes = [np.column_stack([uv[:, 0] + g * uv[:, 1], uv[:, 1], 0 * uv[:, 0]]) for g in path]
    dissipated = dissipated_work(Membrane(MembraneSpec(friction=full)), sheet, shapes, 400)
    assert dissipated == pytest.approx(2 * full * (most - threshold * np.tanh(most / threshold)) * 0.01, rel=0.02)


def test_a_crease_grows_to_what_exceeds_the_yield():
    sheet = SheetSpec(0.1, 0.1, nodes=(11, 3))
    term, _ = reset_term(InelasticBending(PlateSpec(stiffness=1e-4, crease=20.0, crease_yield=8.0)), sheet, dt=1e-3)
    x = rolled(sheet, 20.0)
    for _ in range(50):
        term.force(0.0, x, 0 * x)
    grown = term.crease[term.stencils.kind == 0]
    np.testing.assert_allclose(grown, (20.0 - 8.0) * (1 - np.exp(-1.0)), rtol=0.02)
    assert np.abs(term.crease[term.stencils.kind > 0]).max() < 1e-9
