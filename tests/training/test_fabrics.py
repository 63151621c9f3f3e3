"""The fabric study and the classification: twins as they should be, statistics, and one run of both, reduced."""

import json

import numpy as np
import pytest
import torch

import torchcloth as tc
from torchcloth.robots import replay
from torchcloth.training.studies import classify, fabrics, pressing, stretching
from torchcloth.training.studies.command import main
from torchcloth.training.studies.fabric_trials import ALL_PULLS, FAST_SCALE, pressed_layer, sheet_fabric
from torchcloth.training.studies.paper_fabrics import FABRICS
from torchcloth.training.studies.synthetic_sheets import interpolate_on_grid


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    """Folder and what was printed, of both studies."""
    folder, printed = tmp_path_factory.mktemp("fabrics"), {}
    for name in ("fabrics", "classify"):
        with pytest.MonkeyPatch.context() as patch:
            printed[name] = _captured(patch, [name, "--fast", "--out", str(folder)])
    return folder, printed


def _captured(patch, arguments):
    import io

    text, before = io.StringIO(), torch.get_default_dtype()
    patch.setattr("sys.stdout", text)
    try:
        assert main(arguments) == 0
    finally:
        torch.set_default_dtype(before)
    return text.getvalue()


# -- the run ---------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_stretching_finds_stiffness_and_contraction(study):
    result = json.loads((study[0] / "fabrics.json").read_text())
    for name in FAST_SCALE.fabrics:
        E, nu = (result["fabrics"][name][s]["stretched"] for s in ("E", "ν"))
        assert E["identifiable"] == nu["identifiable"] == 3
        assert abs(E["error"]) < 0.04, name  # cells of 5 cm; the full study's are half as large
        assert abs(nu["error"]) < 0.15, name
        assert 0 < E["cov"] < 0.03, name
    assert result["fabrics"]["cotton"]["E"]["truth"] == pytest.approx(609.02e3)  # the paper's table


@pytest.mark.slow
def test_a_stretched_sheet_says_nothing_of_k_and_gamma_and_the_press_does(study):
    result = json.loads((study[0] / "fabrics.json").read_text())
    for name in FAST_SCALE.fabrics:
        for symbol in ("k", "γ"):
            properties = result["fabrics"][name][symbol]
            assert properties["stretched"]["identifiable"] is False
            assert properties["stretched"]["tenth_mm"] < 0.01
            assert properties["press"]["identifiable"] == 1
            assert abs(properties["press"]["error"]) < 0.03, (name, symbol)
        assert abs(result["fabrics"][name]["c_F"]["press"]["error"]) < 0.01
        for symbol, largest in (("k", 0.1), ("γ", 0.15), ("c_F", 0.05)):  # at other places and in other attitudes
            elsewhere = result["fabrics"][name][symbol]["elsewhere"]
            assert elsewhere["covered"] == elsewhere["identifiable"] == 2
            assert elsewhere["worst"] < largest, (name, symbol)


@pytest.mark.slow
def test_tables_pictures_and_the_papers_numbers_are_there(study):
    folder, printed = study
    assert "not identifiable" in printed["fabrics"]
    assert "8.50 %" in printed["fabrics"]  # the paper's CoV of cotton's gamma
    assert "press folded layers together" in printed["fabrics"]
    assert "no table of it" in " ".join(printed["classify"].split())
    for picture in ("stretching.png", "fabrics.png", "classify.png"):
        assert (folder / picture).stat().st_size > 10_000


@pytest.mark.slow
def test_the_same_trials_distinguish_fabrics(study):
    result = json.loads((study[0] / "classify.json").read_text())["sets"]
    assert result["E and ν"]["right"] == result["E and ν"]["trials"] == 6
    assert result["E alone"]["margin"] > 10


@pytest.mark.slow
def test_finished_trials_are_not_repeated_and_other_settings_are_refused(study, capsys):
    before = {path: path.stat().st_mtime_ns for path in (study[0] / "cases").iterdir()}
    dtype = torch.get_default_dtype()
    assert main(["classify", "--fast", "--out", str(study[0]), "--fabrics", "cotton", "wool"]) == 0
    assert {path: path.stat().st_mtime_ns for path in (study[0] / "cases").iterdir()} == before
    assert main(["fabrics", "--out", str(study[0])]) == 2
    torch.set_default_dtype(dtype)
    assert "use the same settings, or another folder" in capsys.readouterr().err


def test_distances_allow_for_the_errors_of_the_others():
    """A sharp trial beside blurred ones of its own fabric had been 2.5 standard errors away."""
    draw, result = np.random.default_rng(0), []
    for _ in range(400):
        others = [classify.Trial("cotton", 0.1 * draw.standard_normal(2), np.full(2, 0.1)) for _ in range(9)]
        sharp = classify.Trial("cotton", 0.01 * draw.standard_normal(2), np.full(2, 0.01))
        result.append(classify._squared_distance(sharp, others))
    assert 0.5 < np.mean(result) / 2 < 1.2  # of two parameters


# -- twins -----------------------------------------------------------------------------------------------------------


def test_positions_between_vertices_are_exact_for_a_bilinear_field():
    mesh = tc.meshes.rectangle(1.0, 1.0, resolution=(4, 6))
    u, v = np.asarray(mesh.uv).T
    field = np.stack([2 * u - v, u * v, 1 + v], axis=1)
    share = np.random.default_rng(0).random((50, 2))
    wanted = np.stack([2 * share[:, 0] - share[:, 1], share.prod(1), 1 + share[:, 1]], axis=1)
    assert interpolate_on_grid(field, (4, 6), share) == pytest.approx(wanted, abs=1e-12)


