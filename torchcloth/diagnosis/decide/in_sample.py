"""Ranking of hypotheses by the residuals of a single motion, which no other motion can confirm."""

from __future__ import annotations

from typing import Any, NamedTuple

from ..inference.confounding import find_confounded
from ..inference.screening import ScoreTest
from .candidates import select_likely
from .criteria import CRITERIA
from .search import SearchResult


class InSampleExplanation(NamedTuple):
    """Hypothesis that would explain the residuals of the motion that it was derived from.

    Attributes:
        score: its score test.
        explains_as_well: whether it explains them about as well as the best one, or is confounded with that one.
    """

    score: ScoreTest
    explains_as_well: bool

    def as_dict(self) -> dict[str, Any]:
        """Return the row of diagnosis.json."""
        h = self.score.hypothesis
        return {
            "effect": h.name,
            "amplitude": self.score.step_amplitude,
            "unit": h.unit,
            "expected_gain": self.score.expected_gain,
            "explains_as_well": self.explains_as_well,
        }


def rank_in_sample(result: SearchResult) -> list[InSampleExplanation]:
    """Return the hypotheses that are worth a fit, the largest expected gain first; empty if motions were held out.

    Each would be a candidate if another motion were there to predict. Two explain the data equally well if their
    expected gains differ by less than what two simulators may differ by.

    Args:
        result: the search.
    """
    likely = [] if result.has_held_out_motions else select_likely(result.scores)
    likely = [score for score in likely if not score.has_wrong_sign and score.step_amplitude]
    if not likely:
        return []
    best, criteria = likely[0], CRITERIA.candidate
    margin = max(criteria.equal_density, criteria.simulator_tolerance * best.expected_gain)
    confounded = find_confounded(result.end, best, best.step_amplitude, likely[1:])
    names = {score.hypothesis.name for score in (best, *confounded)}
    return [
        InSampleExplanation(s, s.hypothesis.name in names or s.expected_gain > best.expected_gain - margin)
        for s in likely
    ]
