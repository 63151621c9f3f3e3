"""The study of pose estimation, reduced, with the other engine in a process of its own."""

import json

import pytest

from torchcloth.training.studies.command import main


@pytest.mark.slow
def test_reduced(tmp_path, capsys):
    assert main(["pose", "--fast", "--out", str(tmp_path / "s")]) == 0
    cases = {path.stem: json.loads(path.read_text()) for path in (tmp_path / "s" / "cases").iterdir()}
    right, wrong = (cases[f"swing-fast, {name}"] for name in ("true values", "wrong by 2, taken as exact"))
    for case in (right, wrong):
        assert case["estimated"]["hidden"] < 0.7 * case["simulated"]["hidden"]
    carried = cases["swing-fast, geometry"]["carried rigidly"]
    assert wrong["estimated"]["hidden"] < 0.3 * carried["hidden"]
    assert any("the model is wrong" in warning for warning in wrong["estimated"]["warnings"])
    table = (tmp_path / "s" / "table.md").read_text()
    assert table.count("\n") == 2 + 3 + 2 * 2
    assert "registered frame by frame" in capsys.readouterr().out
