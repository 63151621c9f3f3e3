"""``identify`` on the twin: right within its errors, and honest about what it cannot know."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.schema_checks import check_written
from helpers.twins import SAME_SIMULATOR, THICKNESS_M, TRUE_FABRIC, build_cloth_at, make_twin, take_first_frames

import torchcloth as tc
from torchcloth.errors import InvalidInput
from torchcloth.identification import build_cloth, build_episode, fit_fields, identify
from torchcloth.identification.estimators import search
from torchcloth.identification.estimators.gradient_descent import chamfer_to_nearest_vertex

PAIR = ["youngs_modulus", "air.normal"]
STATED = 0.005  # kg/m^2, the recording's error of its areal density


def within(estimate, truth, sigmas=3.0):
    return abs(estimate.value - truth) <= sigmas * estimate.std


def test_stiffness_and_air_are_found_from_a_start_twice_off(fitted):
    """Three standard errors, and ten per cent: the first alone would be met by a fit that says nothing."""
    p = fitted[0].parameters
    assert within(p["membrane_stiffness"], TRUE_FABRIC.membrane)
    assert p["membrane_stiffness"].value == pytest.approx(TRUE_FABRIC.membrane, rel=0.10)
    assert within(p["air.normal"], TRUE_FABRIC.drag)
    assert p["air.normal"].value == pytest.approx(TRUE_FABRIC.drag, rel=0.15)
    assert within(p["poisson_ratio"], TRUE_FABRIC.poisson)
    assert within(p["bending.stiffness"], TRUE_FABRIC.bending)
    assert all(p[name].identifiable for name in ("youngs_modulus", "membrane_stiffness", "air.normal"))


def test_the_density_keeps_to_its_measurement(fitted):
    density = fitted[0].parameters["areal_density"]
    assert density.source == "prior"
    assert abs(density.value - TRUE_FABRIC.density) < 3 * STATED
    assert (
        density.std <= 1.3 * STATED
    )  # a second source of knowledge cannot leave one with less; robust errors may vary


def test_a_taut_sheet_does_not_show_its_bending(fitted):
    fit, _ = fitted
    assert not fit.parameters["bending.stiffness"].identifiable
    assert "bending.stiffness is not identifiable from these data: its value is no estimate" in fit.warnings


@pytest.mark.parametrize("name", ["contact_stiffness", "shear_stiffness", "cone"])
def test_contact_that_is_left_out_is_not_in_the_model(fitted, name):
    estimate = fitted[0].parameters[name]
    assert estimate.source == "not in the model"
    assert not estimate.identifiable
    assert estimate.value == estimate.initial


def test_the_fit_is_better_than_its_start_and_the_null(fitted):
    f = fitted[0].fit
    assert f["chamfer_after"] < 0.3 * f["chamfer_before"]
    assert f["chamfer_after"] < 0.3 * f["chamfer_null"]
    # mean |z| of 1 mm noise is 0.80 mm, its rms 1 mm; half as much again for another mesh
    assert 0.7e-3 < f["chamfer_after"] < 1.2e-3
    assert 0.9e-3 < f["rms_after"] < 1.5e-3
    assert f["converged"] is True


def test_progress_and_history_tell_the_same(fitted):
    fit, calls = fitted
    assert [c[0] for c in calls] == [h["iteration"] for h in fit.history] == list(range(len(calls)))
    assert [c[1] for c in calls] == [h["chamfer"] for h in fit.history]
    assert all(c[2].items() <= h.items() for c, h in zip(calls, fit.history, strict=True))
    assert [c[3] for c in calls] == [h["frame_fraction"] for h in fit.history]
    assert fit.history[0]["youngs_modulus"] == pytest.approx(8e4)
    assert fit.history[0]["frame_fraction"] < 1 == fit.history[-1]["frame_fraction"]
    assert fit.history[-1]["chamfer"] == pytest.approx(fit.fit["chamfer_after"])


def test_the_result_is_the_promised_json(fitted, tmp_path):
    path = fitted[0].save(tmp_path / "new" / "folder")
    assert path == tmp_path / "new" / "folder" / "identification.json"

    def refuse(constant):
        raise AssertionError(f"{constant} is not JSON")

    content = json.loads(path.read_text(), parse_constant=refuse)
    check_written(content, "identification")
    assert set(content) >= {"parameters", "fit", "convention", "warnings"}
    for name, p in content["parameters"].items():
        assert set(p) >= {"value", "std", "ci95", "unit", "initial", "identifiable"}, name
        assert all(isinstance(p[key], float) for key in ("value", "std", "initial")), name
        assert isinstance(p["identifiable"], bool)
        assert isinstance(p["unit"], str)
        low, high = p["ci95"]
        assert low <= p["value"] <= high
        assert p["std"] > 0
    numbers = {"chamfer_before", "chamfer_after", "rms_before", "rms_after", "iterations", "simulations", "seconds"}
    assert set(content["fit"]) >= numbers | {"chamfer_null", "rms_null"}
    assert all(math.isfinite(value) for value in content["fit"].values())
    assert isinstance(content["convention"], str)
    for word in ("one-sided", "std", "null", "identifiable", "SI"):
        assert word in content["convention"]
    assert all(isinstance(w, str) for w in content["warnings"])


def test_stiffness_is_the_modulus_times_the_thickness(fitted):
    p, h = fitted[0].parameters, 1e-3
    modulus, stiffness = p["youngs_modulus"], p["membrane_stiffness"]
    assert stiffness.source == "derived"
    assert stiffness.unit == "N/m"
    for key in ("value", "std", "initial"):
        assert getattr(stiffness, key) == pytest.approx(h * getattr(modulus, key))


def test_frames_of_the_result_are_those_of_the_figures(fitted, recording):
    fit, _ = fitted
    shape = (len(recording.points), len(recording.cloth.vertices), 3)
    assert [x.shape for x in (*fit.frames_before, *fit.frames_after, *fit.frames_null)] == [shape] * 3
    torch.testing.assert_close(fit.frames_null[0][0], torch.as_tensor(recording.cloth.initial_vertices))


def test_the_start_does_not_matter(plain, pair):
    """From 20 and from 80 N/m, a factor of 4: the same answer within one standard error, which is all one can ask."""
    for name in PAIR:
        a, b = plain.parameters[name], pair.parameters[name]
        assert abs(a.value - b.value) < min(a.std, b.std), name
    assert pair.parameters["membrane_stiffness"].value == pytest.approx(TRUE_FABRIC.membrane, rel=0.10)


def test_apply_sets_what_is_identifiable_and_nothing_else(fitted, recording):
    fit, _ = fitted
    cloth = build_cloth_at(recording)
    before = {name: value.detach().clone() for name, value in cloth.named_parameters()}
    assert fit.apply(cloth) is cloth
    assert cloth.material.youngs_modulus.value.item() == pytest.approx(fit.parameters["youngs_modulus"].value)
    assert cloth.effects["air"].normal.value.item() == pytest.approx(fit.parameters["air.normal"].value)
    stored = {fit.keys[n] + ".raw" for n, e in fit.parameters.items() if n in fit.keys and not e.identifiable}
    assert "effects.bending.stiffness.raw" in stored
    untouched = (
        stored
        | {"effects.gravity.acceleration", "effects.gravity.tilt"}
        | {"effects.air.tangential.raw", "effects.air.wind", "effects.bending.damping_time.raw"}
        | {f"material.{name}.raw" for name in ("contact_stiffness", "shear_stiffness", "cone")}
    )
    for name, value in cloth.named_parameters():
        assert torch.equal(value, before[name]) == (name in untouched), name


def test_a_cloth_that_hangs_still_says_nothing_about_air():
    """No motion, no drag: the prior comes back, called unidentifiable, with an interval that says so."""
    still = take_first_frames(make_twin(amplitude=0.0), 6)
    fit = identify(build_cloth_at(still, youngs_modulus=4e4), still, ["air.normal"], iterations=3, exact_bench=True)
    air = fit.parameters["air.normal"]
    assert not air.identifiable
    assert air.std > 0.5 * 2 * tc.effects.AirDrag.amplitudes["normal"].typical  # no less than half its prior
    assert "air.normal is not identifiable from these data: its value is no estimate" in fit.warnings
    cloth = build_cloth_at(still)
    fit.apply(cloth)
    assert cloth.effects["air"].normal.value.item() == tc.effects.AirDrag.amplitudes["normal"].typical


@pytest.mark.slow
def test_two_episodes_say_more_than_one(recording, pair):
    """A replicate with noise of its own: errors shrink by about sqrt 2, and are themselves known to some 20 %."""
    both = identify(
        build_cloth_at(recording, youngs_modulus=3e4),
        [recording, make_twin(seed=1)],
        PAIR,
        model_errors=SAME_SIMULATOR,
        exact_bench=True,
    )
    for name in PAIR:
        assert both.parameters[name].std < pair.parameters[name].std, name
    assert both.parameters["membrane_stiffness"].value == pytest.approx(TRUE_FABRIC.membrane, rel=0.10)
    assert within(both.parameters["air.normal"], TRUE_FABRIC.drag)
    assert len(both.frames_after) == 2
    assert both.fit["points"] == 2 * pair.fit["points"]


def test_two_episodes_at_once(brief):
    """Short ones: what is said of each is counted for both."""
    fit = identify(
        build_cloth_at(brief, youngs_modulus=5e4),
        [brief, take_first_frames(make_twin(seed=1, rate=2.0), 5)],
        ["youngs_modulus"],
        exact_bench=True,
    )
    assert len(fit.frames_before) == len(fit.frames_after) == len(fit.frames_null) == 2
    assert [len(x) for x in fit.frames_after] == [6, 5]
    assert fit.fit["points"] == 11 * 120
    assert fit.parameters["membrane_stiffness"].value == pytest.approx(TRUE_FABRIC.membrane, rel=0.15)


def test_adam_lowers_the_chamfer_in_three_iterations(model, brief):
    """The paper's way: slow, but downhill."""
    fit = identify(model, brief, PAIR, method="adam", iterations=3)
    assert fit.fit["chamfer_after"] < 0.9 * fit.fit["chamfer_before"]
    assert len(fit.history) == 3
    assert not fit.fit["converged"]
    assert any("gradient descent has no test of convergence" in w for w in fit.warnings)
    assert fit.parameters["youngs_modulus"].value < 0.85 * fit.parameters["youngs_modulus"].initial


