"""Published fabrics: all there, nothing invented, and clear words where a number is missing."""

import math

import pytest
import torch

import torchcloth as tc
from torchcloth.errors import InvalidInput
from torchcloth.materials import AEP, OrthotropicAEP, presets

# E, nu, k, gamma as the paper prints them
PAPER = {
    "cotton": (609.02, 0.15, 6520.57, 1674.00),
    "artificial_silk": (713.00, 0.37, 9330.89, 553.84),
    "wool": (221.37, 0.31, 4729.10, 2000.57),
    "polyester": (1792.45, 0.13, 8715.03, 1260.79),
    "coated_nylon": (3579.50, 0.06, 9638.63, 2388.09),
    "dress": (129.32, 0.121, 5495.34, 350.88),
    "pants": (638.73, 0.071, 9498.36, 733.46),
    "shirt": (328.77, 0.103, 2301.56, 149.43),
}


@pytest.mark.parametrize("name", PAPER)
def test_the_papers_rows_read_as_kilopascal(name):
    material = AEP.preset(name)
    values = [material.youngs_modulus, material.poisson_ratio, material.contact_stiffness, material.shear_stiffness]
    E, nu, k, gamma = PAPER[name]
    expected = [1e3 * E, nu, 1e3 * k, 1e3 * gamma]
    assert [float(v.value.detach()) for v in values] == pytest.approx(expected, rel=1e-12)
    assert material.thickness == 1e-3
    assert "no unit" in presets.find_fabric(name).note


def test_every_row_has_a_source_and_a_grade():
    assert len(presets.load_fabrics()) == 50
    for name, fabric in presets.load_fabrics().items():
        assert fabric.name == name
        assert len(fabric.source) > 20
        assert fabric.grade[0] in "ABC"
        numbers = [v for v in fabric if isinstance(v, float)]
        assert numbers or fabric.note, "a row says something"
        assert all(math.isfinite(v) for v in numbers)


def test_si_units():
    """Ranges of cloth: a wrong power of ten in a column shows."""
    ranges = {
        "areal_density": (0.04, 2.0),
        "thickness": (4e-5, 4e-3),
        "membrane_warp": (10, 6e4),
        "membrane_weft": (10, 6e4),
        "membrane_shear": (10, 6e3),
        "bending_warp": (1e-6, 2e-4),
        "bending_hysteresis": (1e-5, 1e-2),
        "drape": (20, 100),
        "friction": (0.1, 0.6),
    }
    for key, (low, high) in ranges.items():
        result = [getattr(f, key) for f in presets.load_fabrics().values() if getattr(f, key) is not None]
        assert result, key
        assert low < min(result) <= max(result) < high, key


def test_missing_stiffness_is_named_with_the_remedy():
    with pytest.raises(InvalidInput, match=r"'M15-A' without youngs_modulus.*Matsudaira.*give youngs_modulus=\.\.\."):
        AEP.preset("M15-A")
    with pytest.raises(InvalidInput, match=r"'PL25-M1' without shear_modulus; .*give shear_modulus=\.\.\. \[Pa\]$"):
        OrthotropicAEP.preset("PL25-M1")
    with pytest.raises(InvalidInput, match="youngs_modulus, weft_modulus, shear_modulus"):
        OrthotropicAEP.preset("FT18-plain")
    with pytest.raises(InvalidInput, match=r"poisson_ratio of -0\.0036"):
        OrthotropicAEP.preset("F24-nylon")


def test_orthotropic_fabric_is_not_taken_for_isotropic():
    with pytest.raises(InvalidInput, match=r"28344 N/m warp, 4386 N/m weft.*OrthotropicAEP"):
        AEP.preset("PL25-M1")
    assert float(AEP.preset("PL25-M1", youngs_modulus=1e6).youngs_modulus.value.detach()) == pytest.approx(1e6)


def test_what_is_missing_can_be_supplied():
    material = AEP.preset("M15-A", youngs_modulus=2e6)
    assert material.thickness == pytest.approx(0.497e-3)
    assert float(material.membrane_stiffness.detach()) == pytest.approx(2e6 * 0.497e-3)
    woven = OrthotropicAEP.preset("PL25-M1", shear_modulus=5e4)
    stiffness = woven.youngs_modulus.value * woven.thickness, woven.weft_modulus.value * woven.thickness
    assert [float(v.detach()) for v in stiffness] == pytest.approx([28344, 4386])


