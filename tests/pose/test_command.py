"""``torchcloth pose``: files, table, refusals."""

import json

import numpy as np
import pytest
from helpers import twins

from torchcloth import recordings
from torchcloth.cli import main
from torchcloth.identification import identify, load_fitted_cloth


@pytest.fixture(scope="module")
def folder(scene, tmp_path_factory):
    return recordings.write(twins.take_first_frames(scene.recording, 5), tmp_path_factory.mktemp("pose") / "episode")


def test_writes_what_it_found(folder, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["pose", str(folder), "--out", str(out), "--modes", "2", "--uncertainty", "youngs_modulus=2"]) == 0
    arrays, words = np.load(out / "pose.npz"), json.loads((out / "pose.json").read_text())
    assert arrays["x"].shape == arrays["std"].shape == (5, 49, 3)
    assert arrays["seen"].shape == (5, 49)
    assert arrays["seen"].dtype == bool
    assert len(words["force_fractions"]) == len(arrays["windows"]) == len(arrays["acceleration"])
    assert words["parameters"]["youngs_modulus"]["unit"] == "Pa"
    assert (out / "pose.png").stat().st_size > 10_000
    assert sorted(file.name for file in out.iterdir()) == ["pose.json", "pose.npz", "pose.png"]
    printed = capsys.readouterr().out
    assert "corrective force" in printed
    assert "hidden" in printed


def test_takes_a_fit(scene, folder, tmp_path):
    short = twins.take_first_frames(scene.recording, 5)
    fit = identify(twins.build_cloth_at(short), short, ["youngs_modulus"], iterations=2, exact_bench=True)
    fit.save(tmp_path)
    other = twins.take_first_frames(scene.recording, 7)  # not the fitted episode
    cloth, uncertain = load_fitted_cloth(tmp_path, other)
    result = fit.parameters["youngs_modulus"]
    assert cloth.material.youngs_modulus.value.item() == pytest.approx(result.value)
    assert result.identifiable
    assert set(uncertain) == {"youngs_modulus", "areal_density"}  # the second as it was weighed
    value, factor = uncertain["youngs_modulus"]
    assert value * (factor - 1) == pytest.approx(result.std, rel=0.1)


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--fit", "nowhere"], "nowhere"),
        (["--uncertainty", "colour=2"], "got 'colour'"),
        (["--uncertainty", "youngs_modulus=0.5"], "prior of youngs_modulus; got (79999"),
        (["--uncertainty", "youngs_modulus=2", "youngs_modulus=3"], "got 'youngs_modulus' twice"),
        (["--modes", "0"], "modes; got 0"),
        (["--window", "-1"], "window; got -1"),
        (["--truth"], "truth"),
    ],
    ids=lambda value: "-".join(value) if isinstance(value, list) else "",
)
def test_refusals(folder, tmp_path, capsys, more, said):
    out = tmp_path / "out"
    assert main(["pose", str(folder), "--out", str(out), *more]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert said in error
    assert not out.exists()


def test_out_is_a_file(folder, tmp_path, capsys):
    (tmp_path / "file").write_text("mine")
    assert main(["pose", str(folder), "--out", str(tmp_path / "file")]) == 2
    assert (tmp_path / "file").read_text() == "mine"
