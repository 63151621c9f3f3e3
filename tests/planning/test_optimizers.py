"""Searches on formulas: how they step, what they do not step into, and when they end."""

import math
from itertools import pairwise

import pytest
import torch

from torchcloth.errors import SimulationDiverged
from torchcloth.planning.motion_parameters import LinearBounds
from torchcloth.planning.objective import QuadraticModel
from torchcloth.planning.optimizers import adam, gauss_newton

GOAL = torch.tensor([0.3, -0.2], dtype=torch.float64)


class Bowl:
    """The distance of unknowns [2] from ``GOAL``; a search sees values and derivatives only."""

    metric = torch.eye(2, dtype=torch.float64)

    def __init__(self, bound=10.0, blocked=lambda at: False, diverges=lambda at: False):
        high = torch.full((2,), bound)
        self.bounds = LinearBounds(torch.eye(2), -high, high, ["x", "y"])
        self.blocked, self.diverges, self.seen = blocked, diverges, []

    def evaluate(self, at):
        self.seen.append(at.clone())
        if self.diverges(at):
            raise SimulationDiverged("far off")
        off = (at - GOAL).norm()
        return float(off), float(off**2)

    def quadratic_model(self, at):
        off = at - GOAL
        return QuadraticModel(off.square().sum(), 2 * off, 2 * torch.eye(2))

    def distance_gradient(self, at):
        return self.evaluate(at)[0], (at - GOAL) / (at - GOAL).norm()

    def is_clear(self, at):
        return not self.blocked(at)


def search(problem, method):
    def quiet(*numbers):
        pass

    if method == "adam":
        return adam(problem, torch.zeros(2), 60, 0.02, quiet)
    return gauss_newton(problem, torch.zeros(2), 20, quiet)


@pytest.mark.parametrize("method", ["gauss-newton", "adam"])
def test_the_goal_is_found(method):
    result = search(Bowl(), method)
    assert torch.allclose(result.best, GOAL, atol=5e-3)
    assert result.history[0] == pytest.approx(float(GOAL.norm()))


@pytest.mark.parametrize("method", ["gauss-newton", "adam"])
def test_no_bound_is_crossed(method):
    problem = Bowl(bound=0.1)
    result = search(problem, method)
    assert torch.allclose(result.best, torch.tensor([0.1, -0.1]), atol=1e-3)
    assert all(bool((at.abs() <= 0.1 + 1e-4).all()) for at in problem.seen)


@pytest.mark.parametrize("method", ["gauss-newton", "adam"])
def test_nothing_is_stepped_into(method):
    problem = Bowl(blocked=lambda at: float(at[0]) > 0.15)
    result = search(problem, method)
    assert not any(problem.blocked(at) for at in problem.seen)
    assert 0.1 < float(result.best[0]) <= 0.15


@pytest.mark.parametrize("method", ["gauss-newton", "adam"])
def test_what_cannot_be_simulated_is_stepped_back_from(method):
    problem = Bowl(diverges=lambda at: float(at[0]) > 0.2)
    result = search(problem, method)
    assert math.inf in result.history
    assert 0.1 < float(result.best[0]) <= 0.2


@pytest.mark.parametrize("method", ["gauss-newton", "adam"])
def test_a_beginning_that_cannot_be_simulated_is_told(method):
    with pytest.raises(SimulationDiverged):
        search(Bowl(diverges=lambda at: True), method)


def test_what_blocks_every_step_is_said():
    result = search(Bowl(blocked=lambda at: bool(at.any())), "gauss-newton")
    assert torch.equal(result.best, torch.zeros(2))
    assert "blocked" in result.stop_reason


def test_a_step_that_fails_is_not_tried_again():
    """Slopes that lie: each of them points to a wall of distance, and no smaller step is worth it."""

    class Liar(Bowl):
        def evaluate(self, at):
            self.seen.append(at)
            far = 1.0 + 10.0 * float(at.norm())
            return far, far**2

    problem = Liar()
    result = search(problem, "gauss-newton")
    assert "no smaller step" in result.stop_reason
    sizes = [float(at.norm()) for at in problem.seen[1:]]
    assert all(b < 0.9 * a for a, b in pairwise(sizes))


def test_what_is_told_of_the_best_is_of_the_motion_that_is_kept():
    """By mean square: a few points that are far off outweigh a mean that is a hair smaller."""

    class Outlying(Bowl):
        def evaluate(self, at):
            self.seen.append(at)
            return 1.0 / len(self.seen), 1.0 + float(at.norm())

    message = []
    result = gauss_newton(Outlying(), torch.zeros(2), 20, lambda *numbers: message.append(numbers))
    assert torch.equal(result.best, torch.zeros(2))
    assert len(message) > 1
    assert [best for _, _, best in message] == [1.0] * len(message)


def test_undefined_derivatives_end_the_search():
    class Undefined(Bowl):
        def quadratic_model(self, at):
            return QuadraticModel(torch.tensor(1.0), torch.full((2,), torch.nan), torch.eye(2))

    assert "chaotic" in search(Undefined(), "gauss-newton").stop_reason


@pytest.mark.parametrize("method", ["gauss-newton", "adam"])
def test_derivatives_that_are_not_finite_end_the_search(method):
    problem, nothing = Bowl(), torch.full((2,), math.nan)
    problem.distance_gradient = lambda at: (problem.evaluate(at)[0], nothing)
    problem.quadratic_model = lambda at: QuadraticModel(torch.tensor(1.0), nothing, torch.eye(2))
    result = search(problem, method)
    assert torch.equal(result.best, torch.zeros(2))
    assert len(result.history) == 1
    assert "chaotic" in result.stop_reason
