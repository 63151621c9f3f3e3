"""Searches on formulas: how they step, what they do not step into, and when they end."""

import math

import pytest
import torch

from torchcloth.errors import SimulationDiverged
from torchcloth.planning.courses import Bounds
from torchcloth.planning.descent import adam, gauss_newton
from torchcloth.planning.goal import Pull

GOAL = torch.tensor([0.3, -0.2], dtype=torch.float64)


class Bowl:
    """The distance of unknowns [2] from ``GOAL``, of which nothing but slopes is told."""

    metric = torch.eye(2, dtype=torch.float64)

    def __init__(self, most=10.0, blocked=lambda at: False, diverges=lambda at: False):
        self.bounds = Bounds(torch.eye(2), torch.full((2,), -most), torch.full((2,), most), ["x", "y"])
        self.blocked, self.diverges, self.seen = blocked, diverges, []

    def look(self, at):
        self.seen.append(at.clone())
        if self.diverges(at):
            raise SimulationDiverged("far off")
        off = (at - GOAL).norm()
        return float(off), float(off**2)

    def pull(self, at):
        off = at - GOAL
        return Pull(off.square().sum(), 2 * off, 2 * torch.eye(2))

    def slope(self, at):
        return *self.look(at), (at - GOAL) / (at - GOAL).norm()

    def clear(self, at):
        return not self.blocked(at)


def search(problem, method):
    quiet = lambda *numbers: None  # noqa: E731
    if method == "adam":
        return adam(problem, torch.zeros(2), 60, 0.02, quiet)
    return gauss_newton(problem, torch.zeros(2), 20, quiet)


@pytest.mark.parametrize("method", ["gauss-newton", "adam"])
def test_the_goal_is_found(method):
    found = search(Bowl(), method)
    assert torch.allclose(found.best, GOAL, atol=5e-3)
    assert found.history[0] == pytest.approx(float(GOAL.norm()))


@pytest.mark.parametrize("method", ["gauss-newton", "adam"])
def test_no_bound_is_crossed(method):
    problem = Bowl(most=0.1)
    found = search(problem, method)
    assert torch.allclose(found.best, torch.tensor([0.1, -0.1]), atol=1e-3)
    assert all(bool((at.abs() <= 0.1 + 1e-4).all()) for at in problem.seen)


@pytest.mark.parametrize("method", ["gauss-newton", "adam"])
def test_nothing_is_stepped_into(method):
    problem = Bowl(blocked=lambda at: float(at[0]) > 0.15)
    found = search(problem, method)
    assert not any(problem.blocked(at) for at in problem.seen)
    assert 0.1 < float(found.best[0]) <= 0.15


@pytest.mark.parametrize("method", ["gauss-newton", "adam"])
def test_what_cannot_be_simulated_is_stepped_back_from(method):
    problem = Bowl(diverges=lambda at: float(at[0]) > 0.2)
    found = search(problem, method)
    assert math.inf in found.history
    assert 0.1 < float(found.best[0]) <= 0.2


@pytest.mark.parametrize("method", ["gauss-newton", "adam"])
def test_a_beginning_that_cannot_be_simulated_is_told(method):
    with pytest.raises(SimulationDiverged):
        search(Bowl(diverges=lambda at: True), method)
