"""Fields: one value per triangle."""

import json
import math

import numpy as np
import pytest
import torch
from helpers import stretched_sheets

import torchcloth as tc
from torchcloth.errors import InvalidInput
from torchcloth.identification import fields, fit_fields, identify
from torchcloth.identification.fields import NO_ERROR_NOTE, triangle_laplacian
from torchcloth.identification.residuals.blocks import select_blocks

STIFF = 4.0  # times, in the stripe


def in_stripe(mesh):
    """[F] whether a triangle lies in a stripe of 8 cm across the pull."""
    u = np.asarray(mesh.uv)[np.asarray(mesh.faces)].mean(1)[:, 0]
    return torch.as_tensor(np.abs(u - 0.2) < 0.04)


def with_field(model, values):
    model.material = tc.materials.AEP(values, 0.3, thickness=stretched_sheets.THICKNESS_M)
    return model


def start(recording):
    model = stretched_sheets.build_start_cloth(recording)
    return with_field(model, torch.full((len(model.mesh.faces),), 6e4))


@pytest.fixture
def striped(monkeypatch):
    """A function that records a sheet with a stiff stripe on the truth's own mesh."""
    plain = stretched_sheets.make_cloth

    def cloth(fabric, resolution):
        model = plain(fabric, resolution)
        stripe = 1 + (STIFF - 1) * in_stripe(model.mesh)
        return with_field(model, fabric.membrane / stretched_sheets.THICKNESS_M * stripe)

    def record(**options):
        setting = stretched_sheets.EpisodeSettings(strain=0.1, heave=0.0, occluded=0.0, **options)
        with monkeypatch.context() as patched:
            patched.setattr(stretched_sheets, "make_cloth", cloth)
            return stretched_sheets.record_episode(
                stretched_sheets.Fabric(membrane=40.0), seed=5, setting=setting, markers=11
            )

    return record


@pytest.mark.slow
def test_a_stiff_stripe_is_seen_from_another_mesh(striped):
    """Markers show where it stretches less, forces how stiff that is."""
    recording = striped(frames=5, points=600)
    model = start(recording)
    fit = fit_fields(model, recording, ["youngs_modulus"], iterations=90)
    result, stripe = fit.fields["youngs_modulus"], in_stripe(model.mesh)
    correlation = float(np.corrcoef(result.log(), stripe.double())[0, 1])
    print(f"correlation {correlation:.3f}, {result[stripe].mean():.4g} and {result[~stripe].mean():.4g} Pa, {fit.fit}")
    assert correlation > 0.8
    assert float(result[stripe].median() / result[~stripe].median()) > 2.0


def test_a_field_goes_downhill_and_says_that_it_has_no_error(striped, tmp_path):
    recording = striped(frames=4, points=100)
    model = start(recording)
    before = model.material.youngs_modulus.raw.detach().clone()
    fit = fit_fields(model, recording, ["youngs_modulus"], iterations=3, journal=tmp_path / "j")
    assert fit.fit["chamfer_after"] < fit.fit["chamfer_before"]
    assert torch.equal(model.material.youngs_modulus.raw, before)
    assert not fit.fit["converged"]
    content = json.loads(fit.save(tmp_path).read_text())
    entry = content["fields"]["youngs_modulus"]
    assert entry["std"] == NO_ERROR_NOTE == "no error: gradient method"
    assert entry["values"] == fit.fields["youngs_modulus"].tolist()
    assert content["contrast"] == fit.prior_contrast
    assert NO_ERROR_NOTE in content["warnings"][0]
    again = fit_fields(model, recording, ["youngs_modulus"], iterations=3, journal=tmp_path / "j", resume=True)
    assert torch.equal(again.fields["youngs_modulus"], fit.fields["youngs_modulus"])
    assert again.history == fit.history
    with pytest.raises(InvalidInput, match="of another fit"):
        fit_fields(model, recording, ["youngs_modulus"], contrast=2.0, journal=tmp_path / "j", resume=True)


@pytest.mark.parametrize("resolution", [(9, 9), (17, 13)])
def test_the_prior_of_a_slope_does_not_depend_on_the_mesh(resolution):
    """A field that rises by 1 across a square: its roughness is near 1, on any mesh; a constant has none."""
    mesh = tc.meshes.rectangle(0.3, 0.3, resolution=resolution)
    matrix = triangle_laplacian(mesh)
    assert float((matrix @ torch.ones(len(matrix), dtype=torch.float64)).abs().max()) < 1e-9
    rise = torch.as_tensor(np.asarray(mesh.vertices)[np.asarray(mesh.faces)].mean(1)[:, 0]) / 0.3
    assert float(rise @ matrix @ rise) == pytest.approx(1.0, rel=0.2)


