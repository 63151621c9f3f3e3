"""Stepwise search for causes: screen, fit the likeliest anew, compare on motions held out, accept, and again."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from ...episodes.world import Hypothesis, Model
from ...episodes.world_cache import if_possible
from ..data.dataset import Progress, DiagnosisData, prefix_progress
from ..data.replicate_floor import ReplicateFloor, find_replicate_pairs, estimate_replicate_floor
from ..inference.bifurcations import find_bifurcating_bins, drop_bins
from ..inference.comparison import Gain, HeldOutPrediction, compare, list_observed_motions, predict_held_out
from ..inference.confounding import find_confounded
from ..inference.fitting import ModelFit, fit, put_on_common_noise
from ..inference.heterogeneity import propose_from_heterogeneity
from ..inference.lack_of_fit import has_lack_of_fit
from ..inference.noise import compute_noise_floor, minimal_noise
from ..inference.prior_restarts import propose_from_prior, refit_from_prior
from ..inference.screening import MUCH, ScoreTest, screen
from ..inference.warm_start import quadratic_warm_start
from .backward_elimination import fraction_explained, replace_by_implied, predictive_gain, drop_redundant, supported_only_by_misfit_motions
from .candidates import (
    FEWEST,
    FURTHER,
    SURELY,
    TRIED,
    WORTH_PULL,
    Candidate,
    AcceptedCause,
    sole_informative_motions,
    propose_candidates,
    far_from_sheet,
    evaluate_candidates,
    worsens,
)

MOST = 4  # causes
FAR = 10.0  # log density that a further step should gain, from which all causes are fitted on together
LEAST = 1 / 3  # of what is wrong, that all causes explain beside something else
FAINT = 0.08  # of what could be explained, where nothing is lacking
HALF = 0.5  # the same of a further cause, and of what only motions tell that do not fit; of what is gained, a law more


class SearchPath(NamedTuple):
    """Causes one after the other."""

    fit: ModelFit  # with all of them
    accepted: list[AcceptedCause]
    data: DiagnosisData  # without the cells that jump with them


@dataclass(frozen=True, eq=False)
class SearchResult:
    """The end of a search."""

    start: ModelFit
    end: ModelFit
    accepted: list[AcceptedCause]
    scores: list[ScoreTest]  # at the end
    held_out: tuple[HeldOutPrediction, HeldOutPrediction]  # by the model at the start and at the end
    total_gain: Gain | None  # of all causes together
    noise_floor: float  # m, of a cell: what repetitions differ by, else what the sensor does
    sensor_floor: float  # m, of a cell: noise and slow errors
    replicate_floor: ReplicateFloor | None  # None: no episode repeats another
    data: DiagnosisData  # without the cells that jump between shapes
    withdrawn: tuple[str, ...] = ()  # causes that were accepted, and that a law without a cause does more than
    not_simulated: tuple[str, ...] = ()  # what was asked about and cannot be simulated beside the fitted model

    @property
    def causes(self) -> list[AcceptedCause]:
        """Those that are large enough to matter; the others stay in the model, so that nothing stands in for them.

        Of what cannot be told apart, by predictions or by slopes, one must matter, and the others be half as large as
        is of interest.
        """
        large = lambda told: any(h.matters(a) for h, a in told) and all(h.might_matter(a) for h, a in told)  # noqa: E731
        return [s for s in self.accepted if large(self.equivalents(s))]

    @property
    def minor(self) -> list[AcceptedCause]:
        """Those that stay in the model without a name: they, or what predicts as well, are too small to matter."""
        named = self.causes
        return [s for s in self.accepted if s not in named]

    def rivals(self, step: AcceptedCause) -> list[Candidate]:
        """A step's rivals in the end; none is what joined the model beside its cause."""
        there = {s.candidate.hypothesis.name for s in self.accepted}
        return [c for c in step.rivals if c.hypothesis.name not in there]

    def confounded_scores(self, step: AcceptedCause) -> list[ScoreTest]:
        """What slopes cannot tell from a step's cause, where predictions did not and the model has it not."""
        h = step.candidate.hypothesis
        beaten = {c.hypothesis.name for c in step.tried} - {c.hypothesis.name for c in step.rivals}
        apart = beaten | {s.candidate.hypothesis.name for s in self.accepted} - {h.name}
        others = [r for r in step.scores if r.chi2 > 0 and r.hypothesis.name not in apart]
        return find_confounded(step.fit_before, step.candidate.score, self.amplitude(step), others)

    def equivalents(self, step: AcceptedCause) -> list[tuple[Hypothesis, float]]:
        """A step's cause in the end, its rivals and what slopes cannot tell from it, with amplitudes.

        Less what is the same by structure, whose amplitude tells nothing more.
        """
        h, rivals = step.candidate.hypothesis, [(c.hypothesis, c.amplitude) for c in self.rivals(step)]
        said = {*h.structurally_equivalent, *(other.name for other, _ in rivals)}
        unseen = [(r.hypothesis, r.amplitude) for r in self.confounded_scores(step) if r.hypothesis.name not in said]
        return [(h, self.amplitude(step)), *rivals, *unseen]

    def amplitude(self, step: AcceptedCause) -> float:
        """Of a step's cause in the end."""
        return self.end.model.amplitudes[self.end.model.place(step.candidate.hypothesis.name)]

    @property
    def bifurcating_fraction(self) -> float:
        """Share of the cells that jump."""
        jumping = sum(map(len, self.data.bifurcating_bins or ()))
        return jumping / (jumping + len(self.end.whitened.value))


