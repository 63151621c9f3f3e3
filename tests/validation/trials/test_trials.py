"""The table of trials: every line is there, its tests exist, and a failing test shows."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

from torchcloth.training.validation.trials import command
from torchcloth.training.validation.trials.table import TRIALS, Trial

ROOT = Path(__file__).parents[3]
PAGE = ROOT / "docs" / "validation" / "trials.md"
COUNTS = {"A": 20, "B": 8, "C": 4, "D": 16}


def test_every_line_is_there_once():
    expected = [f"{letter}{i + 1}" for letter, count in COUNTS.items() for i in range(count)]
    assert [trial.id for trial in TRIALS] == expected


@pytest.mark.parametrize("trial", TRIALS, ids=lambda trial: trial.id)
def test_the_tests_of_a_line_exist_and_stand_on_the_page(trial):
    (row,) = [line for line in PAGE.read_text().splitlines() if line.startswith(f"| {trial.id} |")]
    assert trial.tried in row
    assert trial.now in row
    for name in trial.tests:
        file, _, function = name.partition("::")
        assert function == "*" or re.search(rf"^def {function}\(", (ROOT / "tests" / file).read_text(), re.MULTILINE)
        assert f"`{name.removesuffix('::*')}`" in row


def test_a_failing_and_a_missing_test_show():
    trial = Trial("A1", "input", "before", "now", ("test_a.py::test_one", "test_b.py::*"))
    passed = {"test_a.py::test_one": ["passed", "skipped"], "test_b.py::*": ["passed"]}
    assert command.describe_result(trial, passed) == "met (2 cases)"
    assert command.describe_result(trial, {**passed, "test_b.py::*": ["failed", "passed"]}).startswith("**not met**")
    assert command.describe_result(trial, {"test_b.py::*": ["passed"]}).startswith("**not met**")
    assert command.describe_result(Trial("A3", "", "", ""), passed) == "not tested here"


def test_tests_are_run_and_their_outcomes_read(tmp_path, monkeypatch):
    (tmp_path / "tests").mkdir()
    (tmp_path / "tests" / "test_x.py").write_text(
        "import pytest\n@pytest.mark.parametrize('n', [0, 1])\ndef test_numbers(n):\n    assert n\n"
    )
    monkeypatch.chdir(tmp_path)
    trial = Trial("A1", "input", "before", "now", ("test_x.py::test_numbers",))
    assert command.run_tests([trial])["test_x.py::test_numbers"] == ["failed", "passed"]


def test_outside_of_the_repository_the_command_says_so(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert command.main([]) == 2
    assert capsys.readouterr().err == "trials: no folder tests; run it at the root of the repository\n"


def test_the_lowest_torch_is_tested():
    """CI takes the lower bound from pyproject.toml and runs all tests with it."""
    dependencies = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    assert any(re.match(r"torch>=[\d.]+", dependency) for dependency in dependencies)
    workflow = (ROOT / ".github" / "workflows" / "ci.yml").read_text()
    assert "lowest-torch:" in workflow
    assert r"torch>=([0-9.]+)" in workflow
