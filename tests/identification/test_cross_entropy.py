"""The search by draws: it leaves hollows that slopes run into, and fits the observer's errors without simulations."""

import math
from types import SimpleNamespace

import pytest
import torch

from torchcloth.episodes.unknowns import Unknown, collect_unknowns
from torchcloth.errors import SimulationDiverged
from torchcloth.identification import build_episode
from torchcloth.identification.estimators import levenberg_marquardt
from torchcloth.identification.estimators.cross_entropy import search_by_draws
from torchcloth.identification.estimators.objective import Objective
from torchcloth.identification.nuisances import select_nuisances
from torchcloth.parameters import PhysicalParameter

TRUE_STIFFNESS, TRUE_DRAG, START = 80.0, 0.4, (300.0, 1.2)


@pytest.fixture(autouse=True)
def float64():
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


def make_rugged(refused=lambda raw: False):
    """Return an objective of two unknowns whose rows ripple: log stiffness and an amplitude, with a hollow at truth."""
    parameters = [PhysicalParameter(START[0], "N/m"), PhysicalParameter(START[1], "1", "nonnegative")]
    starts = [float(p.raw) for p in parameters]
    unknowns = [
        Unknown("stiffness", "", parameters[0], starts[0], 2.3),
        Unknown("drag", "", parameters[1], starts[1], 2.4, typical_amplitude=1.2),
    ]
    truth = torch.tensor([float(PhysicalParameter(TRUE_STIFFNESS, "N/m").raw), TRUE_DRAG])
    phase, slope = torch.linspace(0, 3, 40), torch.linspace(0.5, 1.5, 40)

    def rows(raw):
        if refused(raw):
            raise SimulationDiverged("a row")
        away = raw - truth
        return slope * away[0] + slope.flip(0) * away[1] + 0.8 * torch.sin(9 * away[0] + phase) * away.norm()

    def linearise(raw):
        jacobian = torch.func.jacfwd(rows)(raw)
        index = torch.arange(len(phase))
        return levenberg_marquardt.Linearised(rows(raw), jacobian, torch.ones_like(phase), index, index)

    def evaluate(raw):
        return rows(raw), torch.arange(len(phase))

    start, std = torch.tensor(starts), torch.tensor([2.3, 2.4])
    problem = levenberg_marquardt.Problem(
        linearise, evaluate, lambda raw: torch.stack([raw[0], raw[1].clamp(min=0)]), start, std, torch.ones(2), 0.01
    )

    def simulate_fabrics(raw, fabrics):
        return [None if refused(fabric) else [] for fabric in fabrics]

    def observer_problem(raw, simulated):
        return problem._replace(
            linearise=lambda at: linearise(at)._replace(jacobian=torch.zeros(len(phase), 2)), prior_mean=raw
        )

    objective = SimpleNamespace(
        unknowns=unknowns,
        problem=lambda: problem,
        observer_problem=observer_problem,
        simulate_cloth=lambda raw: [],
        simulate_fabrics=simulate_fabrics,
    )
    return objective, start, truth


def test_it_finds_the_hollow_that_slopes_miss():
    objective, start, truth = make_rugged()
    by_slopes = levenberg_marquardt.minimise(objective.problem(), start, 30, lambda at: False).raw
    assert (by_slopes - truth).norm() > 0.5
    end = search_by_draws(objective, start, lambda raw: False)
    assert (end - truth).norm() < 0.3
    assert torch.equal(end, search_by_draws(objective, start, lambda raw: False))  # a resumed fit repeats it


def test_draws_that_cannot_be_simulated_are_left_out():
    objective, start, truth = make_rugged(lambda raw: bool(raw[0] > 6.5))
    assert math.exp(6.5) > START[0]
    assert (search_by_draws(objective, start, lambda raw: False) - truth).norm() < 0.3


def test_a_round_may_be_the_last():
    objective, start, _ = make_rugged()
    ends = []
    search_by_draws(objective, start, lambda raw: ends.append(raw) or True)
    assert len(ends) == 1


def test_errors_of_the_observer_need_one_simulation(model, brief):
    """Their slopes are those of a linearisation of everything; the fabric's are zero, and it stays where it is."""
    unknowns = collect_unknowns(model, ["youngs_modulus", "air.normal"], None)
    nuisances = select_nuisances(["clock", "camera"], ["rim"])
    objective = Objective(model, unknowns, [build_episode(model, brief)], nuisances=nuisances)
    start, count = objective.start, len(unknowns)
    problem = objective.observer_problem(start, objective.simulate_cloth(start))
    at = start + torch.cat([torch.zeros(count), 0.5 * objective.prior_std[count:]])
    linear, full = problem.linearise(at), objective.linearise(at)
    is_close = torch.isclose(linear.jacobian[:, count:], full.jacobian[:, count:], rtol=1e-6, atol=1e-9).all(1)
    assert is_close.double().mean() > 0.98  # a point as near to two triangles takes either
    assert not linear.jacobian[:, :count].any()
    torch.testing.assert_close(problem.evaluate(at)[0], objective.evaluate(at)[0], rtol=0, atol=0)
    end = levenberg_marquardt.minimise(problem, at, 3, lambda at: False)
    assert torch.equal(end.raw[:count], start[:count])
    assert not torch.equal(end.raw[count:], at[count:])


def test_fabrics_that_share_a_batch_move_as_they_do_alone(model, brief):
    """Their substep is that of the stiffest; one that cannot be simulated takes no other along."""
    unknowns = collect_unknowns(model, ["youngs_modulus", "air.normal"], None)
    objective = Objective(model, unknowns, [build_episode(model, brief)])
    fabrics = objective.start + torch.tensor([[0.0, 0.0], [0.5, 0.1], [60.0, 0.0], [-0.5, 0.3]], dtype=torch.float64)
    together = objective.simulate_fabrics(objective.start, fabrics)
    assert together[2] is None  # no substep is short enough
    for k in (0, 1, 3):
        alone = objective.simulate_cloth(fabrics[k])
        for seen, expected in zip(together[k], alone, strict=True):
            torch.testing.assert_close(seen.x, expected.x, rtol=0, atol=2e-5)
