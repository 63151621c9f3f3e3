"""A simulated cloth beside points: colours, figures, and the fit that it comes from."""

import json
import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from torchcloth import recordings
from torchcloth.errors import InvalidInput, RecordingError
from torchcloth.losses import chamfer_to_surface
from torchcloth.recordings import PointClouds
from torchcloth.viewing import Cloud, add_cloth, film_from_fit
from torchcloth.viewing.fit_film import _add_cloth_at_point_times, _choose_colour_limit, _is_observed


@pytest.fixture
def bare(film):
    """(film without cloth, the cloth)."""
    return replace(film, sheets={}), film.sheets["cloth"]


def test_points_one_millimetre_away_colour_the_cloth_so(bare):
    film, cloth = bare
    drawn = add_cloth(film, cloth.vertices, cloth.faces)
    values = drawn.sheets["cloth"].values
    assert values[np.isfinite(values)] == pytest.approx(1.0, abs=1e-3)
    assert drawn.curves["distance"].values == pytest.approx(1.0, abs=1e-3)
    assert drawn.colour_limit == 2.0


def test_fabric_without_points_is_unknown(bare):
    film, cloth = bare
    one_side = tuple(points[points[:, 0] > 0] for points in film.clouds["points"].frames)
    drawn = add_cloth(replace(film, clouds={"points": Cloud(one_side)}), cloth.vertices, cloth.faces)
    known = np.isfinite(drawn.sheets["cloth"].values[0])
    x = cloth.vertices[0]
    assert not known[x[:, 0] < -0.15].any()
    inside = (np.abs(x[:, 1]) < 0.12) & (x[:, 0] > 0.03) & (x[:, 0] < 0.14)
    assert known[inside].all()


def test_near_and_far_points_colour_their_own_places(bare):
    film, cloth = bare
    lift = [np.where(p[:, :1] > 0, 4e-3, 0.0) * [[0.0, 0, 1]] for p in film.clouds["points"].frames]
    moved = tuple(p + dz for p, dz in zip(film.clouds["points"].frames, lift, strict=True))
    values = (
        add_cloth(replace(film, clouds={"points": Cloud(moved)}), cloth.vertices, cloth.faces).sheets["cloth"].values
    )
    x = cloth.vertices[0]
    assert np.nanmedian(values[:, x[:, 0] > 0.08]) == pytest.approx(5.0, abs=0.3)
    assert np.nanmedian(values[:, x[:, 0] < -0.08]) == pytest.approx(1.0, abs=0.3)


def test_points_of_another_time_are_shown_and_not_measured(bare):
    """Markers at 120 Hz, points at 30: between them the cloth has gone on."""
    film, cloth = bare
    is_observed = np.arange(len(film.times)) % 2 == 0
    drawn = add_cloth(film, cloth.vertices, cloth.faces, is_observed=is_observed)
    assert np.array_equal(np.isfinite(drawn.curves["distance"].values), is_observed)
    assert np.isnan(drawn.sheets["cloth"].values[~is_observed]).all()
    assert drawn.clouds["points"] is film.clouds["points"]


def test_frames_between_those_of_the_points_are_left_out(bare):
    """Else three of a picture's four moments are grey, and a curve with gaps has no line."""
    film, cloth = bare
    points = PointClouds(film.times[::2], np.zeros((3, 3)), np.ones(3, dtype=int))
    recording = SimpleNamespace(points=points, clock_offset=0.0, observation_noise_std=None)
    drawn = _add_cloth_at_point_times(film, recording, cloth.vertices, cloth.faces)
    assert np.array_equal(drawn.times, film.times[::2])
    assert np.isfinite(drawn.curves["distance"].values).all()
    np.testing.assert_array_equal(drawn.sheets["cloth"].vertices, cloth.vertices[::2])
    none = _add_cloth_at_point_times(
        film, SimpleNamespace(points=None, observation_noise_std=None), cloth.vertices, cloth.faces
    )
    assert len(none) == len(film)


def test_which_frames_have_points_of_their_own():
    points = PointClouds(np.array([0.0, 0.1, 0.2]), np.zeros((3, 3)), np.ones(3, dtype=int))
    recording = SimpleNamespace(points=points, clock_offset=0.05)
    times = points.t + 0.05
    between = np.sort(np.concatenate([times, times[:-1] + 0.3 * np.diff(times)]))
    assert np.array_equal(_is_observed(recording, between), np.isin(between, times))
    assert not _is_observed(SimpleNamespace(points=None), between).any()


def test_a_frame_without_points_has_no_distance(bare):
    film, cloth = bare
    frames = (np.zeros((0, 3), np.float32), *film.clouds["points"].frames[1:])
    drawn = add_cloth(replace(film, clouds={"points": Cloud(frames)}), cloth.vertices, cloth.faces)
    assert np.isnan(drawn.sheets["cloth"].values[0]).all()
    assert np.isnan(drawn.curves["distance"].values[0])
    assert np.isfinite(drawn.curves["distance"].values[1:]).all()