@pytest.mark.parametrize("method", ["gauss-newton", "adam"])
def test_the_papers_stop_rule_ends_a_fit_that_is_good_enough(model, brief, monkeypatch, method):
    """By the distance that the paper minimises, to vertices: it holds half an edge even where the fit is perfect."""
    seen = build_episode(model, brief)
    with torch.no_grad():
        start = float(chamfer_to_nearest_vertex(model(model.state(seen.initial), seen.motion, seen.times).x, seen))
    monkeypatch.setattr(search, "PAPER_STOP_CHAMFER_M", 1.05 * start)
    fit = identify(model, brief, PAIR, method=method, stop="paper", exact_bench=True)
    assert fit.fit["iterations"] == 0
    assert not fit.fit["converged"]
    assert fit.parameters["youngs_modulus"].value == pytest.approx(8e4)
    assert fit.fit["chamfer_after"] == pytest.approx(fit.fit["chamfer_before"], rel=1e-12)
    monkeypatch.setattr(search, "PAPER_STOP_CHAMFER_M", 0.95 * start)
    moved = identify(model, brief, PAIR, method=method, stop="paper", iterations=3, exact_bench=True)
    assert moved.fit["iterations"] > 0


@pytest.mark.parametrize("options", [{"stop": "paper"}, {"method": "adam", "stop": "paper"}])
def test_no_search_that_never_moved_presents_its_start_as_the_answer(model, brief, monkeypatch, options):
    """DiffCloth, issue 24: the start value came back as the result. Here the way that is left is in the error."""
    monkeypatch.setattr(search, "PAPER_STOP_CHAMFER_M", 1.0)
    fit = identify(model, brief, ["youngs_modulus"], exact_bench=True, **options)
    result = fit.parameters["youngs_modulus"]
    assert result.value == pytest.approx(result.initial)  # twice the truth
    assert not result.identifiable
    assert result.ci95[0] < TRUE_FABRIC.membrane / THICKNESS_M < result.ci95[1]
    assert fit.apply(build_cloth_at(brief)).material.youngs_modulus.value.item() == pytest.approx(
        8e4
    )  # as the data sheet has it


