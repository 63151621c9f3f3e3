"""A reduced hidden round from end to end: five sealed cases on coarse meshes, two short episodes each.

So little says few causes' names: what is asked here is that nothing false is named and that faults are seen.
"""

import json

import pytest
import torch

from torchcloth.training.studies.command import main


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    """Folder of the round, and its cases by family."""
    folder, before = tmp_path_factory.mktemp("hidden"), torch.get_default_dtype()
    try:
        assert main(["hidden", "--fast", "--out", str(folder / "round")]) == 0
    finally:
        torch.set_default_dtype(before)
    by_family = {}
    for case in json.loads((folder / "round" / "hidden.json").read_text()):
        by_family.setdefault(case["family"], []).append(case)
    return folder / "round", by_family


def test_every_case_is_sealed_and_answered(study):
    assert {family: len(cases) for family, cases in study[1].items()} == {
        "null": 1, "hard null": 2, "single": 1, "fault": 1,
    }  # fmt: skip
    for case in (c for cases in study[1].values() for c in cases):
        assert case["sealed"]
        assert case["verdict"] != "failed", case
        answer = json.loads((study[0] / "answers" / case["name"] / "diagnosis.json").read_text())
        assert answer.get("verdict", "refused") == case["verdict"]


def test_nothing_is_named_where_nothing_is_hidden(study):
    for case in study[1]["null"] + study[1]["hard null"]:
        assert case["right"], case


def test_nothing_false_is_named_alone(study):
    for case in study[1]["single"]:
        assert not case["wrong"], case


def test_a_wrong_unit_is_no_cause(study):
    (fault,) = study[1]["fault"]
    assert fault["right"], fault


def test_the_tables_are_there(study):
    text = (study[0] / "hidden.md").read_text()
    assert text.count("| 00") == 5
    assert "5 cases, 5 of them sealed" in text
