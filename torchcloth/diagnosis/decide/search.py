"""Stepwise search for causes: score tests, fits of the most likely hypotheses, comparison on held-out motions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from ...episodes.world import Hypothesis, WorldModel
from ...episodes.world_cache import none_if_impossible
from ..data.dataset import DiagnosisData, Progress, prefix_progress
from ..data.replicate_floor import ReplicateFloor, estimate_replicate_floor, find_replicate_pairs
from ..inference.bifurcations import drop_bins, find_bifurcating_bins
from ..inference.comparison import (
    Gain,
    HeldOutPrediction,
    compare,
    has_held_out_motions,
    list_observed_motions,
    predict_held_out,
)
from ..inference.confounding import find_confounded
from ..inference.fitting import ModelFit, fit, put_on_common_noise
from ..inference.heterogeneity import propose_from_heterogeneity
from ..inference.lack_of_fit import has_lack_of_fit
from ..inference.noise import compute_noise_floor, minimal_noise
from ..inference.prior_restarts import propose_from_prior, refit_from_prior
from ..inference.screening import ScoreTest, screen
from ..inference.warm_start import quadratic_warm_start
from .backward_elimination import (
    drop_redundant,
    fraction_explained,
    predictive_gain,
    replace_by_implied,
    supported_only_by_misfit_motions,
)
from .candidates import AcceptedCause, evaluate_candidates, propose_candidates, sole_informative_motions
from .criteria import CRITERIA
from .gates import Candidate, contradicts_data_sheet, worsens_positions


class SearchPath(NamedTuple):
    """Causes that were accepted one after the other.

    Attributes:
        fit: the model with all of them.
        accepted: the causes.
        data: the episodes without bins that respond discontinuously with them.
    """

    fit: ModelFit
    accepted: list[AcceptedCause]
    data: DiagnosisData


@dataclass(frozen=True, eq=False)
class SearchResult:
    """Result of a search.

    Attributes:
        start: fit of the base model.
        end: fit with all causes.
        accepted: the causes, those that are too small to be relevant among them.
        scores: score tests at the end.
        held_out: predictions of held-out motions by the model at the start and at the end; of a single motion, of
            every other block of time windows by the others.
        total_gain: gain of all causes together; None without causes.
        noise_floor: RMS of a position bin [m]: of repetitions if there are any, else of the sensor.
        sensor_floor: RMS of a position bin by sensor noise and slow errors [m].
        replicate_floor: noise floor by repetitions; None if no episode repeats another.
        data: the episodes without bins that respond discontinuously.
        withdrawn: causes that were accepted, and that a law without a cause outperforms.
        not_simulated: hypotheses that could not be simulated with the fitted model.
    """

    start: ModelFit
    end: ModelFit
    accepted: list[AcceptedCause]
    scores: list[ScoreTest]
    held_out: tuple[HeldOutPrediction, HeldOutPrediction]
    total_gain: Gain | None
    noise_floor: float
    sensor_floor: float
    replicate_floor: ReplicateFloor | None
    data: DiagnosisData
    withdrawn: tuple[str, ...] = ()
    not_simulated: tuple[str, ...] = ()

    @property
    def has_held_out_motions(self) -> bool:
        """Whether the episodes show two motions, without which no cause is named."""
        return has_held_out_motions(self.end.whitened.episode, self.data.motions)

    @property
    def causes(self) -> list[AcceptedCause]:
        """Causes that are large enough to be named (gate 16).

        The others stay in the model, so that nothing takes their place. Of confounded hypotheses one must be relevant,
        and all others at least half as large as the smallest effect of interest.
        """

        def is_relevant(pairs: list[tuple[Hypothesis, float]]) -> bool:
            return any(h.is_relevant(a) for h, a in pairs) and all(h.is_possibly_relevant(a) for h, a in pairs)

        return [cause for cause in self.accepted if is_relevant(self.equivalents(cause))]

    @property
    def minor(self) -> list[AcceptedCause]:
        """Causes in the model without a name: they, or hypotheses that predict as well, are too small."""
        named = self.causes
        return [cause for cause in self.accepted if cause not in named]

    def rivals(self, cause: AcceptedCause) -> list[Candidate]:
        """Return a cause's rivals at the end; a rival that joined the model is none any more."""
        names = {other.candidate.hypothesis.name for other in self.accepted}
        return [c for c in cause.rivals if c.hypothesis.name not in names]

    def confounded_scores(self, cause: AcceptedCause) -> list[ScoreTest]:
        """Return hypotheses that are confounded with a cause, linearised.

        Hypotheses that predictions distinguish from it, or that are in the model, are left out.
        """
        h = cause.candidate.hypothesis
        beaten = {c.hypothesis.name for c in cause.tried} - {c.hypothesis.name for c in cause.rivals}
        distinguished = beaten | {other.candidate.hypothesis.name for other in self.accepted} - {h.name}
        others = [s for s in cause.scores if s.chi2 > 0 and s.hypothesis.name not in distinguished]
        return find_confounded(cause.fit_before, cause.candidate.score, self.amplitude(cause), others)

    def equivalents(self, cause: AcceptedCause) -> list[tuple[Hypothesis, float]]:
        """Return a cause at the end, its rivals and hypotheses that are confounded with it, with amplitudes.

        Structurally equivalent hypotheses are left out, because their amplitude says nothing more.
        """
        h, rivals = cause.candidate.hypothesis, [(c.hypothesis, c.amplitude) for c in self.rivals(cause)]
        listed = {*h.structurally_equivalent, *(rival.name for rival, _ in rivals)}
        confounded = [(s.hypothesis, s.amplitude) for s in self.confounded_scores(cause)]
        return [(h, self.amplitude(cause)), *rivals, *((c, a) for c, a in confounded if c.name not in listed)]

    def amplitude(self, cause: AcceptedCause) -> float:
        """Return a cause's amplitude at the end, in the hypothesis's unit."""
        return self.end.model.amplitudes[self.end.model.index_of(cause.candidate.hypothesis.name)]

    @property
    def bifurcating_fraction(self) -> float:
        """Fraction of the bins that respond discontinuously."""
        count = sum(map(len, self.data.bifurcating_bins or ()))
        return count / (count + len(self.end.whitened.value))


