"""A fit on disk is the model that was fitted: its simulation repeats."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import twins

from torchcloth import recordings
from torchcloth.dynamics.contact import Contact
from torchcloth.effects import AirDrag, Gravity
from torchcloth.errors import InvalidInput, RecordingError, UnstableStep
from torchcloth.export import export_fit
from torchcloth.identification import build_cloth, identify, load_fitted_cloth, predict_episode, replay_fit
from torchcloth.identification.io.saved_fit import read_saved_fit
from torchcloth.identification.io.unrecorded_settings import find_unrecorded_settings


def test_the_frames_of_the_fit_come_back(pair, recording, tmp_path):
    pair.save(tmp_path)
    again = replay_fit(tmp_path, recording)
    torch.testing.assert_close(again.frames, pair.frames_after[0], rtol=0, atol=1e-9)
    assert float(again.chamfer.mean()) == pytest.approx(pair.fit["chamfer_after"], rel=1e-6)
    assert again.warning == ""


def test_start_values_that_were_not_fitted_are_kept(pair, tmp_path):
    """`pair` fits stiffness and air; the rest is the data sheet's."""
    pair.save(tmp_path)
    values = read_saved_fit(tmp_path / "identification.json").values
    assert values["poisson_ratio"] == pytest.approx(twins.NOMINAL_FABRIC.poisson)
    assert values["bending.damping_time"] == pytest.approx(twins.NOMINAL_FABRIC.damping_time)
    assert values["youngs_modulus"] == pair.parameters["youngs_modulus"].value != pytest.approx(2e4)


def test_what_the_data_left_open_is_uncertain_and_not_exact(pair, recording, tmp_path):
    path = pair.save(tmp_path)
    _, known = load_fitted_cloth(path, recording)
    assert known.keys() == pair.keys.keys()
    content = json.loads(path.read_text())
    content["parameters"]["youngs_modulus"] |= {"identifiable": False, "std": 2.3 * known["youngs_modulus"][0]}
    path.write_text(json.dumps(content))
    _, unknown = load_fitted_cloth(path, recording)
    assert unknown["youngs_modulus"] == pytest.approx((known["youngs_modulus"][0], 10.0), rel=0.01)
    assert unknown["air.normal"] == known["air.normal"]


def test_an_export_says_what_is_no_estimate(pair, recording, tmp_path):
    path = pair.save(tmp_path)
    assert not any("no estimate" in note for note in export_fit(path, "mujoco", recording=recording).notes)
    content = json.loads(path.read_text())
    content["parameters"]["youngs_modulus"]["identifiable"] = False
    path.write_text(json.dumps(content))
    export = export_fit(path, "mujoco", recording=recording)
    assert export.notes[0].startswith("no estimate of youngs_modulus:")
    assert "no estimate of youngs_modulus:" in export.text


def test_points_may_have_been_rounded_on_disk(pair, recording, tmp_path):
    """Fitted in memory, viewed from a folder whose points are in tenths of a millimetre."""
    path = recordings.write(recording, tmp_path / "episode")
    again = replay_fit(pair.save(tmp_path), recordings.read(path))
    assert np.allclose(again.frames, pair.frames_after[0], atol=1e-6)
    assert again.was_fitted
    assert again.warning == ""
    assert float(again.chamfer.mean()) == pytest.approx(pair.fit["chamfer_after"], abs=1e-5)


def test_contact_and_step_are_kept(brief, tmp_path):
    """As they were given: the simulation with other ones would be another."""
    cloth = build_cloth(brief, contact=Contact(0.05, damping=0.2, free_compression=0.1))
    fit = identify(cloth, brief, ["youngs_modulus"], iterations=1, dt=1e-4, exact_bench=True)
    again = replay_fit(fit.save(tmp_path), brief)
    assert again.cloth.contact == Contact(0.05, damping=0.2, free_compression=0.1)
    torch.testing.assert_close(again.frames, fit.frames_after[0], rtol=0, atol=1e-9)
    assert json.loads((tmp_path / "identification.json").read_text())["model"]["dt"] == 1e-4


