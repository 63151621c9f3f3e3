"""Frozen clouds and clocks that are off, before a pose is estimated."""

from dataclasses import dataclass

import pytest
from helpers import twins
from helpers.occluded_twins import build_cloth

from torchcloth.pose import estimate, estimate_pose

CORRECTED_CLOCK_STD_S = 0.02


@dataclass(frozen=True)
class Result:
    warnings: list[str]


@pytest.mark.parametrize("checks", [True, False])
def test_a_corrected_clock_is_a_nuisance_of_the_pose_and_is_named(scene, monkeypatch, checks):
    used = []

    def check(recordings):
        return recordings, ["the clock was corrected"], CORRECTED_CLOCK_STD_S

    def assemble(objective, *_):
        used.append({n.nuisance.name: n.stds for slices in objective.nuisance_slices for n in slices})
        return Result(["the last"])

    monkeypatch.setattr(estimate, "check_all", check)
    monkeypatch.setattr(estimate, "smooth", lambda *_: None)
    monkeypatch.setattr(estimate, "_assemble_result", assemble)
    result = estimate_pose(build_cloth(scene, twins.TRUE_FABRIC), scene.recording, checks=checks)
    assert result.warnings == (["the clock was corrected", "the last"] if checks else ["the last"])
    assert ("clock" in used[0]) is checks
    if checks:
        assert list(used[0]["clock"]) == [CORRECTED_CLOCK_STD_S]