def search(
    model: Model, setting: DiagnosisData, hypotheses: Sequence[Hypothesis], progress: Progress = lambda _: None
) -> SearchResult:
    """Causes one after the other, until none is both present and useful on motions held out."""
    hypotheses = model.others(hypotheses)
    near, before = quadratic_warm_start(model, setting, prefix_progress(progress, "from the data sheet"))
    start = fit(near, setting, hypotheses, progress=prefix_progress(progress, "base model"), before=before)
    jumping = find_bifurcating_bins(start, setting, prefix_progress(progress, "folds that turn over"))
    if any(map(len, jumping)):
        setting, start = setting.without_bins(jumping), drop_bins(start, jumping)
    current, steps, left = _chain(start, setting, hypotheses, progress, TRIED)
    if not steps:
        current, steps, left = _anew(start, setting, hypotheses, progress)
    if not steps:
        current, steps, left = _of_disputed(start, setting, hypotheses, progress)
    impossible = (*_impossible(start, hypotheses), *(_impossible(current, hypotheses) if steps else ()))
    return replace(_found(start, current, steps, left), impossible=tuple(dict.fromkeys(impossible)))


def _impossible(found: ModelFit, hypotheses: Sequence[Hypothesis]) -> list[str]:
    """What was asked about and could not be simulated beside the model."""
    able = {h.name for h in found.linearisation.hypotheses}
    return [h.name for h in found.model.others(hypotheses) if h.name not in able]


def _anew(start: ModelFit, setting: DiagnosisData, hypotheses: Sequence[Hypothesis], progress: Progress) -> SearchPath:
    """As ``_chain``, with a first cause that is begun at the data sheet.

    Where nothing is lacking any more, it must surely gain what nulls' causes do not.
    """
    lacking = has_lack_of_fit(start, setting.motions)
    if not lacking and len(set(list_observed_motions(start.whitened.episode, setting.motions))) < FEWEST:
        return SearchPath(start, [], setting)
    screened = screen(start)
    rows = {row.hypothesis.name: row for row in screened}
    asked = [row.hypothesis for row in screened if row.visibility]
    least = 0.0 if lacking else MUCH
    likely = if_possible(lambda: propose_from_prior(start, setting, asked, TRIED, progress, least)) or []
    first = evaluate_candidates(start, setting, [(rows[h.name], model) for h, model in likely], screened, progress)
    if first is None or not (lacking or first.candidate.gain.lower_bound_95 > SURELY):
        return SearchPath(start, [], setting)
    return _chain(start, setting, hypotheses, progress, TRIED, first)