def test_without_points_the_cloth_is_plain(bare):
    film, cloth = bare
    drawn = add_cloth(replace(film, clouds={}), cloth.vertices, cloth.faces)
    assert drawn.sheets["cloth"].values is None
    assert "distance" not in drawn.curves


def test_other_cloths_become_outlines(film):
    cloth = film.sheets["cloth"]
    drawn = add_cloth(replace(film, sheets={"truth": cloth}), cloth.vertices, cloth.faces)
    assert [(name, sheet.outline) for name, sheet in drawn.sheets.items()] == [("truth", True), ("cloth", False)]


@pytest.mark.parametrize(
    ("values", "noise", "colour_limit"),
    [([0.1], None, 2.0), ([0.1], 1.2e-3, 5.0), ([13.0] * 9, 1e-3, 15.0), ([np.nan], None, 2.0)],
)
def test_the_colour_bar_ends_at_a_round_number(values, noise, colour_limit):
    assert _choose_colour_limit(np.array(values), noise) == pytest.approx(colour_limit)


@pytest.fixture(scope="module")
def fitted(short):
    """The film of the shipped episode's first frames with its fit."""
    folder, fit = short
    torch.set_default_dtype(torch.float64)
    return film_from_fit(recordings.read(folder), fit)


def test_the_fit_is_simulated_again(fitted, short):
    """Values near the truth follow the points to about the sensor's noise, 1.2 mm; the data sheet's do not."""
    points = recordings.read(short[0]).points
    cloth, distance = fitted.sheets["cloth"], fitted.curves["distance"]
    for i in range(len(points)):
        x = torch.as_tensor(cloth.vertices[i], dtype=torch.float64)
        expected = chamfer_to_surface(torch.as_tensor(points.frame(i)), x, torch.as_tensor(cloth.faces))
        assert distance.values[i] == pytest.approx(1e3 * float(expected), rel=1e-3)
    assert 0.8 < distance.values.mean() < 1.2
    assert f"fitted, {distance.values.mean():.2f} mm" in fitted.title


def test_the_start_of_a_fit_is_farther_from_the_points(fitted, short):
    start = film_from_fit(recordings.read(short[0]), short[1], at_start=True)
    assert "start values" in start.title
    np.testing.assert_array_equal(start.times, fitted.times)
    assert np.nanmean(start.curves["distance"].values) > np.nanmean(fitted.curves["distance"].values)


def test_a_replay_that_is_not_the_fits_is_said(spoiled):
    folder, path, content = spoiled
    content["model"]["episodes"][0]["chamfer"] = 0.003
    path.write_text(json.dumps(content))
    film = film_from_fit(recordings.read(folder), path.parent)  # the folder will do
    assert any("the fit was 3.00" in note for note in film.notes)


def test_an_episode_that_was_not_fitted_is_a_prediction(short):
    recording = recordings.read(short[0])
    points = recording.points
    other = replace(recording, points=replace(points, xyz=points.xyz + np.array([0.0, 0.0, 0.002])))
    film = film_from_fit(other, short[1])
    assert "swing: predicted, " in film.title
    assert not film.notes


BROKEN = {
    "no json": (lambda c: "{", "unreadable"),
    "an older file": (lambda c: json.dumps({"parameters": {}}), "schema; got none"),
    "a list": (lambda c: "[]", "schema; got none"),
    "a word for a number": (lambda c: json.dumps(c).replace("0.0665", '"soft"'), "does not say which model"),
    "wrong contact": (
        lambda c: json.dumps(c).replace('"contact": null', '"contact": {"gap": 1}'),
        "does not say which",
    ),
    "an effect that is not there": (
        lambda c: json.dumps(c).replace("air.normal", "hem.stiffness"),
        "air.normal, hem.st",
    ),
    "an impossible value": (lambda c: json.dumps(c).replace("51294.0", "-1.0"), "got -1 Pa"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_fit_is_refused(spoiled, case):
    folder, path, content = spoiled
    change, message = BROKEN[case]
    path.write_text(change(content))
    with pytest.raises((InvalidInput, RecordingError), match=message) as refused:
        film_from_fit(recordings.read(folder), path)
    assert "\n" not in str(refused.value)


def test_a_fit_that_is_not_there(short, tmp_path):
    with pytest.raises(InvalidInput, match=r"no .*identification\.json; expected"):
        film_from_fit(recordings.read(short[0]), tmp_path)


def test_moving_the_episode_does_not_matter(short, tmp_path, fitted):
    moved = shutil.copytree(short[0], tmp_path / "elsewhere")
    again = film_from_fit(recordings.read(moved), short[1])
    np.testing.assert_array_equal(again.sheets["cloth"].vertices, fitted.sheets["cloth"].vertices)