@pytest.mark.parametrize("gap", [0.0, 0.02])
def test_panels_that_lie_on_each_other_are_neighbours_as_any_others(gap):
    """Across a side seam of a shirt that lies flat the centres of two triangles are next to each other in space."""
    mesh = tc.meshes.shirt(triangles=300, gap=gap)
    matrix = triangle_laplacian(mesh)
    pairs = -matrix[matrix < 0]
    assert bool(matrix.isfinite().all())
    assert float(pairs.max()) < 6 * float(pairs.median())
    assert float((matrix @ torch.ones(len(matrix), dtype=torch.float64)).abs().max()) < 1e-9


def test_distances_of_centres_are_those_of_triangles_side_by_side():
    mesh = tc.meshes.rectangle(0.3, 0.2, resolution=(5, 4))
    flat, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    centres, matrix = flat[faces].mean(1), triangle_laplacian(mesh)
    for a, b in zip(*np.nonzero(np.triu(matrix.numpy(), 1)), strict=True):
        i, j = set(faces[a]) & set(faces[b])
        weight = np.linalg.norm(flat[i] - flat[j]) / np.linalg.norm(centres[a] - centres[b])
        assert -float(matrix[a, b]) == pytest.approx(weight, rel=1e-9)


@pytest.mark.parametrize("name", ["poisson_ratio", "cone", "nothing"])
def test_what_is_no_field_is_refused(striped, name):
    recording = striped(frames=4, points=50)
    with pytest.raises(InvalidInput, match=f"field to fit; got '{name}'; expected a parameter of the material"):
        fit_fields(start(recording), recording, [name])


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"iterations": 0}, "iterations; got 0; expected at least 1"),
        ({"contrast": -1.0}, "contrast; got -1.0; expected a number > 0"),
        ({"contrast": float("nan")}, "contrast; got nan"),
    ],
)
def test_numbers_out_of_range_are_named(striped, options, said):
    recording = striped(frames=4, points=50)
    with pytest.raises(InvalidInput, match=f"^{said}"):
        fit_fields(start(recording), recording, ["youngs_modulus"], **options)


def test_no_episode_counts_twice(striped):
    recording = striped(frames=4, points=50)
    model = start(recording)
    with pytest.raises(InvalidInput, match=r"^recordings; got none"):
        fit_fields(model, [], ["youngs_modulus"])
    with pytest.raises(InvalidInput, match=r"^episodes; got .* twice"):
        fit_fields(model, [recording, recording], ["youngs_modulus"])


def test_identify_says_who_fits_fields(striped):
    recording = striped(frames=4, points=50)
    with pytest.raises(InvalidInput, match="a value for each triangle: fit_fields"):
        identify(start(recording), recording, ["youngs_modulus"])


def test_pieces_of_cloth_that_do_not_touch_have_a_prior_each():
    one = tc.meshes.rectangle(0.1, 0.1, triangles=8)
    faces = np.concatenate([one.faces, np.asarray(one.faces) + len(one.vertices)])
    two = tc.meshes.Mesh.build(
        np.concatenate([one.vertices, np.asarray(one.vertices) + np.array([0.2, 0.0, 0.0])]), faces
    )
    cloth = with_field(tc.Cloth(two, tc.materials.AEP(1e5, 0.3), 0.2), torch.full((len(faces),), 1e5))
    of_part = {"youngs_modulus": cloth.material.youngs_modulus}
    prior = fields._FieldObjective(cloth, of_part, [], None, select_blocks(None), 1.0).precision_root
    covariance = torch.linalg.inv(prior @ prior.mT)
    count = len(one.faces)
    assert float(covariance[:count, :count].mean()) == pytest.approx(math.log(10) ** 2)
    assert float(covariance[:count, count:].abs().max()) < 1e-9


def test_where_clouds_end_is_no_datum_of_a_field(striped, monkeypatch):
    """No camera sees an edge where it is; how far off it is would be the fabric's."""
    seen = []

    class Stop(Exception):
        pass

    def made(cloth, of_part, episodes, dt, blocks, contrast):
        seen.append([block.name for block in blocks])
        raise Stop

    monkeypatch.setattr(fields, "_FieldObjective", made)
    recording = striped(frames=2, points=20)
    for use in (None, "points"):
        with pytest.raises(Stop):
            fit_fields(start(recording), recording, ["youngs_modulus"], use=use)
    assert seen == [["points", "markers", "force", "torque"], ["points"]]