def _of_disputed(start: ModelFit, setting: DiagnosisData, hypotheses: Sequence[Hypothesis], progress: Progress) -> SearchPath:
    """As ``_chain``, with a first cause of a law about whose number motions disagree."""
    begun, screened = propose_from_heterogeneity(start, setting.motions, hypotheses), screen(start)
    rows = {row.hypothesis.name: row for row in screened if row.visibility}
    likely = [(rows[h.name], model) for h, model in begun if h.name in rows]
    first = evaluate_candidates(start, setting, likely, screened, prefix_progress(progress, "disputed"), ()) if likely else None
    return SearchPath(start, [], setting) if first is None else _chain(start, setting, hypotheses, progress, TRIED, first)


def extend_search(
    start: ModelFit,
    setting: DiagnosisData,
    hypotheses: Sequence[Hypothesis],
    progress: Progress = lambda _: None,
    tried: int = TRIED,
) -> SearchResult:
    """As ``search``, from a fit that was asked about the hypotheses, until nothing is lacking any more.

    Each step fits the ``tried`` likeliest anew.
    """
    sound = lambda found: not has_lack_of_fit(found, setting.motions)  # noqa: E731
    return _found(start, *_chain(start, setting, hypotheses, progress, tried, enough=sound))


def replace_by_law(found: SearchResult, laws: ModelFit, tried: int, progress: Progress = lambda _: None) -> SearchResult:
    """The same without its causes where one of the laws alone does clearly more than all of them together.

    Args:
        found: a search with causes.
        laws: where it started, asked about laws that are no causes.
        tried: of them that are fitted anew.
        progress: called with one line for each episode that is simulated.
    """
    if found.total_gain is None:
        return found
    screened, names, gained = screen(laws), found.data.motions, found.total_gain.log_density
    promising = [row for row in screened if row.expected_gain > gained]
    step = evaluate_candidates(laws, found.data, propose_candidates(laws, promising, tried), screened, progress)
    if step is None:
        return found
    alone = sole_informative_motions(found.accepted)
    law, end = (predict_held_out(f, names, alone) for f in put_on_common_noise(step.candidate.fit, found.end))
    over = compare(end, law, 0.0)
    if over.lower_bound_95 < 0 or over.log_density < HALF * gained:
        return found
    withdrawn = tuple(s.candidate.hypothesis.name for s in found.causes)
    none = _found(found.start, found.start, [], found.data)
    return replace(none, withdrawn=withdrawn, impossible=found.not_simulated)


