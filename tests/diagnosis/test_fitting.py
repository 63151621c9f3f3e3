"""Gauss-Newton between worlds of which some are impossible."""

import math
from dataclasses import replace

import pytest
import torch
from helpers import linear_evidence as toys

from torchcloth.diagnosis.decide.search import _list_not_simulated
from torchcloth.diagnosis.inference import fitting
from torchcloth.diagnosis.inference.fitting import add_cause, fit
from torchcloth.diagnosis.inference.linearise import use_nuisance_slopes
from torchcloth.errors import SimulationDiverged

TRUTH = torch.tensor([0.4]).double()


@pytest.fixture
def looks(monkeypatch):
    """(where the fit looked, with how many hypotheses).

    Worlds beyond ``looks.edge`` are impossible, windows before ``looks.hidden`` are not met at 0.
    """
    there = toys.make_model_fit(toys.draw_linearisation(toys.draw_jacobian(1, 2), 1, [], TRUTH, 0))

    class Looks(list):
        edge, hidden = torch.inf, 0

    seen = Looks()

    def gather(model, setting, hypotheses, progress, before):
        at = float(model.point[0])
        seen.append((at, len(hypotheses)))
        if at > seen.edge:
            raise SimulationDiverged("x", got="nan", expected="numbers")
        cells = [c._replace(value=c.value + c.jacobian[:, 0] * at) for c in there.linearisation.bins]
        kept = [c.window >= (seen.hidden if at == 0.0 else 0) for c in cells]
        cells = [c.select(k) for c, k in zip(cells, kept, strict=True)]
        numerics = [n[k] for n, k in zip(there.linearisation.mesh_differences, kept, strict=True)]
        return replace(there.linearisation, bins=cells, mesh_differences=numerics, hypotheses=list(hypotheses))

    def asked_about(here, model, setting, hypotheses, progress):
        seen.append((float(model.point[0]), len(hypotheses)))
        return replace(here, hypotheses=list(hypotheses))

    monkeypatch.setattr(fitting, "linearise", gather)
    monkeypatch.setattr(fitting, "linearise_hypotheses", asked_about)
    return seen, there.model


def test_it_ends_where_the_data_are_and_asks_there(looks):
    seen, model = looks
    found = fit(model, None, [toys.make_hypothesis("a")])  # type: ignore[arg-type]
    assert float(found.model.point[0]) == pytest.approx(0.4, abs=4 * float(found.covariance[0, 0]) ** 0.5)
    assert [count for _, count in seen] == [0] * (len(seen) - 1) + [1]
    assert seen[-1][0] == float(found.model.point[0])


@pytest.mark.parametrize("iterations", [1, 3])
def test_a_step_into_the_impossible_is_not_taken(looks, iterations):
    seen, model = looks
    seen.edge = 0.1
    found = fit(model, None, [toys.make_hypothesis("a")], iterations)  # type: ignore[arg-type]
    assert float(found.model.point[0]) == 0.0
    assert [h.name for h in found.linearisation.hypotheses] == ["a"]
    assert seen[-1] == (0.0, 1)


@pytest.mark.parametrize(
    ("promised", "steps", "tried"), [([9.0, 0.0, 0.0, 0.0], 2, 3), ([0.0], 0, 0), ([9.0, 9.0, 9.0], 2.25, 5)]
)
def test_it_goes_on_while_steps_gain_whatever_slopes_promise(looks, monkeypatch, promised, steps, tried):
    """From 0 to 0.4, where the data are, by 0.2 a step: the third loses, and half of it, where it promised much."""
    seen, model = looks
    ahead = iter(promised)
    monkeypatch.setattr(fitting, "robust_step", lambda *_: (torch.tensor([0.2]).double(), next(ahead, 0.0)))
    found = fit(model, None)  # type: ignore[arg-type]
    assert float(found.model.point[0]) == pytest.approx(0.2 * steps)
    assert len(seen) == tried + 1


def test_causes_are_asked_about_where_it_ends_alone(looks, monkeypatch):
    """Simulating all of them at a step that loses takes longer than the step."""
    seen, model = looks
    monkeypatch.setattr(fitting, "robust_step", lambda *_: (torch.tensor([0.9]).double(), 9.0))
    found = fit(model, None, [toys.make_hypothesis("a")], 1)  # type: ignore[arg-type]
    assert seen == [(0.0, 0), (0.9, 0), (0.0, 1)]
    assert [h.name for h in found.linearisation.hypotheses] == ["a"]


