"""What the study of screening's parts counts, and that it runs (slow)."""

import json

import pytest

from torchcloth.training.studies import parts
from torchcloth.training.studies.command import main


def row(effect, amplitude, decision="present"):
    return {"effect": effect, "amplitude": amplitude, "std": 0.1, "decision": decision}


def hidden(name, amplitude, beside=False):
    own = name.partition("[")[0]
    return {"names": [own], "hypothesis": name, "amplitude": amplitude, "sign": 1.0, "beside": beside}


def test_what_is_present_and_not_there_is_counted_beside_the_size_of_what_is():
    ways = {"one": [row("air.wind[x]", 0.33), row("air.drag_n", 1.0), row("mass.hem", 0.1), row("obs.clock", 1, "no")]}
    case = {"hidden": [hidden("air.drag_n", 1.2, beside=True), hidden("air.wind[x]", 0.3)], "ways": ways}
    assert parts._counted(case, "one") == "1 (1.10)"
    assert parts._counted({**case, "hidden": []}, "one") == "3"
    assert parts._counted({**case, "ways": {"one": []}}, "one") == "0 (–)"


def test_a_wrong_number_of_jobs_is_refused(tmp_path, capsys):
    assert main(["parts", "--jobs", "0", "--out", str(tmp_path / "p")]) == 2
    assert "--jobs" in capsys.readouterr().err
    assert not (tmp_path / "p").exists()


@pytest.mark.slow
def test_a_null_and_a_drag_are_screened_in_all_ways(tmp_path, capsys):
    pytest.importorskip("mujoco", minversion="4.0")
    assert main(["parts", "--fast", "--out", str(tmp_path / "p")]) == 0
    null, drag = json.loads((tmp_path / "p" / "parts.json").read_text())
    assert null["hidden"] == []
    assert [e["hypothesis"] for e in drag["hidden"]] == ["air.drag_n"]
    assert not [r for r in null["ways"][parts.ALL] if r["decision"] == "present"]
    assert any(r["effect"] == "air.drag_n" and r["decision"] == "present" for r in drag["ways"][parts.ALL])
    assert len(drag["ways"]) == 7
    assert "by tangents" in capsys.readouterr().out
