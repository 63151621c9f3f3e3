"""One step of the search: the most likely hypotheses are fitted, compared on held-out motions, and one is accepted.

``evaluate_candidates`` is the step, ``gates.accept`` decides whether a candidate may be named. The numbers are in
``criteria``, which lists the gates in their order.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

from ...episodes.world import WorldModel
from ...episodes.world_cache import IMPOSSIBLE_WORLD_ERRORS
from ..data.dataset import DiagnosisData, Progress, prefix_progress
from ..inference.comparison import (
    Gain,
    HeldOutPrediction,
    compare,
    compare_by_motion,
    find_sole_informative_motion,
    list_observed_motions,
    predict_held_out,
)
from ..inference.fitting import ModelFit, add_cause, fit, reweight_by_noise
from ..inference.linearise import Linearisation, restrict_to_common_bins
from ..inference.noise import Noise, cap_noise, fit_noise
from ..inference.permutation_test import PermutationTest, run_permutation_test
from ..inference.screening import ScoreTest
from .criteria import CRITERIA
from .gates import Candidate, accept, choose_t_threshold, drop_implied, is_improvement


@dataclass(frozen=True, eq=False)
class AcceptedCause:
    """An accepted candidate with its rivals.

    Attributes:
        candidate: the accepted one.
        permutation_test: the test that it passed.
        tried: all candidates of the same step.
        rivals: candidates that the data cannot distinguish from it.
        scores: score tests before the step.
        fit_before: the model without it, linearised along everything that was asked about.
        noise: noise by which the candidates were compared.
    """

    candidate: Candidate
    permutation_test: PermutationTest
    tried: list[Candidate]
    rivals: list[Candidate]
    scores: list[ScoreTest]
    fit_before: ModelFit
    noise: Noise

    def replaced_by(self, name: str) -> AcceptedCause | None:
        """Return the step with another of the candidates that were tried; None if there is none of that name."""
        other = next((c for c in self.tried if c.hypothesis.name == name), None)
        if other is None:
            return None
        rivals = [c for c in self.rivals if c is not other and c.hypothesis.implies != name]
        return replace(self, candidate=other, rivals=rivals)


def sole_informative_motions(accepted: Sequence[AcceptedCause]) -> set[str]:
    """Return the motions that alone inform about one of the causes."""
    return {motion for cause in accepted for motion in cause.candidate.sole_informative_motion}


def select_likely(scores: Sequence[ScoreTest]) -> list[ScoreTest]:
    """Return the hypotheses that are worth fitting, the largest expected gain first (gate 1).

    A hypothesis is worth fitting if it is present by its score test, or if so much of it is asked for that it would
    show and would be relevant or gain much. A large effect shifts the fitted parameters so far that slopes there ask
    for less of it than there is. So a hypothesis with a very large expected gain is always fitted.
    """
    screening = CRITERIA.screening

    def is_likely(score: ScoreTest) -> bool:
        if score.decision == "present" or score.expected_gain > CRITERIA.candidate.overwhelming_gain:
            return True
        is_promising = score.expected_gain > screening.min_expected_gain
        return score.is_visible and (is_promising or score.z_above_smallest > screening.min_z_above_smallest)

    return sorted(filter(is_likely, scores), key=lambda score: -score.expected_gain)


def propose_candidates(
    fitted: ModelFit, scores: Sequence[ScoreTest], count: int, skip: int = 0
) -> list[tuple[ScoreTest, WorldModel]]:
    """Return the most likely hypotheses, each with the model to which one robust step leads (gate 2).

    Args:
        fitted: fit without them.
        scores: score tests of that fit.
        count: largest number of hypotheses.
        skip: number of more likely ones that are left out.
    """
    return [(score, add_cause(fitted, score.hypothesis)) for score in select_likely(scores)[skip : skip + count]]


def evaluate_candidates(
    current: ModelFit,
    data: DiagnosisData,
    proposed: Sequence[tuple[ScoreTest, WorldModel]],
    scores: list[ScoreTest],
    progress: Progress,
    more: Sequence[tuple[ScoreTest, WorldModel]] = (),
) -> AcceptedCause | None:
    """Fit candidates, compare them on held-out motions, and accept the best one that may be named.

    Args:
        current: the model so far, linearised along the hypotheses.
        data: the episodes.
        proposed: (score test, model to start the fit from) of each candidate.
        scores: all score tests, for the record.
        progress: called with one line for each episode that is simulated.
        more: further candidates, tried if the best one is implausibly large: what looks like it may be among them.

    Returns:
        The accepted cause with its rivals; None if no candidate may be named.
    """
    likely = _fit_candidates(current, data, proposed, progress)
    if not likely:
        return None
    if more and not _is_plausible(max(likely, key=lambda c: c.gain.log_density), CRITERIA.candidate.max_typical):
        likely += _fit_candidates(current, data, more, progress)

    # An effect that slopes describe badly has passed as noise so far. What the most likely candidate leaves is the
    # noise.
    best_fit = max(likely, key=lambda c: c.gain.log_density).fit.linearisation
    fits = [(c.score, c.fit) for c in likely]
    noise, common = fit_noise(best_fit), _restrict_to_all(best_fit, current, fits)
    tried = _compare_held_out(current, fits, data.motions, noise, common)

    # Gates 5 to 10, then the permutation test of the best one (gate 11). If it fails, the next one is tested.
    named = _rank(drop_implied([c for c in tried if accept(c, data.motions)]))
    others, test = [c for c in tried if c not in named], None
    while named:
        fitted = reweight_by_noise(named[0].fit, noise, common)
        test = run_permutation_test(fitted, data.motions, named[0].sole_informative_motion)
        if test.is_passed:
            break
        others, named = [*others, named[0]], named[1:]
    if not named or test is None:
        return None
    best = named[0]

    # Rivals predict about as well, or clearly better although motions do not agree about their size.
    def predict_as_best(c: Candidate) -> HeldOutPrediction:
        fitted = reweight_by_noise(c.fit, noise, common)
        return predict_held_out(fitted, data.motions, best.sole_informative_motion)

    possible = [*named, *(c for c in others if accept(c, data.motions, role="rival"))]
    rivals = {
        c.hypothesis.name: c
        for c in reversed(possible)
        if c is not best and _predicts_as_well(c, predict_as_best(c), best)
    }
    rivals |= {c.hypothesis.name: c for c in others if _predicts_clearly_better(c, predict_as_best(c), best)}
    return AcceptedCause(best, test, tried, [*reversed(rivals.values())], scores, current, noise)


def _fit_candidates(
    current: ModelFit,
    data: DiagnosisData,
    proposed: Sequence[tuple[ScoreTest, WorldModel]],
    progress: Progress,
) -> list[Candidate]:
    """Fit candidates and compare them with the model without them (gates 3 and 4)."""
    criteria = CRITERIA.candidate

    # Gate 3: a candidate that cannot be simulated is dropped.
    fits: list[tuple[ScoreTest, ModelFit]] = []
    noise = cap_noise(current.noise)
    for score, model in proposed:
        stage = prefix_progress(progress, f"trying {score.hypothesis.name}")
        with suppress(*IMPOSSIBLE_WORLD_ERRORS):
            fits.append((score, fit(model, data, (), 0, stage, noise, current.linearisation)))

    def compare_fits(
        some: list[tuple[ScoreTest, ModelFit]], every: list[tuple[ScoreTest, ModelFit]]
    ) -> list[Candidate]:
        common = _restrict_to_all(current.linearisation, current, every)
        return _compare_held_out(current, some, data.motions, current.noise, common)

    # Gate 4: one step suffices for small effects only. A candidate is fitted further if it predicts well or promises
    # much: a large effect that is half fitted predicts nothing.
    candidates = compare_fits(fits, fits)
    promise = [c.gain.log_density + c.fit.expected_gain for c in candidates]
    refitted: dict[int, tuple[ScoreTest, ModelFit]] = {}
    for k, (c, expected) in enumerate(zip(candidates, promise, strict=True)):
        is_promising = expected > max(0.0, criteria.min_relative_promise * max(promise))
        if is_promising and c.fit.expected_gain > criteria.equal_density:
            stage = prefix_progress(progress, f"trying {c.hypothesis.name} further")
            start = c.fit.linearisation
            further = fit(c.fit.model, data, (), criteria.further_iterations, stage, c.fit.noise, start, start)
            refitted[k] = (c.score, further)
    first, further = [fits[k] for k in refitted], list(refitted.values())
    compared = (compare_fits(some, [*fits, *further]) for some in (first, further))
    for k, before, after in zip(refitted, *compared, strict=True):
        candidates[k] = _choose_fit(before, after)
    return candidates


def _restrict_to_all(
    target: Linearisation, current: ModelFit, fits: Sequence[tuple[ScoreTest, ModelFit]]
) -> Linearisation:
    """Return ``target`` on the bins that all fits have."""
    return restrict_to_common_bins(target, [current.linearisation, *(f.linearisation for _, f in fits)])


def _choose_fit(before: Candidate, after: Candidate) -> Candidate:
    """Return the candidate after further steps, unless it predicts clearly worse.

    A fit that ended at amplitude zero was no fit of the hypothesis, so further steps always replace it.
    """
    tolerance = CRITERIA.candidate.simulator_tolerance * abs(before.gain.log_density)
    is_worse = after.gain.log_density < before.gain.log_density - tolerance
    return before if is_worse and (before.amplitude or not after.amplitude) else after


def _compare_held_out(
    current: ModelFit,
    fits: list[tuple[ScoreTest, ModelFit]],
    motions: list[str],
    noise: Noise,
    common: Linearisation,
) -> list[Candidate]:
    """Compare each fit with the model without it on held-out motions, by one noise on common bins."""
    before, candidates = reweight_by_noise(current, noise, common), []
    strained = {p.name for p, _ in current.model.strained_parameters}
    for score, fitted in fits:
        after = reweight_by_noise(fitted, noise, common)
        sole = find_sole_informative_motion(after, motions)
        first, second = (predict_held_out(f, motions, sole) for f in (before, after))
        gain = compare(first, second, 0.0)
        worsened = _find_worsened_motions(first, second, motions, sole) if sole else []
        observed = list_observed_motions(second.episode, motions)
        candidates.append(
            Candidate(
                score=score,
                fit=fitted,
                prediction=second,
                gain=gain,
                sole_informative_motion=sole,
                t_threshold=choose_t_threshold(gain, observed, sole, is_first=not current.model.accepted),
                worsens_another_motion=bool(worsened),
                is_contradicted=any(g.log_density < -CRITERIA.candidate.equal_density for g in worsened),
                restores_prior=bool(strained - {p.name for p, _ in fitted.model.strained_parameters}),
                prior_shift=_measure_prior_shift(current.model, score.hypothesis.equivalent_parameter),
            )
        )
    return candidates


def _measure_prior_shift(model: WorldModel, parameter: str) -> float:
    """Return the prior standard deviations of a parameter from its data sheet; 0 if the model does not have it."""
    shifts = zip(model.parameters, model.coordinates.tolist(), strict=True)
    return max((abs(c) / p.prior_std for p, c in shifts if p.name == parameter), default=0.0)


def _find_worsened_motions(
    first: HeldOutPrediction, second: HeldOutPrediction, motions: Sequence[str], sole: set[str]
) -> list[Gain]:
    """Return the gains of other motions whose positions are predicted worse."""
    gains = compare_by_motion(first, second, 0.0, motions).items()
    factor = 1 + CRITERIA.candidate.worsened_rms
    return [g for motion, g in gains if motion not in sole and g.rms_after > factor * g.rms_before]


def _rank(named: Sequence[Candidate]) -> list[Candidate]:
    """Sort by log density; among those that predict as well as the best, by the mean square that they remove."""
    best = max((c.gain.log_density for c in named), default=0.0)

    def key(c: Candidate) -> tuple[int, float]:
        if c.gain.log_density > best - CRITERIA.candidate.equal_density:
            return 0, -c.gain.mean_square_removed
        return 1, -c.gain.log_density

    return sorted(named, key=key)


def _is_plausible(c: Candidate, max_typical: float) -> bool:
    return abs(c.amplitude) < max_typical * abs(c.hypothesis.typical)


def _predicts_as_well(c: Candidate, prediction: HeldOutPrediction, best: Candidate) -> bool:
    """Whether a candidate predicts about as well as the best one.

    The paired difference is not clear, or no more than what two simulators may differ by.
    """
    h, criteria = c.hypothesis, CRITERIA.candidate
    is_implication = h.implies == best.hypothesis.name and not h.is_relevant(c.amplitude)
    if h.effect == best.hypothesis.effect or is_implication:
        return False
    over, tolerance = compare(prediction, best.prediction, 0.0), criteria.simulator_tolerance
    is_within_tolerance = (
        over.log_density < tolerance * best.gain.log_density
        and over.mean_square_removed < tolerance * best.gain.mean_square_removed
    )
    return over.log_density < criteria.equal_density or over.lower_bound_95 < 0 or is_within_tolerance


def _predicts_clearly_better(c: Candidate, prediction: HeldOutPrediction, best: Candidate) -> bool:
    """Whether a candidate about whose size motions disagree predicts clearly better than the best of the others.

    Then the best of the others is not the cause alone.
    """
    h, criteria = c.hypothesis, CRITERIA.candidate
    is_implication = bool(h.implies) and not h.is_relevant(c.amplitude)
    if h.effect == best.hypothesis.effect or is_implication:
        return False
    if not (is_improvement(c, c.gain) and _is_plausible(c, criteria.max_typical_of_rival)):
        return False
    over = compare(prediction, best.prediction, 0.0)
    return over.log_density < -criteria.equal_density and over.log_density_ci95[1] < 0
