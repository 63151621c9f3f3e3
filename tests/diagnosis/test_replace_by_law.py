"""Causes are withdrawn where one local force law predicts much better."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from helpers import linear_evidence as toys

from torchcloth.diagnosis.decide import search
from torchcloth.diagnosis.decide.search import replace_by_law
from torchcloth.diagnosis.inference.comparison import compare, predict_held_out
from torchcloth.diagnosis.inference.fitting import reweight_by_noise

SLOPES = toys.draw_jacobian(1, 5)  # two parameters, a cause, a law, a nuisance
NAMES = [f"motion {k}" for k in range(toys.EPISODE_COUNT)]


def models(cause, law):
    """(start, end with the cause, with the law) of a world in which both have these amplitudes."""
    every = toys.draw_linearisation(SLOPES, 4, [], torch.tensor([0.0, 0.0, cause, law]).double(), 0)

    def model(*columns):
        cells = [c._replace(jacobian=c.jacobian[:, [*columns, 4]]) for c in every.bins]
        return toys.make_model_fit(replace(every, bins=cells, n_coordinates=len(columns)), std=5.0)

    return model(0, 1), model(0, 1, 2), model(0, 1, 3)


def doubted(monkeypatch, cause, law, useful=True):
    start, end, other = models(cause, law)
    best = SimpleNamespace(fit=other, sole_informative_motion=set(), hypothesis=toys.make_hypothesis("a"))
    own = SimpleNamespace(
        candidate=SimpleNamespace(sole_informative_motion=set(), hypothesis=toys.make_hypothesis("c"))
    )
    monkeypatch.setattr(search, "evaluate_candidates", lambda *_: SimpleNamespace(candidate=best) if useful else None)
    first = predict_held_out(reweight_by_noise(start, end.noise, end.linearisation), NAMES)
    whole = compare(first, predict_held_out(end, NAMES), 0.0)
    setting = SimpleNamespace(motions=NAMES, recordings=(), episodes=())
    found = SimpleNamespace(
        start=start, end=end, accepted=[own], causes=[own], total_gain=whole, data=setting, not_simulated=()
    )
    return found, replace_by_law(found, start, 2)  # type: ignore[arg-type]


def test_a_cause_that_only_stands_in_is_withdrawn(monkeypatch):
    found, after = doubted(monkeypatch, cause=0.3, law=1.0)
    assert found.total_gain.log_density > 0  # it was of use
    assert after.withdrawn == ("c",)
    assert after.accepted == []
    assert after.end is found.start


@pytest.mark.parametrize(("cause", "law"), [(1.0, 0.0), (1.0, 0.3)])
def test_a_cause_that_does_as_much_stays(monkeypatch, cause, law):
    found, after = doubted(monkeypatch, cause, law)
    assert after is found


def test_a_cause_stays_where_no_law_is_of_use(monkeypatch):
    found, after = doubted(monkeypatch, cause=0.3, law=1.0, useful=False)
    assert after is found
