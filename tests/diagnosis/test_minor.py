"""What is too small to matter has no name, but what it may stand for is said."""

from types import SimpleNamespace

import linear_toys as toys
import pytest

from torchcloth.diagnosis.stepwise import MATTERS
from torchcloth.diagnosis.verdict import _minor, _verdict


def candidate(name, typical, amplitude):
    return SimpleNamespace(hypothesis=toys.hypothesis(name, typical), amplitude=amplitude)


def small(*rivals):
    step = SimpleNamespace(best=candidate("obs.depth_scale", 0.015, -0.002), rivals=rivals)
    return _minor(SimpleNamespace(amplitude=lambda _: -0.002), step)


def test_rivals_that_would_matter_are_said_and_no_others():
    found = small(candidate("obs.depth_bias", 5e-3, -2.5e-3), candidate("mass.hem", 0.02, 0.39 * MATTERS * 0.02))
    assert found["effect"] == "obs.depth_scale"
    assert [(r["effect"], r["amplitude"]) for r in found["rivals"]] == [("obs.depth_bias", -2.5e-3)]


@pytest.mark.parametrize("doubtful", [True, False])
def test_what_may_matter_is_not_called_adequate(doubtful):
    told = _verdict(SimpleNamespace(screened=[]), [], lacking=False, stable=True, doubtful=doubtful)
    assert told == ("inconclusive" if doubtful else "adequate")
