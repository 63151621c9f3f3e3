"""Searches on formulas: how they step, what they do not step into, and when they end."""

import math
from itertools import pairwise

import pytest
import torch

from torchcloth.errors import SimulationDiverged
from torchcloth.planning.motion_parameters import Bounds
from torchcloth.planning.objective import Pull
from torchcloth.planning.optimizers import adam, gauss_newton

GOAL = torch.tensor([0.3, -0.2], dtype=torch.float64)


class Bowl:
    """The distance of unknowns [2] from ``GOAL``, of which nothing but slopes is told."""

    metric = torch.eye(2, dtype=torch.float64)

    def __init__(self, most=10.0, blocked=lambda at: False, diverges=lambda at: False):
        ends, one = torch.full((2,), most), torch.arange(2)
        self.bounds = Bounds(torch.eye(2), -ends, ends, ["x", "y"], one, one)
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
        return self.look(at)[0], (at - GOAL) / (at - GOAL).norm()

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


def test_what_blocks_every_step_is_said():
    found = search(Bowl(blocked=lambda at: bool(at.any())), "gauss-newton")
    assert torch.equal(found.best, torch.zeros(2))
    assert "blocked" in found.ended


def test_a_step_that_fails_is_not_tried_again():
    """Slopes that lie: each of them points to a wall of distance, and no smaller step is worth it."""

    class Liar(Bowl):
        def look(self, at):
            self.seen.append(at)
            far = 1.0 + 10.0 * float(at.norm())
            return far, far**2

    problem = Liar()
    found = search(problem, "gauss-newton")
    assert "no smaller step" in found.ended
    sizes = [float(at.norm()) for at in problem.seen[1:]]
    assert all(b < 0.9 * a for a, b in pairwise(sizes))


def test_what_is_told_of_the_best_is_of_the_motion_that_is_kept():
    """By mean square: a few points that are far off outweigh a mean that is a hair smaller."""

    class Outlying(Bowl):
        def look(self, at):
            self.seen.append(at)
            return 1.0 / len(self.seen), 1.0 + float(at.norm())

    told = []
    found = gauss_newton(Outlying(), torch.zeros(2), 20, lambda *numbers: told.append(numbers))
    assert torch.equal(found.best, torch.zeros(2))
    assert len(told) > 1
    assert [best for _, _, best in told] == [1.0] * len(told)


def test_slopes_that_are_lost_end_the_search():
    class Lost(Bowl):
        def pull(self, at):
            return Pull(torch.tensor(1.0), torch.full((2,), torch.nan), torch.eye(2))

    assert "chaotic" in search(Lost(), "gauss-newton").ended


@pytest.mark.parametrize("method", ["gauss-newton", "adam"])
def test_slopes_of_chaos_end_the_search(method):
    problem, nothing = Bowl(), torch.full((2,), math.nan)
    problem.slope = lambda at: (problem.look(at)[0], nothing)
    problem.pull = lambda at: Pull(torch.tensor(1.0), nothing, torch.eye(2))
    found = search(problem, method)
    assert torch.equal(found.best, torch.zeros(2))
    assert len(found.history) == 1
    assert "slopes say nothing" in found.ended
