"""A reduced hidden round from end to end: ten cases on coarse meshes, two short episodes each.

So little tells few causes from others: what is asked here is that large ones are named, that nothing false is, and that
faults are seen. Thresholds have seen all ten.
"""

import json
import re

import torch

from torchcloth.training.studies.command import main


def test_a_round_from_end_to_end(tmp_path):
    """One test, so that workers that share the others' do not each make the round."""
    before = torch.get_default_dtype()
    try:
        assert main(["hidden", "--fast", "--out", str(tmp_path)]) == 0
    finally:
        torch.set_default_dtype(before)
    by_family = {}
    for case in json.loads((tmp_path / "hidden.json").read_text()):
        by_family.setdefault(case["family"], []).append(case)
    every_case_is_answered(tmp_path, by_family)
    nothing_is_named_where_nothing_is_hidden(by_family["null"] + by_family["hard null"])
    nothing_false_is_named_alone(by_family["single"] + by_family["confounded"])
    large_effects_and_a_camera_elsewhere_are_named(by_family["single"] + by_family["confounded"])
    no_fault_is_a_cause(by_family["fault"])
    the_tables_are_there(tmp_path)


def every_case_is_answered(folder, by_family):
    assert {family: len(cases) for family, cases in by_family.items()} == {
        "null": 1, "hard null": 2, "single": 2, "confounded": 1, "fault": 4,
    }  # fmt: skip
    for case in (c for cases in by_family.values() for c in cases):
        assert not case["sealed"]
        assert case["verdict"] != "failed", case
        answer = json.loads((folder / "answers" / case["name"] / "diagnosis.json").read_text())
        assert answer.get("verdict", "refused") == case["verdict"]


def nothing_is_named_where_nothing_is_hidden(cases):
    for case in cases:
        assert case["right"], case


def nothing_false_is_named_alone(cases):
    for case in cases:
        assert not case["wrong"], case


def large_effects_and_a_camera_elsewhere_are_named(cases):
    for case in cases:
        assert case["right"], case


def no_fault_is_a_cause(cases):
    assert len({case["kind"] for case in cases}) == 4
    for fault in cases:
        assert fault["right"], fault


def the_tables_are_there(folder):
    text = (folder / "hidden.md").read_text()
    assert len(re.findall(r"^\| 0\d\d", text, re.MULTILINE)) == 10
    assert "10 cases, 0 of them sealed" in text