def search(
    model: WorldModel, data: DiagnosisData, hypotheses: Sequence[Hypothesis], progress: Progress = lambda _: None
) -> SearchResult:
    """Accept causes one after the other until no candidate may be named.

    If none may be named, the search starts again from the data sheet, then from parameters about which motions
    disagree. With a single motion the base model is fitted and screened, and no cause is searched for.

    Args:
        model: the base model at the data sheet.
        data: the episodes.
        hypotheses: what is asked about.
        progress: called with one line for each episode that is simulated.
    """
    hypotheses = model.not_accepted(hypotheses)
    near, before = quadratic_warm_start(model, data, prefix_progress(progress, "from the data sheet"))
    start = fit(near, data, hypotheses, progress=prefix_progress(progress, "base model"), before=before)
    keys = find_bifurcating_bins(start, data, prefix_progress(progress, "bifurcating bins"))
    if any(map(len, keys)):
        data, start = data.without_bins(keys), drop_bins(start, keys)
    if not has_held_out_motions(start.whitened.episode, data.motions):
        not_simulated = tuple(_list_not_simulated(start, hypotheses))
        return replace(_summarise(start, SearchPath(start, [], data)), not_simulated=not_simulated)
    path = _search_stepwise(start, data, hypotheses, progress, CRITERIA.candidate.max_tried)
    if not path.accepted:
        path = _search_from_prior(start, data, hypotheses, progress)
    if not path.accepted:
        path = _search_heterogeneous(start, data, hypotheses, progress)
    not_simulated = [*_list_not_simulated(start, hypotheses)]
    not_simulated += _list_not_simulated(path.fit, hypotheses) if path.accepted else []
    return replace(_summarise(start, path), not_simulated=tuple(dict.fromkeys(not_simulated)))


