"""What is too small to matter has no name, but what it may stand for is said."""

from types import SimpleNamespace

import linear_toys as toys
import pytest

from torchcloth.diagnosis.stepwise import MATTERS
from torchcloth.diagnosis.verdict import _minor, _sentences, _verdict


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


def test_the_summary_says_what_it_cannot_be_told_from():
    minor = [small(candidate("obs.depth_bias", 5e-3, -2.5e-3)), small()]
    keys = ("causes", "ruled_out", "undecided", "unresolvable", "lack_of_fit", "drifts", "warnings")
    lists = {key: [] for key in keys}
    said = _sentences(
        "inconclusive", {**lists, **dict.fromkeys(("gain", "also_unexplained", "next_experiment")), "minor": minor}
    )
    assert sum("which would matter" in line for line in said) == 1
    assert any("obs.depth_bias = -0.0025 " in line for line in said)