def test_another_thickness_is_another_fabric(pair, recording, tmp_path):
    """Moduli [Pa] of one thickness had been taken for those of another: with twice of it, twice as stiff."""
    path = pair.save(tmp_path)
    thick = replace(recording, cloth=replace(recording.cloth, thickness=2e-3))
    with pytest.raises(InvalidInput, match=r"another thickness; got 0.002 m in the episode, 0.001 m in the fit"):
        replay_fit(path, thick)


@pytest.mark.parametrize(
    ("schema", "said"), [(None, "got none"), ("torchcloth.identification/0", "got 'torchcloth.identification/0'")]
)
def test_a_file_of_another_schema_is_refused(pair, recording, tmp_path, schema, said):
    path = pair.save(tmp_path)
    content = json.loads(path.read_text())
    del content["schema"]
    path.write_text(json.dumps(content if schema is None else {"schema": schema, **content}))
    with pytest.raises(RecordingError, match=f"schema; {said}; expected 'torchcloth.identification/1'"):
        replay_fit(path, recording)


def test_the_right_one_of_several_episodes_is_found(recording, brief, tmp_path):
    fit = identify(twins.build_cloth_at(brief), [brief, recording], ["youngs_modulus"], iterations=1, exact_bench=True)
    fit.save(tmp_path)
    for number, one in enumerate((brief, recording)):
        again = replay_fit(tmp_path, one)
        torch.testing.assert_close(again.frames, fit.frames_after[number], rtol=0, atol=1e-9)
        assert again.warning == ""
        assert again.was_fitted
    again = replay_fit(tmp_path, twins.take_first_frames(recording, 5))
    assert not again.was_fitted
    assert again.warning == ""


def leaning(cloth):
    return Gravity(cloth.effects["gravity"].acceleration.tolist(), [0.03, 0.0])


def blown(cloth):
    return AirDrag(1.2, density=cloth.effects["air"].density, wind=(0.3, 0.0, 0.0))


@pytest.mark.parametrize(
    ("key", "part", "said"), [("gravity", leaning, "effects.gravity.tilt"), ("air", blown, "effects.air.wind")]
)
def test_what_no_episode_describes_is_not_left_out_silently(brief, tmp_path, key, part, said):
    """A diagnosis has found a tilt or a wind, and the fabric is fitted anew beside it."""
    cloth = twins.build_cloth_at(brief)
    cloth.effects[key] = part(cloth)
    identify(cloth, brief, ["youngs_modulus"], iterations=1, exact_bench=True).save(tmp_path)
    for read in (load_fitted_cloth, predict_episode, replay_fit):
        with pytest.raises(InvalidInput, match=f"a fit of another model; got {said} not alike in both"):
            read(tmp_path, brief)


def test_precision_and_mesh_are_no_other_model(brief):
    assert find_unrecorded_settings(twins.build_cloth_at(brief).double(), brief) == []
    assert find_unrecorded_settings(build_cloth(brief, contact=Contact(0.05)), brief) == []
    finer = replace(brief, cloth=replace(brief.cloth, vertices=None, faces=None, sheet=(0.3, 0.3)))
    assert find_unrecorded_settings(twins.build_cloth_at(brief), finer) == []
    thin = build_cloth(replace(brief, cloth=replace(brief.cloth, thickness=5e-4)))
    assert find_unrecorded_settings(thin, brief) == ["material.thickness"]
    nothing = replace(brief, cloth=replace(brief.cloth, vertices=None, faces=None, sheet=None))
    assert find_unrecorded_settings(thin, nothing) == []


@pytest.mark.parametrize("damage", ["a word", None, float("nan"), -1.0])
def test_a_damaged_error_is_refused_by_all_that_read_it(pair, recording, tmp_path, damage):
    """A prediction and a pose would take it for something else each."""
    path = pair.save(tmp_path)
    content = json.loads(path.read_text())
    content["parameters"]["youngs_modulus"]["std"] = damage
    path.write_text(json.dumps(content))
    for read in (load_fitted_cloth, predict_episode, replay_fit):
        with pytest.raises(RecordingError, match="does not say which model was fitted; got"):
            read(path, recording)


