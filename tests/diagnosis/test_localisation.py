"""Localisation: a cause shows in bins that no other fitted quantity explains."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from helpers import linear_evidence as toys

from torchcloth.diagnosis.data.binning import BLOCK_NAMES
from torchcloth.diagnosis.unknown.localisation import localise_cause

PART, WINDOW, EPISODE, BUMP, AMPLITUDE = 5, 3, 2, 2e-3, 1.5
PLACE = torch.tensor([(PART // 4) * 0.075, (PART % 4) * 0.075], dtype=torch.float64)
EPISODES = [SimpleNamespace(wrenches={f"hand {k}": None for k in range(toys.PATCH_COUNT)})] * toys.EPISODE_COUNT


def with_cause(change=lambda cells: cells):
    """A fit in which a cause does what the first parameter does, ten times as much as that, and one bump."""
    cells = toys.make_cells()
    here = (cells.channel == 3 * PART) & (cells.window == WINDOW)
    slopes = toys.draw_jacobian(0, 2)
    slopes = torch.stack([slopes[..., 0], 10 * slopes[..., 0], slopes[..., 1]], -1)
    slopes[EPISODE, here, 1] += BUMP
    found = toys.make_model_fit(toys.draw_linearisation(slopes, 2, [], torch.zeros(2).double(), 0), std=100.0)
    evidence = replace(found.linearisation, bins=[change(c) for c in found.linearisation.bins])
    model = replace(found.model, parameters=found.model.parameters[:1], coordinates=found.model.coordinates[:1])
    model = model.with_hypothesis(toys.make_hypothesis("cause", 1.0), AMPLITUDE)
    return replace(found, linearisation=evidence, model=model)


def told(found):
    return localise_cause(found, "cause", ["a", "b", "c", "d"], EPISODES)


def test_it_shows_where_and_when_it_does_what_parameters_do_not():
    answer = told(with_cause())
    assert answer["where"]["at"] == pytest.approx(PLACE.tolist())
    assert answer["when"] == {"episode": 2, "motion": "c", "from": pytest.approx(0.6), "to": pytest.approx(0.8)}
    assert answer["response"] == {"value": pytest.approx(AMPLITUDE * BUMP, rel=0.1), "unit": "m"}


@pytest.mark.parametrize(("gaining", "motion"), [(["a", "b"], "ab"), (["c", "d"], "c"), ([], "c"), (["other"], "c")])
def test_it_shows_in_a_motion_that_gains_held_out(gaining, motion):
    """Reported: "most significant in stretch", where the table of the same report said that it gains nothing."""
    answer = localise_cause(with_cause(), "cause", ["a", "b", "c", "d"], EPISODES, gaining)
    assert answer["when"]["motion"] in motion


def test_what_forces_alone_tell_shows_at_a_gripper():
    def felt(cells):
        return cells._replace(block=torch.full_like(cells.block, BLOCK_NAMES.index("force")))

    answer = told(with_cause(felt))
    assert answer["where"] == {"gripper": f"hand {PART}"}
    assert answer["response"]["unit"] == "N"
    assert answer["when"]["motion"] == "c"