def test_iterations_are_at_most_what_was_asked(one_step):
    """In each of the two stages; the reader is told that the search was cut short."""
    fit = one_step
    for early in (True, False):
        assert 1 <= sum((entry["frame_fraction"] < 1) == early for entry in fit.history) <= 2  # its start, and one step
    assert fit.fit["converged"] is False
    done = fit.fit["iterations"]
    assert any(w.startswith(f"stopped after {done} iterations before converging") for w in fit.warnings)


def test_a_guess_is_where_the_search_begins_and_not_what_it_is_compared_with(model, recording, pair):
    guess = {name: pair.parameters[name].value for name in (*PAIR, "areal_density")}
    fit = identify(model, recording, PAIR, guess=guess, warm_start=True, exact_bench=True)
    assert fit.history[0]["youngs_modulus"] == pytest.approx(guess["youngs_modulus"])
    assert all(entry["frame_fraction"] == 1 for entry in fit.history)  # no early stage: the guess is past it
    assert fit.parameters["youngs_modulus"].initial == pytest.approx(8e4)
    assert fit.fit["chamfer_before"] > 2 * fit.history[0]["chamfer"]
    assert fit.fit["iterations"] <= 5  # the rim's offset is found anew
    error = abs(fit.parameters["youngs_modulus"].value - guess["youngs_modulus"])
    assert error < fit.parameters["youngs_modulus"].std


