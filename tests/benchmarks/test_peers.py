"""The peers simulate what torchcloth does: each in a process of its own, where it is installed."""

from dataclasses import replace

import pytest
import torch

from torchcloth.benchmarks import contestants, guards
from torchcloth.benchmarks.contestant import Task, Unsupported
from torchcloth.benchmarks.ours import TorchclothContestant
from torchcloth.benchmarks.worker import ContestantFailed, Worker

pytestmark = pytest.mark.slow  # Taichi, Warp, Newton and MuJoCo start up

STEPS = 60


def worker(name):
    if name in contestants.missing_peers():
        pytest.skip(f"{name} is not installed")
    return Worker(name, 1)


def compare(name, task, truth_case, limit):
    truth = TorchclothContestant("reference", 1).prepare(replace(task, case=truth_case))()  # float64
    with worker(name) as far:
        far.prepare(task)
        outcome = far.result(task)[0]
    case = task.build_case()
    assert guards.physics_violations(case, task.substeps, outcome.x) == []
    assert guards.disagreement(case, truth, outcome, limit) == []


SLOW = pytest.mark.slow  # Taichi compiles for seconds, its gradient for minutes


@pytest.mark.parametrize("name", ["warp", pytest.param("taichi", marks=SLOW)])
def test_mpm_moves_as_our_own(name):
    """Position by position as ``transfer="apic"``: the same scheme, written three times."""
    compare(
        name,
        Task("standard-everywhere", "forward", STEPS, small=True),
        "standard-apic",
        guards.MAX_DISTANCE_SAME_SCHEME,
    )


@pytest.mark.parametrize(
    "name",
    ["warp", pytest.param("taichi", marks=pytest.mark.slow)],  # Taichi compiles its gradient for minutes
)
def test_mpm_gradients_are_our_own(name):
    compare(
        name,
        Task("standard-everywhere", "gradient", STEPS, small=True),
        "standard-apic",
        guards.MAX_DISTANCE_SAME_SCHEME,
    )


@pytest.mark.parametrize("name", ["newton", "mujoco"])
def test_mesh_simulators_move_alike(name):
    """Other laws of stretch, the same linear elasticity."""
    compare(name, Task("sheet-200", "forward", STEPS), "sheet-200", guards.MAX_DISTANCE_OTHER_SCHEME)


@pytest.mark.parametrize("name", contestants.PEERS)
def test_what_is_not_offered_is_said(name):
    with worker(name) as far, pytest.raises(Unsupported):
        far.prepare(Task("sheet-200", "tangents8", 10))


def test_a_contestant_that_fails_says_why():
    with Worker("reference", 1) as far, pytest.raises(ContestantFailed, match="one of"):
        far.prepare(Task("no such case", "forward", 1))
    with pytest.raises(ContestantFailed, match="ended"):
        Worker("nobody", 1)
    assert torch.get_default_dtype() == torch.float64
