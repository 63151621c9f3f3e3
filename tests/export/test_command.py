"""``torchcloth export`` and saved fits."""

import pytest
from helpers.command_line import refuse
from helpers.fuzz_seeds import make_model

from torchcloth import diagnosis
from torchcloth.cli import main
from torchcloth.export import export_fit


@pytest.fixture
def model_file(tmp_path):
    path = tmp_path / "model.tcm"
    path.write_bytes(make_model())
    return path


def test_a_model_file_needs_no_episode(model_file, tmp_path, capsys):
    out = tmp_path / "cloth.xml"
    assert main(["export", str(model_file), "--to", "mujoco", "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "flex/elasticity/young" in said
    assert "does not express" in said
    assert str(out) in said
    youngs = diagnosis.load(model_file).material.membrane_stiffness.item()
    assert f'name="membrane_stiffness" data="{youngs:.5g}' in out.read_text()


def test_causes_outside_the_cloth_are_said(model_file, monkeypatch):
    monkeypatch.setattr(diagnosis, "list_causes_outside_cloth", lambda _: {"obs.clock": 0.03})
    assert any("obs.clock" in note for note in export_fit(model_file, "newton").notes)


def test_a_file_that_is_no_fit_is_named(tmp_path, capsys):
    (tmp_path / "notes.json").write_text("{}")
    said = refuse(capsys, tmp_path / "cloth.json", "export", tmp_path / "notes.json", "--to", "newton")
    assert "notes.json" in said
    assert "EPISODE" not in said


def test_a_fit_without_its_episode_is_refused(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("torchcloth.export.write.read_saved_fit", lambda path: None)
    out = tmp_path / "new" / "cloth.json"
    said = refuse(capsys, out.parent / "cloth.json", "export", tmp_path, "--to", "newton")
    assert "EPISODE" in said


def test_a_suffix_of_another_format_is_refused(model_file, tmp_path, capsys):
    assert ".usda" in refuse(capsys, tmp_path / "cloth.txt", "export", model_file, "--to", "usd")


def test_a_missing_model_is_refused(tmp_path, capsys):
    refuse(capsys, tmp_path / "cloth.xml", "export", tmp_path / "none.tcm", "--to", "mujoco")