def _list_not_simulated(fitted: ModelFit, hypotheses: Sequence[Hypothesis]) -> list[str]:
    """Return the hypotheses that were asked about and could not be simulated with the model."""
    simulated = {h.name for h in fitted.linearisation.hypotheses}
    return [h.name for h in fitted.model.not_accepted(hypotheses) if h.name not in simulated]


def _search_from_prior(
    start: ModelFit, data: DiagnosisData, hypotheses: Sequence[Hypothesis], progress: Progress
) -> SearchPath:
    """Search with a first cause that starts from the data sheet.

    If the base model has no lack of fit, the cause must surely gain what no cause of a null case does.
    """
    criteria = CRITERIA.candidate
    is_inadequate = has_lack_of_fit(start, data.motions)
    n_motions = len(set(list_observed_motions(start.whitened.episode, data.motions)))
    if not is_inadequate and n_motions < criteria.min_motions:
        return SearchPath(start, [], data)
    scores = screen(start)
    by_name = {score.hypothesis.name: score for score in scores}
    visible = [score.hypothesis for score in scores if score.visibility]
    min_gain = 0.0 if is_inadequate else CRITERIA.screening.min_expected_gain
    likely = none_if_impossible(
        lambda: propose_from_prior(start, data, visible, criteria.max_tried, progress, min_gain)
    )
    proposed = [(by_name[h.name], model) for h, model in likely or []]
    first = evaluate_candidates(start, data, proposed, scores, progress)
    if first is None or not (is_inadequate or first.candidate.gain.lower_bound_95 > criteria.certain_gain):
        return SearchPath(start, [], data)
    return _search_stepwise(start, data, hypotheses, progress, criteria.max_tried, first)


def _search_heterogeneous(
    start: ModelFit, data: DiagnosisData, hypotheses: Sequence[Hypothesis], progress: Progress
) -> SearchPath:
    """Search with a first cause that changes a law about whose parameter motions disagree."""
    starts, scores = propose_from_heterogeneity(start, data.motions, hypotheses), screen(start)
    by_name = {score.hypothesis.name: score for score in scores if score.visibility}
    proposed = [(by_name[h.name], model) for h, model in starts if h.name in by_name]
    if not proposed:
        return SearchPath(start, [], data)
    first = evaluate_candidates(start, data, proposed, scores, prefix_progress(progress, "motions disagree"), ())
    if first is None:
        return SearchPath(start, [], data)
    return _search_stepwise(start, data, hypotheses, progress, CRITERIA.candidate.max_tried, first)


def extend_search(
    start: ModelFit,
    data: DiagnosisData,
    hypotheses: Sequence[Hypothesis],
    progress: Progress = lambda _: None,
    max_tried: int = CRITERIA.candidate.max_tried,
) -> SearchResult:
    """Continue a search from a fit until no lack of fit is left.

    Args:
        start: fit that was linearised along the hypotheses.
        data: the episodes.
        hypotheses: what is asked about.
        progress: called with one line for each episode that is simulated.
        max_tried: candidates that are fitted at each step.
    """

    def is_adequate(fitted: ModelFit) -> bool:
        return not has_lack_of_fit(fitted, data.motions)

    return _summarise(start, _search_stepwise(start, data, hypotheses, progress, max_tried, is_enough=is_adequate))


