"""The numbers of each target against closed forms, in the target's own formulas or in the target itself."""

import json
import math
import re

import numpy as np
import pytest
from helpers.small_sheet import make_sheet

from torchcloth import boundaries, effects
from torchcloth.errors import InvalidInput
from torchcloth.export import describe_sheet, export_cloth
from torchcloth.export.hinges import find_hinges
from torchcloth.export.newton import cloth_arguments
from torchcloth.export.usd import physx_elasticity

mujoco = pytest.importorskip("mujoco")
STIFFNESS_N_PER_M, POISSON, BENDING_N_M, DRAG, AIR_KG_PER_M3 = 100.0, 0.3, 4e-5, 1.2, 1.25


@pytest.fixture(scope="module")
def cloth():
    return make_sheet(
        9,
        Y=STIFFNESS_N_PER_M,
        effects={
            "gravity": effects.Gravity(),
            "bending": effects.Bending(BENDING_N_M, 0.01),
            "air": effects.AirDrag(DRAG, density=AIR_KG_PER_M3),
        },
        boundaries={"left": boundaries.Grasp.corner("upper-left", 0.01)},
    )


@pytest.fixture(scope="module")
def sheet(cloth):
    return describe_sheet(cloth)


@pytest.fixture
def model(cloth):
    return mujoco.MjModel.from_xml_string(export_cloth(cloth, "mujoco").text)


def passive_forces(model, displacement=None, velocity=None):
    """Forces [V, 3] N of springs and dampers, and of the air."""
    data = mujoco.MjData(model)
    if displacement is not None:
        data.qpos[:] = displacement.ravel()
    if velocity is not None:
        data.qvel[:] = velocity.ravel()
    mujoco.mj_forward(model, data)
    return data.qfrc_spring.reshape(-1, 3) + data.qfrc_damper.reshape(-1, 3), data.qfrc_fluid.reshape(-1, 3).copy()


def test_mujoco_pulls_a_strip_with_membrane_stiffness_times_strain(model, sheet):
    strain, x = 1e-5, sheet.rest
    force, _ = passive_forces(model, np.column_stack([strain * x[:, 0], -POISSON * strain * x[:, 1], 0 * x[:, 0]]))
    right = x[:, 0] > 0.2 - 1e-9
    assert -force[right, 0].sum() == pytest.approx(STIFFNESS_N_PER_M * strain * 0.2, rel=1e-4)
    top = x[:, 1] > 0.2 - 1e-9
    assert abs(force[top, 1].sum()) < 1e-4 * STIFFNESS_N_PER_M * strain * 0.2


def test_mujoco_bends_to_a_cylinder_with_the_energy_of_the_plate(model, sheet):
    """The mean over all directions is right, and each direction is what the file says."""
    curvature, hinges, x = 1e-3, find_hinges(sheet.rest, sheet.faces), sheet.rest
    energies = []
    for angle in np.pi * np.arange(24) / 24:
        z = 0.5 * curvature * (x[:, 0] * math.cos(angle) + x[:, 1] * math.sin(angle)) ** 2
        force, _ = passive_forces(model, np.column_stack([0 * z, 0 * z, z]))
        energies.append(-0.5 * force[:, 2] @ z)
    plate = 0.5 * BENDING_N_M * curvature**2 * hinges.area.sum() / 3
    assert np.mean(energies) == pytest.approx(plate, rel=1e-3)


def test_mujoco_has_the_drag_of_a_plate(model, sheet):
    velocity = np.tile([0.0, 0.0, 2.0], (len(sheet.rest), 1))
    _, air = passive_forces(model, velocity=velocity)
    assert -air[:, 2].sum() == pytest.approx(0.5 * AIR_KG_PER_M3 * DRAG * 0.04 * 4.0, rel=1e-6)


def test_mujoco_has_masses_grasps_and_the_first_frame(model, sheet):
    np.testing.assert_allclose(model.body_mass[1:], sheet.mass, rtol=1e-7)
    np.testing.assert_allclose(model.key_qpos[0].reshape(-1, 3) + sheet.rest, sheet.initial, atol=1e-7)
    assert model.numeric_size[mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, "grasp_left")] == 1


def test_mujoco_stays_at_rest_and_is_stable(model):
    model.opt.gravity[:] = 0.0
    data = mujoco.MjData(model)
    data.qpos[:] = 1e-6 * np.random.default_rng(0).standard_normal(model.nq)
    for _ in range(400):
        mujoco.mj_step(model, data)
    assert np.abs(data.qpos).max() < 1e-5


def neo_hookean_tangent(ke, ka):
    """lam and mu of tri_ke/2 |F|^2 + ka/2 (J - 1 - ke/ka)^2 at rest, by differences of its energy."""

    def energy(a, b, shear=0.0):
        return 0.5 * ke * (a * a + b * b + 2 * shear**2) + 0.5 * ka * (a * b - shear**2 - 1 - ke / ka) ** 2

    h, rest = 1e-4, energy(1, 1)
    c11 = (energy(1 + h, 1) + energy(1 - h, 1) - 2 * rest) / h**2
    c66 = (2 * energy(1, 1, h / 2) - 2 * rest) / h**2  # engineering shear h
    return c11 - 2 * c66, c66


@pytest.mark.parametrize(("solver", "added"), [("SolverSemiImplicit", 0.0), ("SolverVBD", 1.0)])
def test_newtons_membrane_is_as_stiff_at_rest(sheet, solver, added):
    a = cloth_arguments(sheet, find_hinges(sheet.rest, sheet.faces), solver)
    lam, mu = neo_hookean_tangent(a["tri_ke"], a["tri_ka"] + added * a["tri_ke"])
    assert (lam, mu) == pytest.approx((sheet.lam, sheet.mu), rel=1e-5)