def _chain(
    start: ModelFit,
    setting: DiagnosisData,
    hypotheses: Sequence[Hypothesis],
    progress: Progress,
    tried: int,
    first: AcceptedCause | None = None,
    enough: Callable[[ModelFit], bool] = lambda _: False,
) -> SearchPath:
    """The model with all causes, after ``first`` if known, until it is ``enough``."""
    nothing = SearchPath(start, [], setting)

    def asked(found: ModelFit, progress: Progress) -> ModelFit:
        left = found.model.others(hypotheses)
        return fit(found.model, setting, left, 0, progress, before=start.linearisation, here=found.linearisation)

    current, steps, step = start, [], first
    while len(steps) < MOST:
        if step is None:
            other = refit_from_prior(current, setting, hypotheses, progress) if steps and current.model.strained else None
            if other is not None and predictive_gain(other, current, setting.motions) > 0:
                current, other = other, None
            screened = screen(current)
            begun = propose_candidates(current, screened, tried)
            begun += [] if other is None else propose_candidates(other, screen(other), tried)
            more = propose_candidates(current, screened, tried, after=tried)
            step = evaluate_candidates(current, setting, begun, screened, progress, more)
        if step is None:
            break
        best, before, cells = step.candidate.fit, current, (start, setting)
        now = prefix_progress(progress, f"with {step.candidate.hypothesis.name}")
        current = fit(best.model, setting, (), FURTHER, now, before=start.linearisation, here=best.linearisation)
        if has_lack_of_fit(current, setting.motions):
            start, current, setting = _still(start, current, setting, now)
        if steps and fraction_explained(before, current, setting.motions, sole_informative_motions([*steps, step])) < HALF:
            current, (start, setting) = before, cells
            break
        steps, step = [*steps, step], None
        if enough(current):
            break
        current = asked(current, now)
    current, steps = replace_by_implied(current, steps, setting, hypotheses, progress)
    current, steps = drop_redundant(current, steps, setting, hypotheses, progress)
    if steps and current.expected_gain > FAR:
        here, now = current.linearisation, prefix_progress(progress, "all")
        current = fit(current.model, setting, progress=now, before=here, here=here)
        current = current if enough(current) else asked(current, now)
        current, steps = drop_redundant(current, steps, setting, hypotheses, progress)
    share = fraction_explained(start, current, setting.motions, sole_informative_motions(steps)) if steps else 1.0
    little = share < LEAST or (share < HALF and supported_only_by_misfit_motions(start, current, steps, setting.motions))
    far = any(far_from_sheet(step.candidate, step.candidate.gain) for step in steps)
    if little or (steps and not far and _idle(_of_all(start, current, steps, setting), start, steps, setting)):
        return nothing
    return SearchPath(current, steps, setting)


def _still(start: ModelFit, current: ModelFit, setting: DiagnosisData, progress: Progress) -> tuple[ModelFit, ModelFit, DiagnosisData]:
    """Less the cells that jump with the causes in the model, where they are all that is lacking.

    Slack that a loose grip leaves buckles to either side.
    """
    more = find_bifurcating_bins(current, setting, prefix_progress(progress, "folds that turn over"))
    if not any(map(len, more)) or has_lack_of_fit(still := drop_bins(current, more), setting.motions):
        return start, current, setting
    return drop_bins(start, more), still, setting.without_bins(more)


def _of_all(start: ModelFit, current: ModelFit, steps: list[AcceptedCause], setting: DiagnosisData) -> Gain:
    """What all causes together gain."""
    return compare(*_held_out(start, current, steps, setting), compute_noise_floor(current.linearisation, minimal_noise()))


def _idle(whole: Gain, start: ModelFit, steps: list[AcceptedCause], setting: DiagnosisData) -> bool:
    """Positions are predicted worse, or hardly better where nothing was lacking, and pulls hardly better.

    Hardly better is enough of what a number of the fabric, which is back with its data sheet, did until then.
    """
    if worsens(whole):
        return True
    faint = whole.explained_fraction < FAINT and whole.rms_removed[1] < WORTH_PULL
    return faint and not any(s.candidate.restores_prior for s in steps) and not has_lack_of_fit(start, setting.motions)


def _held_out(start: ModelFit, current: ModelFit, steps: list[AcceptedCause], setting: DiagnosisData) -> tuple[HeldOutPrediction, HeldOutPrediction]:
    """By the model without its causes and with them."""
    first, last = put_on_common_noise(start, current)
    held_out = lambda found: predict_held_out(found, setting.motions, sole_informative_motions(steps))  # noqa: E731
    return held_out(first), held_out(last)


def _found(start: ModelFit, current: ModelFit, steps: list[AcceptedCause], setting: DiagnosisData) -> SearchResult:
    screened = screen(current)
    alone = sole_informative_motions(steps)
    last = predict_held_out(current, setting.motions, alone)
    sensor = compute_noise_floor(current.linearisation, minimal_noise())  # slow errors that were fitted may be the model's own
    repeated = estimate_replicate_floor(last, find_replicate_pairs(setting.recordings, setting.episodes))
    floor = sensor if repeated is None else repeated.rms
    held_out = _held_out(start, current, steps, setting)
    whole = compare(*held_out, floor) if steps else None
    return SearchResult(start, current, steps, screened, held_out, whole, floor, sensor, repeated, setting)
