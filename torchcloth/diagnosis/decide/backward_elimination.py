"""Backward elimination: accepted causes that others make redundant, or that stand for something unknown."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

from ...episodes.world import Hypothesis
from ...episodes.world_cache import IMPOSSIBLE_WORLD_ERRORS
from ..data.dataset import DiagnosisData, Progress, prefix_progress
from ..inference.comparison import compare, predict_held_out, select_episodes
from ..inference.fitting import ModelFit, fit, put_on_common_noise, remove_cause, reweight_by_noise
from ..inference.lack_of_fit import compare_misfit, has_lack_of_fit, measure_lack_of_fit
from ..inference.linearise import restrict_to_common_bins
from ..inference.noise import compute_noise_floor
from ..inference.permutation_test import run_permutation_test
from .candidates import AcceptedCause, sole_informative_motions
from .criteria import CRITERIA
from .gates import accept, is_worthwhile


def drop_redundant(
    current: ModelFit,
    accepted: list[AcceptedCause],
    data: DiagnosisData,
    hypotheses: Sequence[Hypothesis],
    progress: Progress,
) -> tuple[ModelFit, list[AcceptedCause]]:
    """Drop causes that the others have made redundant (gate 13).

    Args:
        current: the model with all causes.
        accepted: the causes.
        data: the episodes.
        hypotheses: all that are asked about.
        progress: called with one line for each episode that is simulated.

    Returns:
        The model with the remaining causes, and these.
    """
    for cause in accepted:
        name = cause.candidate.hypothesis.name
        without, stage = remove_cause(current, name), prefix_progress(progress, f"without {name}")
        try:
            without = fit(without, data, (), 0, stage, current.noise, current.linearisation)
        except IMPOSSIBLE_WORLD_ERRORS:  # the cause keeps the others from values that no cloth has
            continue
        sole = cause.candidate.sole_informative_motion
        first, second = (predict_held_out(f, data.motions, sole) for f in put_on_common_noise(without, current))
        if accept(cause.candidate, data.motions, current, compare(first, second, 0.0), role="accepted"):
            continue
        accepted = [c for c in accepted if c is not cause]
        others = without.model.not_accepted(hypotheses)
        current = fit(
            without.model, data, others, 1, progress, before=current.linearisation, here=without.linearisation
        )
    return current, accepted


def replace_by_implied(
    current: ModelFit,
    accepted: list[AcceptedCause],
    data: DiagnosisData,
    hypotheses: Sequence[Hypothesis],
    progress: Progress,
) -> tuple[ModelFit, list[AcceptedCause]]:
    """Replace a cause by the hypothesis that it implies if its own amplitude is irrelevant in the end (gate 13).

    An example is drag that comes with wind, where the wind stood for a camera offset until that was found.

    Args:
        current: the model with all causes.
        accepted: the causes.
        data: the episodes.
        hypotheses: all that are asked about.
        progress: called with one line for each episode that is simulated.

    Returns:
        The model with the causes after the replacement, and these.
    """
    criteria = CRITERIA.candidate
    for k, cause in enumerate(accepted):
        h, model = cause.candidate.hypothesis, current.model
        replacement = cause.replaced_by(h.implies)
        if (
            replacement is None
            or h.is_relevant(model.amplitudes[model.index_of(h.name)])
            or h.implies in (other.name for other in model.accepted)
        ):
            continue
        implied, sole = replacement.candidate.hypothesis, replacement.candidate.sole_informative_motion
        simpler = remove_cause(current, h.name).with_hypothesis(implied, implied.typical)
        others, stage = simpler.not_accepted(hypotheses), prefix_progress(progress, f"{h.implies} instead of {h.name}")
        try:
            fitted = fit(simpler, data, others, criteria.further_iterations, stage, before=current.linearisation)
        except IMPOSSIBLE_WORLD_ERRORS:
            continue
        reweighted = reweight_by_noise(replacement.candidate.fit, fitted.noise, fitted.linearisation)
        test = run_permutation_test(reweighted, data.motions, sole)
        if test.is_passed and predictive_gain(current, fitted, data.motions) < criteria.equal_density:
            current = fitted
            accepted = [*accepted[:k], replace(replacement, permutation_test=test), *accepted[k + 1 :]]
    return current, accepted


def fraction_explained(start: ModelFit, end: ModelFit, motions: Sequence[str], halved: Collection[str] = ()) -> float:
    """Compute the fraction of the misfit that is removed.

    It is 1 if the end has no significant lack of fit, or if the start had none and the misfit decreases. If causes
    explain less than half, more is still there, and whatever causes it may also have caused what passed for the causes.
    If the meshes agree about less than half of the motions, the explained fraction on held-out motions is returned.
    Only bins that both fits have count: points that vacuum finds on another part of the cloth would come back as if the
    causes had brought their misfit.

    Args:
        start: the model without the causes.
        end: the model with them.
        motions: label of each episode.
        halved: as in ``predict_held_out``.
    """
    first, last = (
        measure_lack_of_fit(
            replace(fitted, linearisation=restrict_to_common_bins(fitted.linearisation, [other.linearisation])), motions
        )
        for fitted, other in ((start, end), (end, start))
    )
    unjudged = {row.episode for row in (*first, *last) if not row.meshes_agree}
    if 2 * len(unjudged) <= len(motions):
        if not has_lack_of_fit(end, motions):
            return 1.0
        fraction = compare_misfit(first, last)
        return fraction if fraction < 0 or any(row.is_significant for row in first) else 1.0
    before, after = (predict_held_out(f, motions, halved) for f in put_on_common_noise(start, end))
    return compare(before, after, compute_noise_floor(end.linearisation, end.noise)).explained_fraction


def supported_only_by_misfit_motions(
    start: ModelFit, end: ModelFit, accepted: Sequence[AcceptedCause], motions: Sequence[str]
) -> bool:
    """Check whether the causes gain nothing in motions that fit in the end, if there are such motions.

    Args:
        start: the model without the causes.
        end: the model with them.
        accepted: the causes.
        motions: label of each episode.
    """
    rows = measure_lack_of_fit(end, motions)  # a motion without bins has no row
    adequate = {row.motion for row in rows} - {row.motion for row in rows if row.is_significant or not row.meshes_agree}
    episodes = [k for k, motion in enumerate(motions) if motion in adequate]
    sole = sole_informative_motions(accepted)
    if not episodes:
        return False
    first, last = (predict_held_out(f, motions, sole) for f in put_on_common_noise(start, end))
    return not is_worthwhile(compare(select_episodes(first, episodes), select_episodes(last, episodes), 0.0))


def predictive_gain(one: ModelFit, other: ModelFit, motions: Sequence[str]) -> float:
    """Compute the log density by which one fit predicts held-out motions better than another."""
    second, first = (predict_held_out(f, motions) for f in put_on_common_noise(one, other))
    return compare(first, second, 0.0).log_density
