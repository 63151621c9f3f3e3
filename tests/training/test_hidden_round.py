"""A reduced hidden round from end to end: a dozen sealed cases on coarse meshes, two short episodes each.

So little tells few causes from others: what is asked here is that large ones are named, that nothing false is, and that
faults are seen.
"""

import json
import re

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
        "null": 1, "hard null": 2, "single": 3, "double": 1, "confounded": 1, "fault": 4,
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
    for case in study[1]["single"] + study[1]["double"] + study[1]["confounded"]:
        assert not case["wrong"], case


def test_large_effects_are_named(study):
    assert all(case["right"] for case in study[1]["single"]), study[1]["single"]


def test_a_camera_and_a_robot_elsewhere_are_one(study):
    (case,) = study[1]["confounded"]
    assert case["right"], case


def test_no_fault_is_a_cause(study):
    assert len({case["kind"] for case in study[1]["fault"]}) == 4
    for fault in study[1]["fault"]:
        assert fault["right"], fault


def test_the_tables_are_there(study):
    text = (study[0] / "hidden.md").read_text()
    assert len(re.findall(r"^\| 0\d\d", text, re.MULTILINE)) == 12
    assert "12 cases, 12 of them sealed" in text