def test_meshes_do_not_fit_into_each_other_and_pulls_stay_within_an_arms_strength():
    for pull in ALL_PULLS:
        detail = stretching.Detail()
        for truth, model in zip(detail.truth(pull), detail.model(pull), strict=True):
            assert truth - 1 > 2 * (model - 1)
            assert (truth - 1) % (model - 1) == 1
        for name in FABRICS:
            properties = sheet_fabric(name)
            force = properties.membrane * stretching.pull_strain(properties, pull) * pull.size[1 - pull.axis]
            assert force < 40.0 + 1e-9
            assert stretching.pull_strain(properties, pull) <= 0.08


def test_a_bar_hides_thirty_per_cent_and_no_marker_is_seen_behind_it():
    x = np.stack([*np.meshgrid(np.linspace(0, 0.3, 101), np.linspace(0, 0.2, 41), indexing="ij"), np.zeros((101, 41))])
    x = x.reshape(3, -1).T
    eye = x.mean(0) + np.array([0.0, -0.05, 0.6])
    bar, _ = stretching._bar(x, eye)
    assert stretching._behind(x, eye, bar).mean() == pytest.approx(0.3, abs=0.02)
    assert bar[:, 2] == pytest.approx(0.05)


def test_sliding_layers_pull_with_the_cones_share_of_their_pressure():
    """Coulomb's law in the small: beyond the first slip the tangential force is c_F times the normal one."""
    properties, plates = pressed_layer("cotton")._replace(cone=0.25), pressing.Plates(2, 0.0125)
    torch.set_default_dtype(torch.float64)
    cloth, paths = pressing.build_layers(properties, plates), pressing.plate_motion(plates)
    bare = tc.recordings.Recording(
        cloth=tc.recordings.ClothInfo(areal_density=properties.density), provenance="synthetic: tests", grippers=paths
    )
    with torch.no_grad():
        out = cloth(cloth.rest_state(), replay(bare), paths["above"].t[::8].tolist())
    tangential, _, normal = out.wrench["above"][-3, :3].tolist()
    assert normal > 3.0
    assert -tangential / normal == pytest.approx(0.25, abs=0.01)  # the plate still slows down: its layer has mass


# -- statistics ------------------------------------------------------------------------------------------------------


def estimate(value, identifiable=True):
    return {"value": value, "std": 0.02 * value, "ci95": [0.96 * value, 1.04 * value], "identifiable": identifiable}


def test_statistics_are_of_the_trials_that_know_and_of_none_where_few_do():
    result = fabrics.statistics([estimate(v) for v in (98.0, 100.0, 105.0)] + [estimate(1.0, False)], 100.0)
    assert result["identifiable"] == 3
    assert result["mean"] == pytest.approx(101.0)
    assert result["cov"] == pytest.approx(np.std([98, 100, 105], ddof=1) / 101)
    assert (result["worst"], result["covered"]) == (pytest.approx(0.05), 2)
    assert fabrics.statistics([estimate(1.0), estimate(2.0, False)], 1.0)["mean"] is None


def trials(rng, separation):
    return [
        classify.Trial(name, np.array([i * separation, 0.0]) + 0.1 * rng.standard_normal(2), np.array([0.1, 0.1]))
        for i, name in enumerate("abc")
        for _ in range(30)
    ]


@pytest.mark.parametrize(("separation", "low", "high"), [(2.0, 90, 90), (0.2, 55, 80), (0.0, 15, 45)])
def test_confusion_counts_what_overlaps(separation, low, high):
    """Neighbours two standard deviations apart: the middle one is right in 68 %, the others in 84 % of all cases."""
    result = classify.confusion_matrix(trials(np.random.default_rng(1), separation), "abc")
    assert low <= result["right"] <= high
    assert sum(sum(row.values()) for row in result["matrix"].values()) == result["trials"] == 90
    assert result["within"] >= 80  # own errors cover the spread


def test_distance_is_mahalanobis_with_the_trials_own_error_and_the_spread_beyond_it():
    places = np.array([[0.0, 0.0], [2.0, 0.0], [0.0, 2.0], [2.0, 2.0]])
    others = [classify.Trial("a", p, np.zeros(2)) for p in places]
    trial = classify.Trial("a", np.array([4.0, 1.0]), np.array([0.5, 0.5]))
    variance = (4 / 3 + 0.25) + 4 / 3 / 4  # a trial's, and of the mean of four that are exact
    assert classify._squared_distance(trial, others) == pytest.approx(9.0 / variance)
    noisy = [other._replace(error=np.array([5.0, 5.0])) for other in others]
    assert classify._squared_distance(trial, noisy) == pytest.approx(
        9.0 / (0.25 + 5.0**2 / 4)
    )  # all of their spread is error
    assert classify._squared_distance(trial, others[:1]) is None


def test_a_fabric_with_too_few_others_is_not_counted_as_wrong():
    """Of two trials of wool one has one other, which is no spread: it cannot be called wool, nor anything else."""
    rng = np.random.default_rng(0)

    def trials(sheet_fabric, centre, count):
        return [
            classify.Trial(sheet_fabric, centre + 0.01 * rng.standard_normal(1), np.array([0.01])) for _ in range(count)
        ]

    result = classify.confusion_matrix(trials("cotton", 0.0, 10) + trials("wool", 5.0, 2), ["cotton", "wool"])
    assert (result["right"], result["trials"]) == (10, 10)
    assert classify.confusion_matrix(trials("cotton", 0.0, 2), ["cotton"])["trials"] == 0