def test_stiffness_does_not_depend_on_the_thickness_that_is_assumed():
    for h in (1e-4, 1e-3):
        assert float(AEP.preset("TA18-cotton", thickness=h).membrane_stiffness.detach()) == pytest.approx(21413)


def test_published_poisson_ratio_becomes_the_symmetric_one():
    """F24's is along the warp: nu_12 = nu sqrt(E_warp / E_weft) must give it back."""
    fabric = presets.find_fabric("F24-nylon")._replace(poisson=0.2)
    arguments = fabric.orthotropic()
    back = arguments["poisson_ratio"] * (arguments["youngs_modulus"] / arguments["weft_modulus"]) ** 0.5
    assert back == pytest.approx(0.2)


def test_published_poisson_ratio_stays_the_wefts_contraction_with_moduli_of_ones_own():
    fabric = presets.find_fabric("cotton")
    given = fabric.orthotropic(shear_modulus=1e5, weft_modulus=fabric.membrane_warp / 1e-3 / 4)
    assert given["poisson_ratio"] * (given["youngs_modulus"] / given["weft_modulus"]) ** 0.5 == pytest.approx(0.15)
    assert fabric.orthotropic(shear_modulus=1e5, poisson_ratio=0.3)["poisson_ratio"] == 0.3
    with pytest.raises(InvalidInput, match=r"published poisson_ratio of 0.15, which is 0.6 with these moduli"):
        fabric.orthotropic(shear_modulus=1e5, weft_modulus=16 * fabric.membrane_warp / 1e-3)


@pytest.mark.parametrize("law", [AEP, OrthotropicAEP])
def test_no_thickness_is_refused(law):
    with pytest.raises(InvalidInput, match=r"thickness; got 0.* m; expected a value > 0"):
        law.preset("cotton", thickness=0.0)


def test_a_number_is_no_plastic_set():
    with pytest.raises(InvalidInput, match=r"plastic; got 0\.02; expected a NormYield"):
        AEP(1e5, plastic=0.02)


def test_every_preset_gives_a_material_or_says_why_not():
    made, refusals = {AEP: 0, OrthotropicAEP: 0}, []
    given = {AEP: {}, OrthotropicAEP: {"shear_modulus": 5e4}}  # which no source states
    for name in presets.load_fabrics():
        for law in made:
            try:
                material = law.preset(name, **given[law])
            except InvalidInput as error:
                refusals.append((name, str(error)))
                continue
            made[law] += 1
            assert all(bool(torch.isfinite(c).all()) for c in material.coefficients()[:-1])
    assert all(repr(name) in text and "give" in text for name, text in refusals)
    assert made[AEP] == len(PAPER) + 1
    assert made[OrthotropicAEP] == 18


def test_bending_stiffness_is_at_hand():
    """A sheet of it bends: the published B reaches the effect."""
    bending = tc.effects.Bending(presets.find_fabric("M15-B").bending_warp)
    mesh = tc.meshes.rectangle(0.1, 0.1, triangles=50)
    material = AEP.preset("M15-B", youngs_modulus=1e6)
    cloth = tc.Cloth(
        mesh, material, presets.find_fabric("M15-B").areal_density, effects={"bending": bending}, contact=None
    )
    assert float(cloth.effects["bending"].stiffness.value.detach()) == pytest.approx(6.5705e-6)


def test_unknown_names_are_refused_with_the_known_ones():
    with pytest.raises(InvalidInput, match=r"velvet.*cotton.*M15-A"):
        presets.find_fabric("velvet")


def test_table_is_readable():
    lines = presets.format_table().splitlines()
    assert len(lines) == 51
    assert lines[0].startswith("name")
    row = next(line for line in lines if line.startswith("M15-A"))
    assert "1.1572e-05" in row
    assert row.rstrip().endswith("B")
    assert max(map(len, lines)) < 180