@pytest.mark.parametrize("solver", ["SolverSemiImplicit", "SolverVBD"])
def test_newtons_hinges_have_the_energy_of_the_plate(sheet, solver):
    hinges = find_hinges(sheet.rest, sheet.faces)
    weight = hinges.length if solver == "SolverVBD" else hinges.length * hinges.area
    rigidity = hinges.rigidity(cloth_arguments(sheet, hinges, solver)["edge_ke"] * weight)
    assert rigidity.mean() == pytest.approx(BENDING_N_M)


def test_newtons_drag_of_three_corners_is_that_of_a_plate(sheet):
    a = cloth_arguments(sheet, find_hinges(sheet.rest, sheet.faces), "SolverSemiImplicit")
    assert 3 * a["tri_drag"] * 0.04 * 4.0 == pytest.approx(0.5 * AIR_KG_PER_M3 * DRAG * 0.04 * 4.0)


def test_newtons_file_is_json_with_what_add_cloth_mesh_takes(cloth, sheet, tmp_path):
    export_cloth(cloth, "newton", tmp_path / "cloth.json")
    content = json.loads((tmp_path / "cloth.json").read_text())
    assert len(content["indices"]) == 3 * len(sheet.faces)
    assert sum(content["particle_mass"]) == pytest.approx(0.2 * 0.04)
    assert content["not_expressed"]
    assert content["grasps"]["left"] == sheet.grasps["left"].tolist()


def test_newton_itself_pulls_and_bends_as_the_plate(cloth, sheet):
    pytest.importorskip("newton")
    from torchcloth.training.validation.export.newton_replay import semi_implicit_forces

    text, strain, x = export_cloth(cloth, "newton").text, 1e-3, sheet.rest
    stretched = np.column_stack([(1 + strain) * x[:, 0], (1 - POISSON * strain) * x[:, 1], 0 * x[:, 0]])
    right = x[:, 0] > 0.2 - 1e-9
    pull = -semi_implicit_forces(text, stretched)[right, 0].sum()
    assert pull == pytest.approx(STIFFNESS_N_PER_M * strain * 0.2, rel=0.01)
    curvature, hinges, energies = 0.3, find_hinges(sheet.rest, sheet.faces), []
    for angle in np.pi * np.arange(24) / 24:
        along = x[:, 0] * math.cos(angle) + x[:, 1] * math.sin(angle)
        force = semi_implicit_forces(text, np.column_stack([x[:, :2], 0.5 * curvature * along**2]), membrane=False)
        energies.append(-0.25 * curvature * force[:, 2] @ along**2)
    plate = 0.5 * BENDING_N_M * curvature**2 * hinges.area.sum() / 3
    assert np.mean(energies) == pytest.approx(plate, rel=0.01)


def test_physx_has_the_membrane_of_plane_stress(sheet):
    """Its Lame parameters are those of three dimensions."""
    youngs, nu = physx_elasticity(sheet)
    h = sheet.thickness
    assert youngs * nu / ((1 + nu) * (1 - 2 * nu)) * h == pytest.approx(sheet.lam)
    assert youngs / (2 * (1 + nu)) * h == pytest.approx(sheet.mu)
    assert nu == pytest.approx(POISSON / (1 + POISSON))
    assert youngs * h == pytest.approx(STIFFNESS_N_PER_M * (1 + 2 * POISSON) / (1 + POISSON) ** 2)


def test_usd_is_balanced_and_complete(cloth, sheet):
    text = export_cloth(cloth, "usd").text
    bare = re.sub(r'"(\\.|[^"\\])*"', '""', text)
    for opening, closing in ("()", "[]", "{}"):
        assert bare.count(opening) == bare.count(closing)
    counts = re.search(r"faceVertexCounts = \[(.*?)\]", text)
    assert counts is not None
    assert counts[1].split(", ") == ["3"] * len(sheet.faces)
    points = re.search(r"point3f\[\] points = \[(.*?)\]", text)
    assert points is not None
    assert points[1].count("(") == len(sheet.rest)


def test_usd_is_read_by_usd(cloth, sheet, tmp_path):
    usd = pytest.importorskip("pxr.Usd")
    export_cloth(cloth, "usd", tmp_path / "cloth.usda")
    stage = usd.Stage.Open(str(tmp_path / "cloth.usda"))
    mesh = stage.GetPrimAtPath("/World/cloth")
    assert len(mesh.GetAttribute("physics:restShapePoints").Get()) == len(sheet.rest)
    assert stage.GetPrimAtPath("/World/fabric").GetAttribute("physics:youngsModulus").Get() == pytest.approx(1e5)


def test_an_unknown_target_and_a_wrong_suffix_are_refused(cloth, tmp_path):
    with pytest.raises(InvalidInput, match="mujoco or newton or usd"):
        export_cloth(cloth, "bullet")
    with pytest.raises(InvalidInput, match=r"ends in \.xml"):
        export_cloth(cloth, "mujoco", tmp_path / "cloth.json")
    assert not list(tmp_path.iterdir())


def test_without_bending_and_air_files_are_complete():
    bare = make_sheet()
    assert mujoco.MjModel.from_xml_string(export_cloth(bare, "mujoco").text).nv == 3 * 16
    arguments = json.loads(export_cloth(bare, "newton").text)["arguments"]["SolverVBD"]
    assert arguments["edge_ke"] == arguments["tri_drag"] == 0.0
    assert "surfaceBendStiffness = 0" in export_cloth(bare, "usd").text