def put(*path, value):
    def change(content):
        for key in path[:-1]:
            content = content[key]
        content[path[-1]] = value

    return change


CONTACT = {"spacing": 0.05, "subdivisions": None, "damping": 0.1, "free_compression": 0.2, "everywhere": False}
DAMAGE = {
    "deep": (lambda content: "[" * 200_000, "unreadable; got .*recursion"),
    "a number of 400 digits": (put("model", "values", "youngs_modulus", value=10**400), "youngs_modulus 1000.*0000 wh"),
    "a fabric of nothing": (put("model", "values", "youngs_modulus", value=1e40), "youngs_modulus 1e.40, beyond every"),
    "a number that is none": (put("model", "values", "youngs_modulus", value=True), "youngs_modulus True where"),
    "contact spacing a word": (put("model", "contact", value={**CONTACT, "spacing": "x"}), "contact.spacing 'x' where"),
    "contact without width": (put("model", "contact", value={**CONTACT, "spacing": 0}), "contact spacing 0 where"),
    "contact of halves": (put("model", "contact", value={**CONTACT, "subdivisions": 2.5}), "subdivisions"),
    "contact that plays": (
        put("model", "contact", value={**CONTACT, "free_compression": 2.0}),
        "contact free_compression; got 2.0",
    ),
    "contact of nothing": (put("model", "contact", value={"gap": 0.1}), "unexpected keyword argument 'gap'"),
    "no correlation": (put("correlation", value={}), "no fitted parameter in correlation"),
    "no step": (put("model", "dt", value=0), "dt 0 where"),
    "a step back": (put("model", "dt", value=-1.0), "dt -1.0 where"),
    "a step without end": (put("model", "dt", value=1e-14), "dt 1e-14 where"),
    "frames of a word": (put("model", "episodes", 0, "frames", value="x"), "frames 'x' where"),
    "mean of nothing": (put("model", "episodes", 0, "mean", value=[float("nan")] * 3), "mean nan where"),
    "no model": (lambda content: content.pop("model") and None, "got no 'model'"),
}


@pytest.mark.parametrize("case", DAMAGE)
def test_damage_is_one_line_that_names_the_file(pair, recording, tmp_path, case):
    change, said = DAMAGE[case]
    path = pair.save(tmp_path)
    content = json.loads(path.read_text())
    path.write_text(change(content) or json.dumps(content))
    for read in (load_fitted_cloth, predict_episode, replay_fit):
        with pytest.raises(RecordingError, match=said) as caught:
            read(path, recording)
        assert str(caught.value).startswith(f"{path}: ")
        assert str(caught.value).endswith("run `torchcloth identify` again")


def test_a_step_that_is_too_long_for_an_episode_is_the_files(pair, recording, tmp_path):
    path = pair.save(tmp_path)
    content = json.loads(path.read_text())
    content["model"]["dt"] = 0.5
    path.write_text(json.dumps(content))
    for read in (predict_episode, replay_fit):
        with pytest.raises(UnstableStep, match=r"identification.json: dt; got 0.5 s; .*fit again without --dt"):
            read(path, recording)


def test_a_value_that_cannot_be_is_refused_by_name(pair, recording, tmp_path):
    path = pair.save(tmp_path)
    content = json.loads(path.read_text())
    content["model"]["values"]["youngs_modulus"] = -1.0
    path.write_text(json.dumps(content))
    for read in (load_fitted_cloth, predict_episode, replay_fit):
        with pytest.raises(RecordingError, match=r"identification.json: .*got -1 Pa"):
            read(path, recording)


def test_a_folder_of_models_is_named_as_such(tmp_path):
    with pytest.raises(
        InvalidInput, match=r"no .*identification.json; expected identification.json, or the folder .*it$"
    ):
        read_saved_fit(tmp_path)
    (tmp_path / "extended.tcm").touch()
    with pytest.raises(InvalidInput, match=r"or a model: .*extended\.tcm$"):
        read_saved_fit(tmp_path)
