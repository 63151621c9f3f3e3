"""A force that is learned for an effect outside the catalogue, and none where nothing is missing."""

import json

import pytest
import torch
from helpers import sheet_episodes

from torchcloth.diagnosis import (
    build_base_model,
    diagnose,
    fit,
    learn_residual_force,
    list_hypotheses,
    load_model,
    prepare_data,
    save_model,
    write_diagnosis,
)
from torchcloth.diagnosis.inference.lack_of_fit import has_lack_of_fit
from torchcloth.diagnosis.unknown.residual_force import RESIDUAL_EFFECT_PREFIX, RESIDUAL_HYPOTHESES
from torchcloth.effects import AirDrag

HIDDEN = 1.5  # C_n, of air
MOTIONS = ("slow", "fast")


def recorded(change, seed):
    return [sheet_episodes.record_changed_world(motion, change, seed + k) for k, motion in enumerate(MOTIONS)]


@pytest.fixture(scope="module")
def without_air():
    """A catalogue that knows nothing of air, before cloth in air."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    recordings = recorded(lambda world: world.with_cloth({"air": AirDrag(HIDDEN)}), 0)
    known = [h for h in list_hypotheses(build_base_model(recordings[0]), recordings) if h.name == "rest.skew"]
    yield recordings, diagnose(recordings, hypotheses=known)
    torch.set_default_dtype(before)


@pytest.mark.slow
def test_it_predicts_motions_that_were_held_out(without_air):
    _, answer = without_air
    assert answer.verdict == "unexplained"
    assert answer.residual_force.gain.rms_after < 0.4 * answer.residual_force.gain.rms_before
    told = answer.content["residual_force"]
    assert "opposes motion across the cloth" in told["terms"][0]["description"]
    assert [step["accepted"] for step in told["path"]] == list(answer.residual_force.terms)
    assert "It names no cause." in answer.summary()
    assert answer.content["causes"] == []


@pytest.mark.slow
def test_laws_are_asked_about_until_nothing_is_lacking(without_air):
    _, answer = without_air
    found = answer.residual_force.search
    assert has_lack_of_fit(found.start, found.data.motions)
    assert bool(found.scores) == has_lack_of_fit(found.end, found.data.motions)


@pytest.mark.slow
def test_the_missing_force_takes_power(without_air):
    _, answer = without_air
    fast = answer.missing_force.motions[1]
    velocity = torch.gradient(fast.x, spacing=(fast.windows.mean(1),), dim=0)[0]
    assert float((fast.force * velocity * answer.missing_force.area[:, None]).sum()) < 0


@pytest.mark.slow
def test_it_is_written_with_the_answer(without_air, tmp_path):
    recordings, answer = without_air
    write_diagnosis(answer, recordings, tmp_path)
    content = json.loads((tmp_path / "diagnosis.json").read_text())
    assert {row["kind"] for row in content["lack_of_fit"]} == {"points", "edges"}
    assert len(content["missing_force"]["motions"]) == len(MOTIONS)
    assert "The force that is missing" in (tmp_path / "report.html").read_text()
    loaded = load_model(tmp_path / content["model"])
    assert torch.equal(loaded.point, answer.residual_force.model.point)


def test_it_is_kept_with_the_model_and_can_be_left_out(tmp_path):
    recording = sheet_episodes.make_episode()
    plain = build_base_model(recording)
    terms = {"across2": 0.8, "mass@edge": 0.05}
    extended = plain.at_point(plain.point + 0.1)
    for term in RESIDUAL_HYPOTHESES:
        name = term.name.removeprefix(f"{RESIDUAL_EFFECT_PREFIX}.")
        extended = extended.with_hypothesis(term, terms[name]) if name in terms else extended
    path = save_model(tmp_path / "m.tcm", plain, recording, residual=extended)
    loaded, left_out = load_model(path), load_model(path, residual=False)
    own = loaded.build_world().cloth.effects[RESIDUAL_EFFECT_PREFIX]
    assert dict(zip(own.terms, own.strength.value.tolist(), strict=True)) == pytest.approx(terms)
    assert torch.equal(loaded.coordinates, extended.coordinates)
    assert RESIDUAL_EFFECT_PREFIX not in left_out.build_world().cloth.effects
    assert torch.equal(left_out.coordinates, plain.coordinates)


@pytest.mark.slow
def test_a_force_that_is_missing_is_learned():
    """Air, of which the model has none, and nothing else; with an answer around it: the slow tests."""
    recordings = recorded(lambda world: world.with_cloth({"air": AirDrag(HIDDEN)}), 0)
    model = build_base_model(recordings[0])
    setting = prepare_data(model, recordings)
    residual = learn_residual_force(fit(model, setting), setting)
    assert residual.terms
    assert all(name.startswith("across") for name in residual.terms)
    assert residual.gain.rms_after < 0.5 * residual.gain.rms_before


@pytest.mark.slow
def test_where_nothing_is_missing_nothing_is_learned():
    recordings = recorded(lambda world: world, 20)
    model = build_base_model(recordings[0])
    setting = prepare_data(model, recordings)
    residual = learn_residual_force(fit(model, setting), setting)
    assert residual.terms == {}
    assert residual.gain is None
