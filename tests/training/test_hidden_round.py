"""A reduced round of hidden effects from end to end, on coarse meshes with two short episodes each.

So little data separates few causes. The tests ask that large effects are named, that nothing false is, and that faults
are seen. The thresholds have seen all ten cases. All are slow tests.
"""

import json
import re

import pytest
import torch

from torchcloth.training.studies import hidden
from torchcloth.training.studies.command import main

FAMILIES = {"null": 1, "hard null": 2, "single": 2, "confounded": 1, "fault": 4}
ADDED_MASS, WRONG_UNIT = hidden.FAST_SEEDS[3], hidden.FAST_SEEDS[6]  # 1.5 times the typical added mass; metres or not


def run_round(folder) -> dict[str, list[dict]]:
    """Run the study, and return its cases by family."""
    before = torch.get_default_dtype()
    try:
        assert main(["hidden", "--fast", "--out", str(folder)]) == 0
    finally:
        torch.set_default_dtype(before)
    by_family: dict[str, list[dict]] = {}
    for case in json.loads((folder / "hidden.json").read_text()):
        by_family.setdefault(case["family"], []).append(case)
    return by_family


def check_round(folder, by_family: dict[str, list[dict]]) -> None:
    """Check that every case is answered, rightly, and that no false cause stands alone."""
    cases = [case for family in by_family.values() for case in family]
    for case in cases:
        assert not case["sealed"]
        assert case["verdict"] != "failed", case
        answer = json.loads((folder / "answers" / case["name"] / "diagnosis.json").read_text())
        assert answer.get("verdict", "refused") == case["verdict"]
        assert case["right"], case
        assert not case["wrong"], case
    text = (folder / "hidden.md").read_text()
    assert len(re.findall(r"^\| 0\d\d", text, re.MULTILINE)) == len(cases)
    assert f"{len(cases)} cases, 0 of them sealed" in text


@pytest.mark.slow
@pytest.mark.parametrize(
    ("family", "seed"), [("fault", WRONG_UNIT), ("single", ADDED_MASS)], ids=["a fault", "an effect"]
)
def test_one_case_from_end_to_end(family, seed, tmp_path, monkeypatch):
    monkeypatch.setattr(hidden, "FAST_SEEDS", (seed,))
    by_family = run_round(tmp_path)
    assert {family: len(cases) for family, cases in by_family.items()} == {family: 1}
    check_round(tmp_path, by_family)


@pytest.mark.slow
def test_a_round_from_end_to_end(tmp_path):
    by_family = run_round(tmp_path)
    assert {family: len(cases) for family, cases in by_family.items()} == FAMILIES
    assert len({case["kind"] for case in by_family["fault"]}) == 4
    check_round(tmp_path, by_family)
