"""Parameters about which motions disagree, and the searches that start from them."""

from dataclasses import replace

import pytest
import torch
from helpers import linear_evidence as toys

from torchcloth.diagnosis.causes.fabric import BENDING_EFFECTS, MEMBRANE_EFFECTS
from torchcloth.diagnosis.causes.hypotheses import list_known_hypotheses
from torchcloth.diagnosis.decide import search
from torchcloth.diagnosis.decide.criteria import CRITERIA
from torchcloth.diagnosis.inference.heterogeneity import EFFECTS_OF_PARAMETER, propose_from_heterogeneity

NAMES = ["a", "b", "c", "d"]


def fitted(apart, name="bending.stiffness"):
    """Four motions, each of which wants a law's number by so much more or less than the others."""
    ev = toys.draw_linearisation(toys.draw_jacobian(1, 3), 2, [], torch.tensor([0.0, 0.0]).double(), 0)
    for k, c in enumerate(ev.bins):
        ev.bins[k] = c._replace(value=c.value - (1, -1, 1, -1)[k] * apart * c.jacobian[:, 1])
    there = toys.make_model_fit(ev)
    parameters = (there.model.parameters[0], replace(there.model.parameters[1], name=name))
    return replace(
        there, model=replace(there.model, parameters=parameters, coordinates=torch.tensor([0.2, -0.4]).double())
    )


@pytest.mark.parametrize(
    ("name", "effects"), [("bending.stiffness", BENDING_EFFECTS), ("youngs_modulus", MEMBRANE_EFFECTS)]
)
def test_causes_of_a_disputed_law_are_begun_both_ways_at_their_size(name, effects):
    begun = propose_from_heterogeneity(fitted(0.5, name), NAMES, list_known_hypotheses())
    assert {h.effect for h, _ in begun} == set(effects)
    for h, model in begun:
        assert model.coordinates.tolist() == [0.2, 0.0]  # back at its sheet; the other stays
        assert abs(model.amplitudes[-1]) == abs(h.typical)
    ways = [model.amplitudes[-1] for h, model in begun if h.signed]
    assert sum(ways) == pytest.approx(0.0)


def test_motions_that_agree_dispute_nothing():
    assert propose_from_heterogeneity(fitted(0.02), NAMES, list_known_hypotheses()) == []
    assert propose_from_heterogeneity(fitted(0.5, "areal_density"), NAMES, list_known_hypotheses()) == []


def test_two_motions_are_too_few_to_tell_the_odd_one():
    assert propose_from_heterogeneity(fitted(0.5), ["a", "a", "b", "b"], list_known_hypotheses()) == []


def test_the_laws_are_the_catalogues():
    assert EFFECTS_OF_PARAMETER.keys() == CRITERIA.heterogeneity.max_log_std.keys()
    assert {effect for effects in EFFECTS_OF_PARAMETER.values() for effect in effects} <= {
        h.effect for h in list_known_hypotheses()
    }


def test_where_nothing_is_disputed_nothing_is_fitted(monkeypatch):
    monkeypatch.setattr(search, "evaluate_candidates", lambda *_: pytest.fail("nothing to try"))
    start = fitted(0.02)
    chain = search._search_heterogeneous(
        start, type("S", (), {"motions": NAMES})(), list_known_hypotheses(), lambda _: None
    )
    assert chain.accepted == []
    assert chain.fit is start