def replace_by_law(
    result: SearchResult, laws: ModelFit, max_tried: int, progress: Progress = lambda _: None
) -> SearchResult:
    """Drop all causes if one law alone predicts clearly better than all of them together (gate 15).

    Args:
        result: a search with causes.
        laws: fit at its start, linearised along laws that are no causes.
        max_tried: laws that are fitted.
        progress: called with one line for each episode that is simulated.
    """
    if result.total_gain is None:
        return result
    scores, data, total = screen(laws), result.data, result.total_gain.log_density
    proposed = propose_candidates(laws, [score for score in scores if score.expected_gain > total], max_tried)
    best = evaluate_candidates(laws, data, proposed, scores, progress)
    if best is None:
        return result
    sole = sole_informative_motions(result.accepted)
    law, end = (
        predict_held_out(fitted, data.motions, sole) for fitted in put_on_common_noise(best.candidate.fit, result.end)
    )
    over = compare(end, law, 0.0)
    if over.lower_bound_95 < 0 or over.log_density < CRITERIA.search.min_relative_gain_of_law * total:
        return result
    withdrawn = tuple(cause.candidate.hypothesis.name for cause in result.causes)
    none = _summarise(result.start, SearchPath(result.start, [], data))
    return replace(none, withdrawn=withdrawn, not_simulated=result.not_simulated)


def _search_stepwise(
    start: ModelFit,
    data: DiagnosisData,
    hypotheses: Sequence[Hypothesis],
    progress: Progress,
    max_tried: int,
    first: AcceptedCause | None = None,
    is_enough: Callable[[ModelFit], bool] = lambda _: False,
) -> SearchPath:
    """Accept causes one after the other, after ``first`` if given, until none may be named or the model is enough."""
    criteria, no_causes = CRITERIA.search, SearchPath(start, [], data)

    def linearise_others(fitted: ModelFit, stage: Progress) -> ModelFit:
        others = fitted.model.not_accepted(hypotheses)
        return fit(fitted.model, data, others, 0, stage, before=start.linearisation, here=fitted.linearisation)

    current, accepted, cause = start, [], first
    while len(accepted) < criteria.max_causes:
        if cause is None:
            # A parameter that made up for a cause before it was known is fitted again from its data sheet.
            refitted = None
            if accepted and current.model.strained_parameters:
                refitted = refit_from_prior(current, data, hypotheses, progress)
            if refitted is not None and predictive_gain(refitted, current, data.motions) > 0:
                current, refitted = refitted, None
            scores = screen(current)
            proposed = propose_candidates(current, scores, max_tried)
            proposed += [] if refitted is None else propose_candidates(refitted, screen(refitted), max_tried)
            more = propose_candidates(current, scores, max_tried, skip=max_tried)
            cause = evaluate_candidates(current, data, proposed, scores, progress, more)
        if cause is None:
            break

        # All coordinates are fitted with the new cause. Bins that respond discontinuously with it are dropped.
        best, before, state = cause.candidate.fit, current, (start, data)
        stage = prefix_progress(progress, f"with {cause.candidate.hypothesis.name}")
        current = fit(
            best.model,
            data,
            (),
            CRITERIA.candidate.further_iterations,
            stage,
            before=start.linearisation,
            here=best.linearisation,
        )
        if has_lack_of_fit(current, data.motions):
            start, current, data = _drop_new_bifurcations(start, current, data, stage)

        # Gate 12: a further cause explains enough of what the others left.
        sole = sole_informative_motions([*accepted, cause])
        min_fraction = criteria.min_fraction_of_further_cause
        if accepted and fraction_explained(before, current, data.motions, sole) < min_fraction:
            current, (start, data) = before, state
            break
        accepted, cause = [*accepted, cause], None
        if is_enough(current):
            break
        current = linearise_others(current, stage)

    # Gate 13: backward elimination, and a fit of all causes together if it promises much.
    current, accepted = replace_by_implied(current, accepted, data, hypotheses, progress)
    current, accepted = drop_redundant(current, accepted, data, hypotheses, progress)
    if accepted and current.expected_gain > criteria.min_refit_gain:
        here, stage = current.linearisation, prefix_progress(progress, "all")
        current = fit(current.model, data, progress=stage, before=here, here=here)
        current = current if is_enough(current) else linearise_others(current, stage)
        current, accepted = drop_redundant(current, accepted, data, hypotheses, progress)

    # Gate 14: all causes together explain enough of the misfit.
    if not accepted:
        return SearchPath(current, accepted, data)
    fraction = fraction_explained(start, current, data.motions, sole_informative_motions(accepted))
    if fraction < criteria.min_fraction_explained:
        return no_causes
    if fraction < criteria.min_fraction_without_support and supported_only_by_misfit_motions(
        start, current, accepted, data.motions
    ):
        return no_causes
    contradicts = any(contradicts_data_sheet(c.candidate, c.candidate.gain) for c in accepted)
    if not contradicts and _is_idle(_compute_total_gain(start, current, accepted, data), start, accepted, data):
        return no_causes
    return SearchPath(current, accepted, data)


