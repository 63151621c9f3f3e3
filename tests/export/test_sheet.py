"""A cloth as an isotropic sheet, and what is lost on the way."""

import numpy as np
import pytest
import torch
from helpers.small_sheet import make_sheet

import torchcloth as tc
from torchcloth import effects
from torchcloth.errors import InvalidInput
from torchcloth.export import describe_sheet


def test_moduli_are_those_of_the_material():
    sheet = describe_sheet(make_sheet(Y=80.0))
    assert sheet.membrane_stiffness == pytest.approx(80.0, rel=1e-6)
    assert sheet.poisson_ratio == pytest.approx(0.3, rel=1e-6)
    assert sheet.mass.sum() == pytest.approx(0.2 * 0.2 * 0.2)
    assert sheet.notes == ()


def test_everything_with_a_counterpart_is_read():
    cloth = make_sheet(
        effects={
            "gravity": effects.Gravity(),
            "bending": effects.Bending(2e-5, 0.03),
            "damping": effects.KelvinVoigt(0.7),
            "air": effects.AirDrag(1.1, density=1.3, tangential=0.02, wind=(0.1, 0.2, 0.3)),
            "mass": effects.MassDamping(0.4),
        },
        boundaries={"left": tc.boundaries.Grasp.corner("upper-left", 0.01)},
    )
    sheet = describe_sheet(cloth)
    np.testing.assert_allclose(sheet.gravity, [0, 0, -9.81])
    np.testing.assert_allclose(sheet.wind, [0.1, 0.2, 0.3], rtol=1e-6)
    assert (sheet.bending, sheet.bending_damping, sheet.viscosity) == pytest.approx((2e-5, 0.03, 0.7))
    assert (sheet.drag_normal, sheet.drag_tangential, sheet.air_density) == pytest.approx((1.1, 0.02, 1.3))
    assert sheet.damping_rate == pytest.approx(0.4)
    assert list(sheet.grasps) == ["left"]
    assert len(sheet.grasps["left"]) == 1
    assert sheet.notes == ()


def test_a_hem_is_in_the_masses():
    sheet = describe_sheet(make_sheet(effects={"hem": effects.LineMass(0.01)}))
    assert sheet.mass.sum() > 0.2 * 0.04 + 1e-4
    assert sheet.notes == ()


def test_a_shrunk_sheet_is_exported_shrunk():
    sheet = describe_sheet(make_sheet(effects={"rest": effects.RestShape(0.05, 0.0, 0.0)}))
    assert np.ptp(sheet.rest[:, 0]) == pytest.approx(0.95 * 0.2)
    assert np.ptp(sheet.rest[:, 1]) == pytest.approx(0.2)


def test_a_woven_membrane_is_averaged_and_said():
    mesh = tc.meshes.rectangle(0.2, 0.2, resolution=(4, 4))
    woven = tc.materials.OrthotropicAEP(1e5, 5e4, 3e4)
    sheet = describe_sheet(tc.Cloth(mesh, woven, 0.2, contact=None))
    assert 50.0 < sheet.membrane_stiffness < 100.0
    assert any("woven" in note for note in sheet.notes)


def test_what_no_engine_has_is_said():
    cloth = make_sheet(effects={"stick": effects.BendingFriction(), "b": effects.Bending(1e-5, curl_warp=2.0)})
    notes = " ".join(describe_sheet(cloth).notes)
    assert "BendingFriction" in notes
    assert "curl" in notes


def test_fields_become_their_mean():
    mesh = tc.meshes.rectangle(0.2, 0.2, resolution=(4, 4))
    youngs = torch.linspace(5e4, 1.5e5, len(mesh.faces))
    sheet = describe_sheet(tc.Cloth(mesh, tc.materials.AEP(youngs, 0.3), 0.2, contact=None))
    assert sheet.membrane_stiffness == pytest.approx(100.0, rel=1e-4)
    assert any("differs between triangles" in note for note in sheet.notes)


def test_vertices_of_another_mesh_are_refused():
    with pytest.raises(InvalidInput, match="initial vertices"):
        describe_sheet(make_sheet(), np.zeros((3, 3)))
