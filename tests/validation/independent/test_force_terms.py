"""The added forces and masses, each against a closed form or a symmetry."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("mujoco", minversion="4.0")

from helpers.mujoco_sheets import (
    SMALL_SHEET,
    WEIGHTLESS_SHEET,
    crumpled_state,
    flat_positions,
    reset_term,
    run,
    top_grip,
    vertical_positions,
)

from torchcloth._utils.constants import STANDARD_AIR_DENSITY_KG_PER_M3, STANDARD_GRAVITY_M_PER_S2
from torchcloth.training.validation.independent.air import AddedMass, AirSpec, LinearDrag, QuadraticDrag
from torchcloth.training.validation.independent.flex_sheet import SheetSpec, StillAir, sheet_mesh
from torchcloth.training.validation.independent.mass_distribution import MassDistribution, MassSpec
from torchcloth.training.validation.independent.membrane import Membrane, MembraneSpec
from torchcloth.training.validation.independent.mujoco_cloth import MujocoCloth, Slip
from torchcloth.training.validation.independent.plate import InelasticBending, PlateBending, PlateSpec
from torchcloth.training.validation.independent.table_contact import TableContact, TableSpec

NEUTRAL = [
    MassDistribution(MassSpec()),
    PlateBending(PlateSpec()),
    InelasticBending(PlateSpec()),
    Membrane(MembraneSpec()),
    QuadraticDrag(AirSpec()),
    LinearDrag(0.0),
    AddedMass(0.0, STANDARD_AIR_DENSITY_KG_PER_M3),
    TableContact(replace(TableSpec(), friction=0.0)),
]


@pytest.mark.parametrize("term", NEUTRAL, ids=lambda term: type(term).__name__)
def test_amplitude_zero_is_neutral_bit_by_bit(term):
    x, v = crumpled_state(SMALL_SHEET)
    x[:, 2] += 1.0  # clear of the table
    with_it, without = (run(SMALL_SHEET, terms, 0.02, x, 0.1 * v)[0] for terms in ([term], []))
    np.testing.assert_array_equal(with_it.x, without.x)


INTERNAL = {
    "plate": PlateBending(PlateSpec(stiffness=1e-4, weft=-0.5, damping_time=0.02, layer=2.0)),
    "curl": InelasticBending(PlateSpec(stiffness=1e-4, curl=3.0, curl_weft=1.0)),
    "bending friction": InelasticBending(PlateSpec(friction=3e-4)),
    "membrane": Membrane(MembraneSpec(weft=0.5, shear=-0.3, stiffening=10.0, viscosity=5e-3, friction=1.0)),
}


@pytest.mark.parametrize("name", INTERNAL)
def test_internal_forces_add_up_to_nothing(name):
    x, v = crumpled_state(SMALL_SHEET)
    term, _ = reset_term(INTERNAL[name], x=x)
    y = x + 1e-3 * crumpled_state(SMALL_SHEET, 1)[1]
    force = term.force(0.0, y, v)
    size = np.abs(force).max()
    assert size > 1e-6
    np.testing.assert_allclose(force.sum(0), 0, atol=1e-10 * size * len(x))
    if name == "membrane":  # the others' moment along a fixed normal is only nearly balanced
        np.testing.assert_allclose(np.cross(y, force).sum(0), 0, atol=1e-9 * size)


DISSIPATIVE = {
    "drag": QuadraticDrag(AirSpec(normal=1.2, tangential=0.5)),
    "linear": LinearDrag(2.0),
    "viscous membrane": Membrane(MembraneSpec(viscosity=5e-3)),
    "viscous plate": PlateBending(PlateSpec(stiffness=1e-4, damping_time=0.02)),
}


@pytest.mark.parametrize("name", DISSIPATIVE)
def test_dissipation_takes_power_whatever_the_motion(name):
    for seed in range(5):
        x, v = crumpled_state(SMALL_SHEET, seed)
        term, _ = reset_term(DISSIPATIVE[name])
        power = ((term.force(0.0, x, v) - term.force(0.0, x, 0 * v)) * v).sum()
        power -= 0.0 if term.damping_matrix is None else (v * (term.damping_matrix @ v)).sum()
        assert power < 0


@pytest.mark.slow
def test_implicit_damping_is_the_explicit_one_of_short_steps():
    """A strip that swings from a gripper that starts to move, and bends: positions, and the force on the gripper."""
    spec, plate = SheetSpec(0.04, 0.2, nodes=(3, 11)), PlateSpec(stiffness=1e-4, damping_time=0.02)
    x0, t = vertical_positions(spec), np.linspace(0.0, 0.3, 31)
    pose = np.tile(np.eye(4), (31, 1, 1))
    pose[:, 0, 3] = 0.05 * (1 - np.cos(10 * t))
    grips = {name: replace(grip, t=t, pose=pose) for name, grip in top_grip(spec, x0).items()}
    results = []
    for implicit in (True, False):
        cloth = MujocoCloth(spec, 2e-5, [PlateBending(plate)])
        cloth.has_implicit_damping &= implicit
        results.append(cloth.run(x0, t, grips))
        assert (cloth.force_terms[0].damping_matrix is not None) == implicit
    first, second = results
    moved = np.abs(second.x - x0).max()
    np.testing.assert_allclose(first.x, second.x, atol=1e-3 * moved)
    for name, force in second.force.items():
        np.testing.assert_allclose(first.force[name], force, atol=2e-3 * np.abs(force).max())
        np.testing.assert_allclose(
            first.torque[name], second.torque[name], atol=2e-3 * np.abs(second.torque[name]).max()
        )
    undamped = MujocoCloth(spec, 2e-5, [PlateBending(replace(plate, damping_time=0.0))]).run(x0, t, grips)
    assert np.abs(undamped.x - second.x).max() > 0.02 * moved, "damping matters here"


def test_drag_is_that_of_the_example():
    x, v = crumpled_state(SMALL_SHEET)
    term, cloth = reset_term(QuadraticDrag(AirSpec(normal=1.2)))
    expected = StillAir(replace(SMALL_SHEET, drag_normal=1.2), cloth.faces, len(x)).force(x, v)
    np.testing.assert_allclose(term.force(0.0, x, v), expected, atol=1e-12 * np.abs(expected).max())


def test_tangential_drag_slows_as_one_over_time():
    v0 = np.tile([1.5, 0.0, 0.0], (49, 1))
    result, cloth = run(WEIGHTLESS_SHEET, [QuadraticDrag(AirSpec(tangential=3.0))], 0.21, v0=v0)
    rate = 0.5 * STANDARD_AIR_DENSITY_KG_PER_M3 * 3.0 / 0.20
    mean = result.v[-1][:, 0] @ cloth.mass / cloth.mass.sum()
    assert mean == pytest.approx(1.5 / (1 + 1.5 * rate * 0.21), rel=2e-3)


def test_linear_drag_decays_exponentially():
    v0 = np.tile([0.3, 0.2, 1.0], (49, 1))
    result, _ = run(WEIGHTLESS_SHEET, [LinearDrag(2.0)], 0.3, v0=v0)
    np.testing.assert_allclose(result.v[-1], v0 * np.exp(-0.6), rtol=1e-3)


def test_added_mass_slows_the_fall_of_a_flat_sheet_and_not_of_an_upright_one():
    air = STANDARD_AIR_DENSITY_KG_PER_M3 * 0.15
    flat, _ = run(SMALL_SHEET, [AddedMass(0.15, STANDARD_AIR_DENSITY_KG_PER_M3)], 0.099)
    assert flat.v[-1][:, 2].mean() == pytest.approx(-STANDARD_GRAVITY_M_PER_S2 * 0.099 * 0.20 / (0.20 + air), rel=1e-3)
    upright, _ = run(
        SMALL_SHEET, [AddedMass(0.15, STANDARD_AIR_DENSITY_KG_PER_M3)], 0.099, vertical_positions(SMALL_SHEET)
    )
    assert upright.v[-1][:, 2].mean() == pytest.approx(-STANDARD_GRAVITY_M_PER_S2 * 0.099, rel=1e-6)


def test_added_mass_takes_the_energy_that_turning_normals_give():
    """Its power is minus what the turn of the normals alone adds to 1/2 m_air (n . v)^2, with constant areas."""
    x, v = crumpled_state(WEIGHTLESS_SHEET)
    term, _ = reset_term(AddedMass(0.1, STANDARD_AIR_DENSITY_KG_PER_M3), WEIGHTLESS_SHEET, x)
    step = 1e-6
    (n, area), (after, _), (before, _) = (term.vertex_normals(y) for y in (x, x + step * v, x - step * v))
    speed, change = (np.einsum("vc,vc->v", m, v) for m in (n, (after - before) / (2 * step)))
    power = np.einsum("vc,vc->v", term.force(0.0, x, v), v)
    np.testing.assert_allclose(
        power, -STANDARD_AIR_DENSITY_KG_PER_M3 * 0.1 * area * speed * change, atol=1e-6 * np.abs(power).max()
    )
    assert np.abs(power).max() > 1e-4


def leaning_angle(terms):
    """Angle of a strip that hangs at rest, from its first to its last row."""
    spec = SheetSpec(0.04, 0.2, nodes=(3, 11))
    x0 = vertical_positions(spec)
    result, _ = run(spec, terms, 1.2, x0, grips=top_grip(spec, x0), damping_rate=12.0)
    x = result.x[-1].reshape(11, 3, 3).mean(1)
    return np.arctan2(x[0, 0] - x[-1, 0], x[-1, 2] - x[0, 2])


def test_wind_leans_a_hanging_strip_to_where_pressure_and_weight_balance():
    pressure = 0.5 * STANDARD_AIR_DENSITY_KG_PER_M3 * 1.2 * 1.0**2 / (0.20 * STANDARD_GRAVITY_M_PER_S2)
    sine = (np.sqrt(1 + 4 * pressure**2) - 1) / (2 * pressure)  # sin = p cos^2: only the normal wind presses
    assert leaning_angle([QuadraticDrag(AirSpec(normal=1.2, wind=1.0))]) == pytest.approx(np.arcsin(sine), rel=0.01)


def test_gravity_leans_by_its_tilt():
    assert leaning_angle([MassDistribution(MassSpec(tilt=0.05))]) == pytest.approx(0.05, rel=0.01)


def test_a_jet_is_felt_in_its_place_only():
    term, _ = reset_term(QuadraticDrag(AirSpec(normal=1.2, jet=1.0, jet_width=0.05, jet_across=0.1, jet_height=0.3)))
    wind = term.wind_velocity(np.array([[0.7, 0.1, 0.3], [0.7, 0.1, 0.35], [0.7, 0.5, 0.3]]))
    np.testing.assert_allclose(wind[:, 0], [1.0, np.exp(-0.5), 0.0], atol=1e-6)


@pytest.mark.parametrize(
    ("spec", "grams"),
    [
        (MassSpec(density=0.1), 8.8),
        (MassSpec(hem=0.02), 8 + 16.0),
        (MassSpec(seam=0.02), 8 + 4.0),
        (MassSpec(layer=1.0), 8 * (1 + 9 / 36)),  # 3 x 3 vertices, each of a 36th
    ],
)
def test_a_gripper_weighs_the_cloth(spec, grams):
    x0 = vertical_positions(SMALL_SHEET)
    result, cloth = run(
        SMALL_SHEET, [MassDistribution(spec)], 0.6, x0, grips=top_grip(SMALL_SHEET, x0), damping_rate=30.0
    )
    assert cloth.mass.sum() == pytest.approx(1e-3 * grams, rel=0.01)
    assert -result.force["top"][-1][2] == pytest.approx(cloth.mass.sum() * STANDARD_GRAVITY_M_PER_S2, rel=6e-3)


def test_moisture_falls_like_everything_else_and_weighs_more():
    drift = MassDistribution(MassSpec(moisture=0.5))
    fall, _ = run(SMALL_SHEET, [drift], 0.21)
    assert fall.v[-1][:, 2].mean() == pytest.approx(-STANDARD_GRAVITY_M_PER_S2 * 0.21, rel=1e-6)
    x0 = vertical_positions(SMALL_SHEET)
    hung, cloth = run(SMALL_SHEET, [drift], 0.8, x0, grips=top_grip(SMALL_SHEET, x0), damping_rate=30.0)
    assert cloth.mass.sum() == pytest.approx(8e-3 * 1.4, rel=1e-3)
    assert -hung.force["top"][-1][2] == pytest.approx(
        8e-3 * 1.2 * STANDARD_GRAVITY_M_PER_S2, rel=0.02
    )  # the mean over the run


def test_a_grip_slips_at_the_speed_of_the_excess_pull():
    x0 = vertical_positions(SMALL_SHEET)
    settled, _ = run(SMALL_SHEET, [], 0.5, x0, grips=top_grip(SMALL_SHEET, x0), damping_rate=30.0)
    slip = Slip(mobility=0.4, threshold=0.03)
    result, cloth = run(
        SMALL_SHEET, [], 0.5, settled.x[-1], grips=top_grip(SMALL_SHEET, x0, slip), frames=6, damping_rate=5.0
    )
    is_held = sheet_mesh(SMALL_SHEET)[0][:, 1] > 0.2 - 1e-9
    speed = -(result.x[-1] - result.x[-2])[is_held, 2].mean() / 0.1
    assert speed == pytest.approx(0.4 * (cloth.mass.sum() * STANDARD_GRAVITY_M_PER_S2 - 0.03), rel=0.03)
    firm, _ = run(
        SMALL_SHEET, [], 0.2, settled.x[-1], grips=top_grip(SMALL_SHEET, x0, Slip(0.4, threshold=0.2)), damping_rate=5.0
    )
    np.testing.assert_array_equal(firm.x[-1][is_held], settled.x[-1][is_held])


@pytest.mark.parametrize(("slope", "slides"), [(0.3, False), (0.5, True)])
def test_a_sheet_on_a_slope_slides_beyond_the_angle_of_friction(slope, slides):
    weight, table = MassDistribution(MassSpec(tilt=slope)), TableContact(TableSpec(friction=0.4))
    result, cloth = run(SMALL_SHEET, [weight, table], 0.3, frames=4)
    speed = result.v[:, :, 0] @ cloth.mass / cloth.mass.sum()
    pull = STANDARD_GRAVITY_M_PER_S2 * (np.sin(slope) - 0.4 * np.cos(slope))
    if slides:
        assert (speed[-1] - speed[-2]) / 0.1 == pytest.approx(pull, rel=0.02)
    else:
        assert abs(speed[-1]) < 1e-3
    assert np.abs(result.x[-1][:, 2]).max() < 1e-4


def test_friction_differs_by_direction_and_falls_with_speed():
    term, _ = reset_term(TableContact(TableSpec(friction=0.4, anisotropy=-0.5, static_excess=0.3, speed=0.01)))
    directions = np.array([[1.0, 0], [0, 1.0], [1.0, 0]])
    np.testing.assert_allclose(term._coefficient(directions, np.array([1.0, 1.0, 0.0])), [0.2, 0.4, 0.35])


def test_adhesion_pulls_within_its_gap():
    term, _ = reset_term(TableContact(TableSpec(adhesion=2.0, gap=1e-3)))
    for height, pull in ((5e-4, 2.0 * 0.04), (2e-3, 0.0)):
        x = flat_positions(SMALL_SHEET) + np.array([0, 0, height])
        assert -term.force(0.0, x, 0 * x)[:, 2].sum() == pytest.approx(pull)