def _drop_new_bifurcations(
    start: ModelFit, current: ModelFit, data: DiagnosisData, progress: Progress
) -> tuple[ModelFit, ModelFit, DiagnosisData]:
    """Drop bins that respond discontinuously with the causes in the model, if they alone cause the lack of fit.

    For example, slack that a slipping grip leaves buckles to either side.
    """
    keys = find_bifurcating_bins(current, data, prefix_progress(progress, "bifurcating bins"))
    if not any(map(len, keys)) or has_lack_of_fit(remaining := drop_bins(current, keys), data.motions):
        return start, current, data
    return drop_bins(start, keys), remaining, data.without_bins(keys)


def _compute_total_gain(start: ModelFit, current: ModelFit, accepted: list[AcceptedCause], data: DiagnosisData) -> Gain:
    floor = compute_noise_floor(current.linearisation, minimal_noise())
    return compare(*_predict_start_and_end(start, current, accepted, data), floor)


def _is_idle(total: Gain, start: ModelFit, accepted: list[AcceptedCause], data: DiagnosisData) -> bool:
    """Whether positions are predicted worse, or hardly better where the base model was adequate, and so are forces.

    Hardly better suffices if a parameter of the fabric returns to its data sheet.
    """
    if worsens_positions(total):
        return True
    has_small_gain = (
        total.explained_fraction < CRITERIA.search.min_fraction_if_adequate
        and total.rms_removed[1] < CRITERIA.candidate.min_force_n
    )
    restores_prior = any(cause.candidate.restores_prior for cause in accepted)
    return has_small_gain and not restores_prior and not has_lack_of_fit(start, data.motions)


def _predict_start_and_end(
    start: ModelFit, current: ModelFit, accepted: list[AcceptedCause], data: DiagnosisData
) -> tuple[HeldOutPrediction, HeldOutPrediction]:
    first, last = put_on_common_noise(start, current)
    halved = _list_halved_motions(current, accepted, data)
    return predict_held_out(first, data.motions, halved), predict_held_out(last, data.motions, halved)


def _list_halved_motions(fitted: ModelFit, accepted: list[AcceptedCause], data: DiagnosisData) -> set[str]:
    """Return the motions of which halves are held out: the informative one of a cause, or the only one."""
    if not has_held_out_motions(fitted.whitened.episode, data.motions):
        return set(data.motions)
    return sole_informative_motions(accepted)


def _summarise(start: ModelFit, path: SearchPath) -> SearchResult:
    current, accepted, data = path
    last = predict_held_out(current, data.motions, _list_halved_motions(current, accepted, data))
    # slow errors that were fitted may be the model's own, so the floor has the smallest ones
    sensor_floor = compute_noise_floor(current.linearisation, minimal_noise())
    replicate_floor = estimate_replicate_floor(last, find_replicate_pairs(data.recordings, data.episodes))
    noise_floor = sensor_floor if replicate_floor is None else replicate_floor.rms
    held_out = _predict_start_and_end(start, current, accepted, data)
    return SearchResult(
        start=start,
        end=current,
        accepted=accepted,
        scores=screen(current),
        held_out=held_out,
        total_gain=compare(*held_out, noise_floor) if accepted else None,
        noise_floor=noise_floor,
        sensor_floor=sensor_floor,
        replicate_floor=replicate_floor,
        data=data,
    )
