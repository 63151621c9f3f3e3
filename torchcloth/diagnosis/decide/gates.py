"""A fitted hypothesis, and the gates 5 to 10 that it passes to be named as a cause.

``accept`` applies most of them. ``criteria`` lists all gates in their order and holds the numbers.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Literal

from ..._utils.constants import Z_95
from ...episodes.world import Hypothesis
from ..inference.comparison import Gain, HeldOutPrediction, jackknife, list_observed_motions
from ..inference.fitting import ModelFit
from ..inference.screening import ScoreTest
from .criteria import CRITERIA, CandidateCriteria

Role = Literal["new", "accepted", "rival"]


@dataclass(frozen=True, eq=False)
class Candidate:
    """A hypothesis that was fitted.

    Attributes:
        score: its score test.
        fit: the model with it.
        prediction: of held-out motions.
        gain: over the model without it, on held-out motions.
        sole_informative_motion: the motion that alone informs about it; empty in most cases.
        t_threshold: standard errors between motions by which its amplitude must differ from zero.
        worsens_another_motion: whether one motion alone informs about it and positions of another one are predicted
            worse.
        is_contradicted: whether, in addition, that other motion is clearly less likely.
        restores_prior: whether a parameter that had left its data sheet returns to it.
        prior_shift: prior standard deviations by which the parameter that it equals had left the data sheet.
    """

    score: ScoreTest
    fit: ModelFit
    prediction: HeldOutPrediction
    gain: Gain
    sole_informative_motion: set[str]
    t_threshold: float
    worsens_another_motion: bool = False
    is_contradicted: bool = False
    restores_prior: bool = False
    prior_shift: float = 0.0

    @property
    def hypothesis(self) -> Hypothesis:
        """The hypothesis that was added."""
        return self.score.hypothesis

    @property
    def amplitude(self) -> float:
        """Its fitted amplitude, in the hypothesis's unit."""
        return self.fit.model.amplitudes[self.fit.model.index_of(self.hypothesis.name)]


def accept(
    candidate: Candidate,
    motions: Sequence[str],
    fitted: ModelFit | None = None,
    gain: Gain | None = None,
    role: Role = "new",
    criteria: CandidateCriteria = CRITERIA.candidate,
) -> bool:
    """Decide whether a candidate may be named (gates 5 to 9).

    A rival is held to a weaker test than a cause: it need not be there, it only must not be excluded by the data.

    Args:
        candidate: the candidate.
        motions: label of each episode.
        fitted: a model with the candidate; None: its own fit.
        gain: gain over that model without the candidate; None: its own gain.
        role: "new" for a new cause, "accepted" for a cause that is in the model and is judged again, "rival" for what
            may be there instead of a cause.
        criteria: thresholds.
    """
    fitted = candidate.fit if fitted is None else fitted
    gain = candidate.gain if gain is None else gain

    # Gate 5. If one motion alone informs about a new cause, the cause has predicted no other motion. Then its gain must
    # be larger than that of any cause of a null case.
    if role == "new" and candidate.sole_informative_motion:
        n_motions = len(set(list_observed_motions(candidate.prediction.episode, motions)))
        has_few = n_motions < criteria.min_motions
        min_gain = criteria.certain_gain_few_motions if has_few else criteria.certain_gain
        if not candidate.gain.lower_bound_95 > min_gain:
            return False

    # Gates 6 and 7. It improves the predictions noticeably, or its equivalent parameter contradicts the data sheet.
    if not is_improvement(candidate, gain, criteria):
        return False

    # Gate 8. Motions agree that the amplitude is not zero, and the mesh error does not explain it. Halves of the sole
    # informative motion need not agree about the size if the gain is overwhelming in both and all other motions stay as
    # they were: creases level off with their rate, and slopes say little there. Halves of such a motion need not agree
    # about a rival either, because a law that is not quite right differs from early to late. Nothing need agree if the
    # equivalent parameter has shifted so far that nothing else shifts it there.
    is_shifted = candidate.prior_shift > criteria.max_prior_shift
    index = fitted.model.index_of(candidate.hypothesis.name)
    amplitude, typical = fitted.model.amplitudes[index], fitted.model.accepted[index].typical
    coordinate = len(fitted.model.parameters) + index
    mean, std = (float(v[coordinate]) for v in jackknife(fitted, motions, candidate.sole_informative_motion))
    is_overwhelming = (
        bool(candidate.sole_informative_motion)
        and candidate.gain.lower_bound_95 > criteria.overwhelming_gain
        and not candidate.worsens_another_motion
    )
    if is_overwhelming or is_shifted:
        mean, std = amplitude, 0.0
    t_threshold = candidate.t_threshold
    if role == "rival":
        t_threshold = 0.0 if candidate.sole_informative_motion else Z_95
    if t_threshold == math.inf or not max(t_threshold * std, Z_95 * abs(candidate.score.mesh_bias)) < abs(mean):
        return False

    # Gate 9. No other motion is clearly less likely with it, and the amplitude is plausible; a fit that ended at zero
    # is no cause. A cause does not stand alone because its rival is a little too large.
    if candidate.is_contradicted and not is_shifted:
        return False
    max_typical = criteria.max_typical_of_rival if role == "rival" else criteria.max_typical
    return 0 < abs(amplitude) < max_typical * abs(typical)