def test_noise_is_estimated_once_where_a_step_loses(looks, monkeypatch):
    """At 0, of which 0.9 and then 0.45 are tried, and at 0.45, where it ends."""
    seen, model = looks
    estimate, estimated = fitting.fit_noise, []
    monkeypatch.setattr(fitting, "fit_noise", lambda evidence: estimated.append(evidence) or estimate(evidence))
    monkeypatch.setattr(fitting, "robust_step", lambda *_: (torch.tensor([0.9]).double(), 9.0))
    found = fit(model, None, iterations=2)  # type: ignore[arg-type]
    assert [at for at, _ in seen] == [0.0, 0.9, 0.45]
    assert len(estimated) == 2
    assert estimated[-1] is found.linearisation


def test_what_only_the_later_point_meets_is_no_loss(looks, monkeypatch):
    seen, model = looks
    seen.hidden = 5  # of six
    ahead = iter([9.0])
    monkeypatch.setattr(fitting, "robust_step", lambda *_: (torch.tensor([0.2]).double(), next(ahead, 0.0)))
    assert float(fit(model, None).model.point[0]) == pytest.approx(0.4)  # type: ignore[arg-type]


def test_half_a_step_may_gain(looks, monkeypatch):
    """Slopes that lead twice as far as the data are."""
    _, model = looks
    ahead = iter([9.0, 9.0])
    monkeypatch.setattr(fitting, "robust_step", lambda *_: (torch.tensor([0.9]).double(), next(ahead, 0.0)))
    assert float(fit(model, None).model.point[0]) == pytest.approx(0.45)  # type: ignore[arg-type]


def test_where_it_begins_must_be_possible(looks):
    seen, model = looks
    seen.edge = -1.0
    with pytest.raises(SimulationDiverged):
        fit(model, None)  # type: ignore[arg-type]


def test_what_is_known_is_not_looked_at_again(looks):
    seen, model = looks
    here = fit(model, None, iterations=0).linearisation  # type: ignore[arg-type]
    seen.clear()
    fit(model, None, iterations=0, here=here)  # type: ignore[arg-type]
    assert not seen


def test_a_twin_takes_over_what_the_parameter_did():
    """The same world, with the parameter back at its data sheet."""
    slopes = toys.draw_jacobian(1, 3)
    slopes[..., 1] = slopes[..., 0]
    there = toys.make_model_fit(
        toys.draw_linearisation(slopes, 1, ["twin"], torch.tensor([0.0, 0.0]).double(), 0), std=0.05
    )
    sheet = replace(there.model.parameters[0], value=math.exp)
    model = replace(there.model, parameters=(sheet,)).at_point(torch.tensor([math.log(1.2)]).double())
    twin = toys.make_hypothesis("twin", equivalent_parameter=sheet.name)
    found = add_cause(replace(there, model=model, linearisation=replace(there.linearisation, hypotheses=[twin])), twin)
    amplitude, coordinate = found.amplitudes[0], float(found.coordinates[0])
    assert amplitude + coordinate == pytest.approx(0.2, abs=0.1)
    assert abs(coordinate) < 0.05 < 0.1 < amplitude


def test_amplitudes_stop_where_a_world_ends():
    model = toys.make_model_fit(toys.draw_linearisation(toys.draw_jacobian(1, 2), 1, [], TRUTH, 0)).model
    ortho = toys.make_hypothesis("elas.ortho", max_amplitude=0.9)
    assert model.with_hypothesis(ortho).at_point(torch.tensor([0.1, 1.5]).double()).amplitudes == (0.9,)
    plain = replace(ortho, signed=False, min_amplitude=0.1)
    assert model.with_hypothesis(plain).at_point(torch.tensor([0.1, -1.5]).double()).amplitudes == (0.1,)


def test_cells_that_the_base_model_had_not_keep_their_nuisances():
    """They would err by noise alone, however late the clock may be."""
    here = toys.make_model_fit(toys.draw_linearisation(toys.draw_jacobian(1, 2), 1, [], TRUTH, 0)).linearisation
    later = [c.select(c.window > 0) for c in here.bins]
    known = replace(here, bins=[c._replace(jacobian=2 * c.jacobian) for c in later])
    for own, held, like in zip(here.bins, use_nuisance_slopes(here, known).bins, known.bins, strict=True):
        new = own.window == 0
        assert torch.equal(held.jacobian[new], own.jacobian[new])
        assert torch.equal(held.jacobian[~new, 1], like.jacobian[:, 1])
        assert torch.equal(held.jacobian[:, 0], own.jacobian[:, 0])


def test_what_cannot_be_simulated_beside_a_cause_is_told():
    there = toys.make_model_fit(
        toys.draw_linearisation(toys.draw_jacobian(1, 4), 1, ["a", "b"], torch.zeros(3).double(), 0)
    )
    asked = [toys.make_hypothesis(name) for name in "abcd"]
    model = replace(there.model, accepted=(asked[2],), amplitudes=(0.1,))
    assert _list_not_simulated(replace(there, model=model), asked) == ["d"]
