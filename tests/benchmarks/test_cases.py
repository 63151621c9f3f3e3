"""The scenes are what their names say, and the guards see when they are not."""

import numpy as np
import pytest
import torch

from torchcloth.benchmarks import cases, guards
from torchcloth.benchmarks.contestant import Outcome, Task
from torchcloth.benchmarks.ours import TorchclothContestant
from torchcloth.errors import InvalidInput

STEPS = 30


@pytest.mark.parametrize("name", [*cases.CASES, "sheet-200"])
def test_physics_holds(name):
    case = cases.make_case(name, small=True)
    outcome = TorchclothContestant("reference", 1).prepare(Task(name, "forward", STEPS, small=True))()
    assert guards.physics_violations(case, STEPS, outcome.x) == []


def test_the_standard_case_is_the_issues():
    case = cases.make_case("standard-everywhere")
    assert (len(case.mesh.vertices), case.triangles) == (441, 800)
    assert np.ptp(case.mesh.vertices, axis=0) == pytest.approx([0.5, 0.0, 0.5])
    assert case.contact.spacing == cases.CELL_SIZE_M == pytest.approx(0.5 / 20)
    assert len(case.gripped_vertices) == 2
    assert 1400 <= cases.make_case("garment").triangles <= 1600


@pytest.mark.parametrize("triangles", [200, 20_000])
def test_sheets_of_any_size_have_the_same_edge(triangles):
    case = cases.make_case(f"sheet-{triangles}")
    assert case.triangles == pytest.approx(triangles, rel=0.05)
    assert case.mesh.mean_edge == pytest.approx(cases.make_case("standard").mesh.mean_edge, rel=1e-6)


@pytest.mark.parametrize("substeps", [1, 250, 251, 6250])
def test_times_give_the_substeps_asked_for(substeps):
    case = cases.make_case("standard", small=True)
    times, motion = cases.gripper_motion(case, substeps, torch.float64)
    counts = [max(1, int(np.ceil((b - a) / (cases.SUBSTEP_S * (1 + 1e-6)) - 1e-9))) for a, b in zip(times, times[1:])]  # noqa: B905, RUF007
    assert sum(counts) == substeps
    assert float(motion["left"].t[-1]) >= times[-1]


def test_every_case_is_stable_with_the_common_step():
    torch.set_default_dtype(torch.float32)
    for name in cases.CASES:
        assert cases.make_cloth(cases.make_case(name), "reference").stable_step() >= cases.SUBSTEP_S


def test_displacements_are_those_of_the_drive():
    case = cases.make_case("standard", small=True)
    outcome = TorchclothContestant("reference", 1).prepare(Task("standard", "forward", STEPS, small=True))()
    way = case.displacements(STEPS)
    assert way.shape == (STEPS, 3)
    moved = outcome.x[case.gripped_vertices] - case.mesh.vertices[case.gripped_vertices]
    assert moved == pytest.approx(np.repeat(way.sum(0)[None], 2, 0), abs=1e-12)


def test_an_unknown_case_or_engine_is_refused():
    with pytest.raises(InvalidInput, match="one of"):
        cases.make_case("sheet")
    with pytest.raises(InvalidInput, match="reference"):
        cases.make_cloth(cases.make_case("standard", small=True), "warp-drive")


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda x: x * np.nan, "finite"),
        (lambda x: x + np.array([0.0, 0.01, 0.0]), "gripper"),
        (lambda x: x - np.array([0.0, 0.0, 1.0]), "fell"),
        (lambda x: x * 1.2, "stretched"),
    ],
)
def test_guards_find_what_is_wrong(spoil, message):
    case = cases.make_case("standard", small=True)
    good = TorchclothContestant("reference", 1).prepare(Task("standard", "forward", STEPS, small=True))().x
    assert any(message in text for text in guards.physics_violations(case, STEPS, spoil(good)))


def test_guards_find_a_cloth_that_was_not_simulated():
    case = cases.make_case("standard", small=True)
    carried = case.mesh.vertices + case.displacements(STEPS).sum(0)
    assert any("did not move" in text for text in guards.physics_violations(case, STEPS, carried))


def test_guards_compare_positions_and_derivatives():
    case = cases.make_case("standard", small=True)
    start, way = case.mesh.vertices, np.array([0.0, 0.0, -0.001])
    truth = Outcome(start + way, 1.0, np.ones_like(start), 2.0)
    assert guards.disagreement(case, truth, truth, guards.MAX_DISTANCE_SAME_SCHEME) == []
    late = truth._replace(x=start + 0.9 * way)
    assert "mm from the expected" in guards.disagreement(case, truth, late, guards.MAX_DISTANCE_SAME_SCHEME)[0]
    assert (
        guards.disagreement(case, truth, truth._replace(x=start + 0.95 * way), guards.MAX_DISTANCE_OTHER_SCHEME) == []
    )
    steep = truth._replace(gradient_youngs=2.1)
    assert "derivative by E" in guards.disagreement(case, truth, steep, guards.MAX_DISTANCE_SAME_SCHEME)[0]
    assert guards.derivative_violations([np.zeros(3)]) == ["derivatives are exactly zero"]
    assert guards.derivative_violations([np.array([1.0, np.inf])]) == ["derivatives are not finite"]
