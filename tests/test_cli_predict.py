"""``torchcloth predict`` as a user meets it."""

import json
import re

import numpy as np
import pytest
import torch
from helpers import off_axis_strips, twins

from torchcloth import recordings
from torchcloth.cli import main
from torchcloth.identification import fit_tension, identify


@pytest.fixture(scope="module")
def strips(tmp_path_factory):
    """Folder of a fit of three directions."""
    torch.set_default_dtype(torch.float64)
    draw = np.random.default_rng(0)
    tables = [off_axis_strips.make_readings(a, 0.02, draw, count=12) for a in (0, 45, 90)]
    folder = tmp_path_factory.mktemp("fits") / "strips"
    fit_tension(off_axis_strips.make_start_cloth(), tables, off_axis_strips.MODULUS_NAMES).save(folder)
    return folder


@pytest.fixture(scope="module")
def swing(tmp_path_factory):
    """Folder of a fit of an episode, and another episode on disk."""
    folder = tmp_path_factory.mktemp("episodes")
    with twins.use_float64():
        fitted = twins.take_first_frames(twins.make_twin(), 6)
        cloth = twins.build_cloth_at(fitted)
        identify(cloth, fitted, ["youngs_modulus"], iterations=2, exact_bench=True).save(folder / "fit")
        other = recordings.write(twins.take_first_frames(twins.make_twin(seed=1, amplitude=0.05), 6), folder / "other")
    return folder / "fit", other


def test_a_strip_at_any_angle(strips, tmp_path, capsys):
    """The table, the JSON and the picture; the closed form is inside."""
    out = tmp_path / "out"
    assert main(["predict", str(strips), "--angle", "30", "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    for word in ("Strip at 30 degrees", "by parameters", "by the misfit", "95 % interval", "note: the law's part"):
        assert word in printed
    content = json.loads((out / "prediction.json").read_text())
    low, high = np.array(content["force"]["ci95"])
    truth = off_axis_strips.off_axis_modulus(30) * off_axis_strips.THICKNESS_M * 0.02 * np.array(content["strain"])
    assert ((low <= truth) & (truth <= high)).all()
    assert content["measured"] == {}
    assert (out / "prediction.png").stat().st_size > 5000
    assert "replaced" not in printed
    assert main(["predict", str(strips), "--angle", "45", "--out", str(out)]) == 0
    assert "prediction.json (the earlier one was replaced)" in capsys.readouterr().out


def test_a_table_is_predicted_and_compared_with(strips, tmp_path, capsys):
    table = off_axis_strips.make_readings(60, 0.02, np.random.default_rng(1), count=12)
    place = recordings.write_tension(table, tmp_path / "table")
    assert main(["predict", str(strips / "tension.json"), str(place)]) == 0
    assert "of the readings inside" in capsys.readouterr().out
    content = json.loads((strips / "prediction" / "prediction.json").read_text())
    assert content["specimen"]["angle"] == pytest.approx(60)
    assert content["measured"]["force"]["rms"] < 0.05


def test_another_episode(swing, tmp_path, capsys):
    fit, other = swing
    out = tmp_path / "out"
    assert main(["predict", str(fit), str(other), "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    for word in ("by parameters", "together:", "of them are", "null: carried rigidly", "predicted"):
        assert word in printed
    content = json.loads((out / "prediction.json").read_text())
    assert content["measured"]["rms"] < 0.5 * content["measured"]["rms_null"]
    with np.load(out / "prediction.npz") as file:
        assert file["vertices"].shape == (6, 49, 3)
        assert file["std"].shape == (6, 49)
    assert (out / "prediction.png").exists()
    assert "used this episode" not in printed


def test_the_fitted_episode_is_no_prediction(swing, tmp_path, capsys):
    with twins.use_float64():
        place = recordings.write(twins.take_first_frames(twins.make_twin(), 6), tmp_path / "same")
    assert main(["predict", str(swing[0]), str(place), "--out", str(tmp_path / "out")]) == 0
    assert "the fit used this episode" in capsys.readouterr().out


def test_wrong_input_is_one_line(strips, swing, tmp_path, capsys):
    fit, other = swing
    (tmp_path / "file").write_text("")
    model = tmp_path / "m.tcm"
    model.touch()
    table = recordings.write_tension(
        off_axis_strips.make_readings(60, 0.0, np.random.default_rng(1)), tmp_path / "table"
    )
    wrong = {
        ("nothing", "--angle", "30"): "FIT; got .*nothing; expected tension.json, identification.json or",
        (strips,): "--angle; got none; expected degrees",
        (strips, "--angle", "1000"): "angle; got 1000 degrees; expected -180 to 180",
        (strips, "--angle", "30", "--length", "-1"): "length; got -1.0",
        (strips, table, "--angle", "30"): "DATA; got a table and a strip's numbers; expected one of them",
        (strips, other): "FIT; got tension.json with an episode to predict; expected identification.json",
        (
            fit,
            "--angle",
            "30",
        ): "with a strip to predict; expected tension.json; tables and --angle, .* need a fit of t",
        (fit, other, "--angle", "30"): "got identification.json with a strip to predict; expected tension.json",
        (fit, other, "--length", "-1", "--strain", "nan"): "got identification.json with a strip to predict",
        (fit, other, "--width", "0.02"): "got identification.json with a strip to predict",
        (fit, other, "--preload", "0"): "got identification.json with a strip to predict",
        (model, other, "--angle", "30"): "got m.tcm with a strip to predict; expected tension.json",
        (fit,): "DATA; got none; expected an episode",
        (fit, tmp_path / "no"): "no",
        (fit / "run1.json", other): "FIT; got .*run1.json; expected tension.json, identification.json or the folder",
        (fit / "deep", other): "FIT; got .*deep; expected",
    }
    for k, (arguments, said) in enumerate(wrong.items()):
        out = tmp_path / f"out{k}"
        assert main(["predict", *map(str, arguments), "--out", str(out)]) == 2, arguments
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        assert "Traceback" not in error
        assert re.search(said, error), error
        assert not out.exists()
    assert main(["predict", str(strips), "--angle", "3", "--out", str(tmp_path / "file")]) == 2
