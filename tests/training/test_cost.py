"""What a fit costs: two problems, three methods, one table."""

import json
import re

import pytest
import torch

from torchcloth.training.studies import command, cost
from torchcloth.training.studies.manipulations.scenes import Discretisation, Scene, manipulations, slowed


def call(out, *more):
    return command.main(["cost", "--out", str(out), "--fast", *more])


@pytest.mark.slow
def test_the_table_has_every_method_beside_the_others(tmp_path, capsys):
    assert call(tmp_path, "--problems", "sheet") == 0
    printed = capsys.readouterr().out
    results = json.loads((tmp_path / "cost.json").read_text())["cases"]
    assert list(results) == ["sheet-gauss-newton", "sheet-descent", "sheet-paper"]
    for case in results.values():
        assert case["method"] in printed
        assert case["processor"] > 0
        assert case["frames"] == 8
    newton, descent, paper = results.values()
    assert newton["chamfer_after"] <= descent["chamfer_after"] * 1.01
    assert abs(newton["youngs_modulus"] - 1) < 0.2 < abs(descent["youngs_modulus"] - 1)
    assert 1 < paper["youngs_modulus"] < 2.5  # of cells of 50 mm no fit has its vertices nearer than the rule's 15 mm
    assert call(tmp_path, "--problems", "sheet") == 0, "nothing is measured again"


def test_the_shirt_is_as_slow_as_asked():
    fine = Discretisation(130, 0.06)
    what = slowed(manipulations("shirt")[cost.DRAG_NUMBER], 3.0, fine)
    path = Scene(what, fine).action.motion["left"]
    assert float(path.t[-1]) == pytest.approx(3.0, abs=0.02)
    torch.set_default_dtype(torch.float64)
    problem = cost.build_shirt_problem(cost.FAST_SCALE)
    assert problem.names == list(cost.cases.PAPER_PARAMETERS)
    assert problem.cloth.material.youngs_modulus.value.item() == pytest.approx(1.5 * problem.truth["youngs_modulus"])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [(["--length", "0.1"], "expected .* s or more"), (["--descent", "0"], "--descent"), (["--gap", "nan"], "--gap")],
)
def test_refusals_write_nothing(arguments, message, tmp_path, capsys):
    assert call(tmp_path / "out", "--problems", "shirt", *arguments) == 2
    assert re.search(message, capsys.readouterr().err)
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_the_fast_study(tmp_path, capsys):
    assert call(tmp_path) == 0
    assert "shirt" in capsys.readouterr().out