def test_known_density_is_not_fitted_and_the_reader_is_told(brief):
    from dataclasses import replace

    exact = replace(brief, cloth=replace(brief.cloth, areal_density_std=None))
    fit = identify(build_cloth_at(exact, youngs_modulus=4e4), exact, PAIR, iterations=1, exact_bench=True)
    assert "areal_density" not in fit.parameters
    assert any(w.startswith("areal density was taken as exact") for w in fit.warnings)


def test_a_fit_repeats_bit_by_bit_and_leaves_the_cloth_as_it_was(model, brief, one_step):
    before = {name: value.detach().clone() for name, value in model.named_parameters()}
    a, b = one_step, identify(model, brief, ["youngs_modulus"], iterations=1, exact_bench=True)
    assert a.parameters["youngs_modulus"] == b.parameters["youngs_modulus"]
    assert np.array_equal(a.frames_after[0], b.frames_after[0])
    assert all(torch.equal(value, before[name]) for name, value in model.named_parameters())


@pytest.mark.parametrize(("name", "remedy"), [("air.normal", "give air.density"), ("bending.stiffness", "give cloth")])
def test_an_effect_that_the_episode_does_not_bring_says_how(recording, name, remedy):
    bare = replace(recording, air_density=None, cloth=replace(recording.cloth, nominal={}))
    with pytest.raises(InvalidInput, match=remedy):
        identify(build_cloth(bare), bare, [name])


def test_the_density_was_weighed_wherever_the_fit_starts(recording):
    made = recording
    cloth = build_cloth_at(made)
    cloth.areal_density.set(1.3 * made.cloth.areal_density)
    result = identify(cloth, made, ["youngs_modulus", "air.normal"], exact_bench=True).parameters["areal_density"]
    assert result.value == pytest.approx(made.cloth.areal_density, abs=3 * made.cloth.areal_density_std)


@pytest.mark.parametrize("method", ["gauss-newton", "adam"])
def test_a_fit_takes_gradients_of_its_own(model, brief, one_step, method):
    """Whatever its caller wants of his tensors, as where a trainer validates."""
    ask = lambda: identify(model, brief, ["youngs_modulus"], method=method, iterations=1, exact_bench=True)  # noqa: E731
    wanted = (one_step if method == "gauss-newton" else ask()).parameters["youngs_modulus"]
    for mode in (torch.no_grad, torch.inference_mode, lambda: torch.autocast("cpu", torch.bfloat16)):
        with mode():
            result = ask().parameters["youngs_modulus"]
        assert (result.value, result.std) == (wanted.value, wanted.std)


def test_a_path_is_no_recording(model, tmp_path):
    for given in ("episodes/one", tmp_path, ["episodes/one"]):
        with pytest.raises(InvalidInput, match=r"recording; got '.*'; expected a Recording; read it: "):
            identify(model, given)


def test_a_cloth_on_another_device_is_refused(recording):
    """Tensors without numbers stand for a GPU's."""
    cloth = build_cloth_at(recording).to("meta")
    for ask in (
        lambda: identify(cloth, recording, ["youngs_modulus"], exact_bench=True),
        lambda: fit_fields(cloth, recording, ["youngs_modulus"]),
        lambda: tc.estimate_pose(cloth, recording),
    ):
        with pytest.raises(InvalidInput, match=r"cloth; got on meta; expected a cloth on the CPU; cloth.cpu\(\)"):
            ask()
