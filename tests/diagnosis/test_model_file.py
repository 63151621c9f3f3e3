"""A model file that is damaged inside, though its zip is sound: one line that names the file and the place."""

import io
import json
import re
import zipfile
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import sheet_episodes

from torchcloth import recordings as rec
from torchcloth.cli import main
from torchcloth.diagnosis import build_base_model, list_hypotheses, read_model, save_model
from torchcloth.errors import RecordingError
from torchcloth.identification.io.saved_fit import fingerprint

RECORDING = sheet_episodes.make_episode(resolution=(4, 4))


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    """A file with a cause, a covariance, a residual force's numbers, and the mark of an episode."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    base = build_base_model(RECORDING)
    by = {h.name: h for h in list_hypotheses(base, [RECORDING])}
    model = base.with_hypothesis(by["air.drag_n"], 1.5)
    covariance = torch.eye(6, dtype=torch.float64)
    path = tmp_path_factory.mktemp("model") / "sound.tcm"
    yield save_model(
        path, model, RECORDING, covariance, model.with_hypothesis(by["obs.clock"], 0.01), [fingerprint(RECORDING)]
    )
    torch.set_default_dtype(before)


def spoiled(sound, target, change, mesh=lambda arrays: arrays):
    """The file with other content; ``change`` works on the content, or returns the text."""
    with zipfile.ZipFile(sound) as file:
        content, arrays = json.loads(file.read("model.json")), dict(np.load(io.BytesIO(file.read("mesh.npz"))))
    text, buffer = change(content), io.BytesIO()
    np.savez(buffer, **mesh(arrays))
    with zipfile.ZipFile(target, "w") as file:
        file.writestr("model.json", text if isinstance(text, str) else json.dumps(content))
        file.writestr("mesh.npz", buffer.getvalue())
    return target


def put(*path, value):
    """A change of one entry; ``del`` takes it out."""

    def change(content):
        for key in path[:-1]:
            content = content[key]
        if value is None:
            del content[path[-1]]
        else:
            content[path[-1]] = value

    return change


DAMAGE = {
    "another format": (put("format", value=9), r"format; got 9; expected 2; update torchcloth$"),
    "an old format": (put("format", value=1), r"format; got 1; expected 2; run `torchcloth diagnose` again"),
    "no format": (put("format", value=None), "format is missing"),
    "deep": (lambda content: "[" * 200_000, "not valid JSON"),
    "a list": (lambda content: "[]", "not an object of named values"),
    "NaN": (put("parameters", "youngs_modulus", "coordinate", value=float("nan")), "NaN is no JSON number"),
    "parameter missing": (put("parameters", "youngs_modulus", value=None), "parameters; got youngs_modulus in only"),
    "parameter of nothing": (put("parameters", "colour", value={"coordinate": 1.0}), "got colour in only one"),
    "parameters a list": (put("parameters", value=[]), "parameters is not an object of named values"),
    "coordinate far away": (put("parameters", "youngs_modulus", "coordinate", value=1e6), "a coordinate of 1e"),
    "coordinate of 400 digits": (put("parameters", "youngs_modulus", "coordinate", value=10**400), "not a finite num"),
    "coordinate a word": (put("parameters", "youngs_modulus", "coordinate", value="x"), "not a finite number; got 'x'"),
    "residual's parameters": (put("residual", "parameters", value=[]), "residual.parameters is not an object"),
    "causes an object": (put("causes", value={}), "causes is not a list"),
    "cause without amplitude": (put("causes", 0, "amplitude", value=None), r"causes\[0\].amplitude is missing"),
    "amplitude of no world": (put("residual", "causes", 0, "amplitude", value=-1.0), "got -1"),
    "covariance ragged": (put("covariance", value=[[1, 2], [3]]), "covariance is not a rectangular array"),
    "covariance small": (put("covariance", value=[[1.0]]), r"covariance has the wrong shape; got \[1, 1\]; .*\[6, 6\]"),
    "variance negative": (put("covariance", 0, 0, value=-1.0), "covariance has a negative variance"),
    "gravity a word": (put("cloth", "gravity", value="down"), "cloth.gravity has the wrong dtype"),
    "density negative": (put("cloth", "areal_density", value=-1.0), "cloth.areal_density is too small"),
    "grasps a list": (put("cloth", "grasps", value=[]), "cloth.grasps is not an object"),
    "grasp without radius": (put("cloth", "grasps", "left", "radius", value=None), "cloth.grasps.left.radius is miss"),
    "collider flat": (put("cloth", "colliders", value={"t": {"point": [0, 0, 0], "normal": [0, 0, 0]}}), "not unit"),
    "nominal a word": (put("cloth", "nominal", value={"membrane_stiffness": "soft"}), "membrane_stiffness.*'soft'"),
    "mark of nothing": (put("episodes", value=[{"x": 1}]), r"episodes\[0\].frames is missing"),
}


def test_friction_ends_where_there_is_none_also_when_it_comes_from_a_file(tmp_path):
    table = {"table": rec.Collider(np.zeros(3), np.array([0.0, 0.0, 1.0]), 0.3)}
    base = build_base_model(on := replace(RECORDING, colliders=table))
    (cause,) = (h for h in list_hypotheses(base, [on]) if h.name == "contact.mu")
    path = save_model(tmp_path / "m.tcm", base.with_hypothesis(cause, 0.2), on)
    (again,) = read_model(path, on).model.accepted
    assert again.min_amplitude == cause.min_amplitude == pytest.approx(-0.299)


@pytest.mark.parametrize("case", DAMAGE)
@pytest.mark.parametrize("elsewhere", [False, True], ids=["own scene", "another scene"])
def test_damage_is_one_line_that_names_the_file(sound, tmp_path, case, elsewhere):
    change, said = DAMAGE[case]
    path = spoiled(sound, tmp_path / "m.tcm", change)
    with pytest.raises(RecordingError, match=said) as caught:
        read_model(path, RECORDING if elsewhere else None)
    assert str(caught.value).startswith(str(path))
    assert re.search("torchcloth diagnose|update torchcloth", str(caught.value))


MESHES = {
    "no faces": (lambda a: {k: v for k, v in a.items() if k != "faces"}, "mesh.npz: faces is missing"),
    "faces of nothing": (lambda a: a | {"faces": a["faces"] + 1000}, "faces"),
    "NaN": (lambda a: a | {"vertices": np.nan * a["vertices"]}, "vertices is not finite"),
    "pattern of another mesh": (lambda a: a | {"uv": a["uv"][:3]}, "uv"),
}


@pytest.mark.parametrize("case", MESHES)
def test_a_damaged_mesh_is_refused_also_where_another_takes_its_place(sound, tmp_path, case):
    path = spoiled(sound, tmp_path / "m.tcm", lambda content: None, MESHES[case][0])
    with pytest.raises(RecordingError, match=f"m.tcm.*{MESHES[case][1]}"):
        read_model(path, RECORDING)


def test_what_is_sound_is_read(sound, tmp_path):
    """With the residual's numbers or without, and as older versions wrote it."""
    whole, part = read_model(sound), read_model(sound, residual=False)
    assert [h.name for h in whole.model.accepted] == ["air.drag_n", "obs.clock"]
    assert [h.name for h in part.model.accepted] == ["air.drag_n"]
    assert whole.covariance.shape == (6, 6)
    assert whole.episodes == [fingerprint(RECORDING)]
    assert whole.scene.grasps["left"].radius == RECORDING.grasps["left"].radius
    assert read_model(spoiled(sound, tmp_path / "old.tcm", put("episodes", value=None))).episodes == []


def test_verbs_say_it_in_one_line(sound, tmp_path, capsys):
    path = spoiled(sound, tmp_path / "m.tcm", put("parameters", value=[]))
    episode = rec.write(RECORDING, tmp_path / "episode")
    for verb in (["predict", path, episode], ["identify", episode, "--model", path], ["confirm", path, path, episode]):
        assert main([*map(str, verb), "--out", str(tmp_path / "out")]) == 2
        said = capsys.readouterr().err
        assert said.startswith(f"torchcloth: {path}/model.json: parameters is not an object")
        assert said.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_a_plain_number_may_be_as_large_as_it_was_fitted(tmp_path):
    base = build_base_model(RECORDING)
    k = [p.name for p in base.parameters].index("stiffening")
    values = base.coordinates.clone()
    values[k] = 15.0
    path = save_model(tmp_path / "m.tcm", replace(base, coordinates=values), RECORDING)
    assert read_model(path).model.coordinates[k] == 15.0
    values[0] = 15.0  # a logarithm
    path = save_model(tmp_path / "m.tcm", replace(base, coordinates=values), RECORDING)
    with pytest.raises(RecordingError, match="within 14"):
        read_model(path)