def is_improvement(c: Candidate, gain: Gain, criteria: CandidateCriteria = CRITERIA.candidate) -> bool:
    """Check whether a candidate improves the predictions enough to be named (gates 6 and 7).

    Beside the parameter that it equals nothing is left to remove, so such a candidate only has to gain surely, or to
    contradict the data sheet.

    Args:
        c: the candidate.
        gain: its gain on held-out motions.
        criteria: thresholds.
    """
    if not _equals_fitted_parameter(c):
        return is_worthwhile(gain, criteria)
    return gain.lower_bound_95 > 0 or contradicts_data_sheet(c, gain, criteria)


def contradicts_data_sheet(c: Candidate, gain: Gain, criteria: CandidateCriteria = CRITERIA.candidate) -> bool:
    """Check whether a candidate equals a fitted parameter whose data sheet is surely wrong (gate 7).

    With that parameter shifted the model predicts as well, so the candidate need not gain more.

    Args:
        c: the candidate.
        gain: its gain on held-out motions.
        criteria: thresholds.
    """
    if not _equals_fitted_parameter(c) or gain.log_density <= criteria.equal_density:
        return False
    is_certain = c.score.decision == "present" and c.score.expected_gain > criteria.overwhelming_gain
    return c.prior_shift > criteria.max_prior_shift or is_certain


def _equals_fitted_parameter(c: Candidate) -> bool:
    """Whether the candidate equals a parameter of the model and shows beside its data sheet."""
    parameter = c.hypothesis.equivalent_parameter
    return bool(parameter) and parameter in (p.name for p in c.fit.model.parameters) and c.score.is_visible


def is_worthwhile(gain: Gain, criteria: CandidateCriteria = CRITERIA.candidate) -> bool:
    """Check whether a gain is certain, and large enough to be noticed or larger than any chance (gate 6).

    Beside parameters that the cause has shifted, hardly a millimetre may be left to remove.

    Args:
        gain: gain on held-out motions.
        criteria: thresholds.
    """
    displacement, force = gain.rms_removed
    is_noticeable = (
        gain.mean_square_removed > criteria.min_square_fraction * gain.robust_rms[0] ** 2
        or displacement > criteria.min_displacement_m
        or force > criteria.min_force_n
    )
    is_large = is_noticeable or gain.lower_bound_95 > criteria.certain_gain
    return is_large and gain.lower_bound_95 > 0 and not worsens_positions(gain, criteria)


def worsens_positions(gain: Gain, criteria: CandidateCriteria = CRITERIA.candidate) -> bool:
    """Check whether all positions together are predicted worse and forces hardly better.

    Args:
        gain: gain on held-out motions.
        criteria: thresholds.
    """
    return gain.rms_after > gain.rms_before and gain.rms_removed[1] < criteria.min_force_n


def drop_implied(named: Sequence[Candidate]) -> list[Candidate]:
    """Drop candidates that are relevant only by what they imply, if that predicts about as well alone (gate 10)."""
    by_name = {c.hypothesis.name: c for c in named}
    tolerance = CRITERIA.candidate.simulator_tolerance

    def is_explained_by_implied(c: Candidate) -> bool:
        implied = None if c.hypothesis.is_relevant(c.amplitude) else by_name.get(c.hypothesis.implies)
        return implied is not None and implied.gain.log_density > (1 - tolerance) * c.gain.log_density

    return [c for c in named if not is_explained_by_implied(c)]


def choose_t_threshold(gain: Gain, motions: Sequence[str], sole: set[str], is_first: bool) -> float:
    """Return the standard errors between motions by which an amplitude must differ from zero.

    A further cause is the best of several on what a first one left, part of which is the first one badly described.

    Args:
        gain: gain of the cause.
        motions: motions that were observed.
        sole: the motion that alone informs about the cause, if any.
        is_first: whether the model has no cause yet.
    """
    criteria = CRITERIA.candidate
    # If a first cause removes a large part of the misfit of held-out motions, the predictions have shown that it is
    # there, and motions may differ about its size. Two motions differ only once, which says nothing.
    removed = gain.rms_before**2 - gain.rms_after**2
    is_dominant = removed > criteria.dominant_fraction * gain.rms_before**2
    if is_first and len(set(motions)) >= criteria.min_motions and is_dominant:
        return Z_95
    return look_up_t_quantile(motions, sole, criteria.t_quantiles if is_first else criteria.t_quantiles_best_of_four)


def look_up_t_quantile(
    motions: Sequence[str], sole: Collection[str] = (), table: Sequence[float] = CRITERIA.candidate.t_quantiles
) -> float:
    """Return Student's quantile for a mean over motions; infinite for a single motion.

    Args:
        motions: motions that were observed.
        sole: motions that alone inform; each counts as two, because it is halved.
        table: quantiles by degrees of freedom.
    """
    count = len(set(motions)) + len(sole)
    return table[min(count - 2, len(table) - 1)] if count > 1 else math.inf
