"""One step of the search: the likeliest causes are fitted anew and compared on motions held out."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

from ...episodes.world import Hypothesis, Model
from ...episodes.world_cache import IMPOSSIBLE
from ..data.dataset import Progress, DiagnosisData, prefix_progress
from ..inference.comparison import Gain, HeldOutPrediction, compare_by_motion, compare, list_observed_motions, predict_held_out, jackknife, find_sole_informative_motion
from ..inference.fitting import ModelFit, fit, reweight_by_noise, add_cause
from ..inference.linearise import Linearisation, restrict_to_common_bins
from ..inference.noise import Noise, fit_noise, cap_noise
from ..inference.permutation_test import PermutationTest, run_permutation_test
from ..inference.screening import MUCH, PRESENT, ScoreTest

TRIED = 4  # hypotheses that are fitted at each step
FURTHER = 3  # steps of the likelier ones among them
HARDLY = 0.2  # of what the better of two models gains, in density and squares, that two engines may differ by
VERY_MUCH = 25.0  # log density; nulls' causes that ask for too little to show reach 16, and 27 once
SURELY = 8.0  # log density held out, beyond which no null's cause surely gains: of what no other motion predicts,
# what is begun at the data sheet though nothing lacks, or what moves too little to be noticed
SURELY_OF_FEW = VERY_MUCH  # the same of fewer motions than FEWEST: the other tells little of what is usual
FEWEST = 3  # motions, of which one is held out: two name only what is overwhelming, and that is lacking
CLEAR = 4.0  # log density below which two models predict alike
PLAUSIBLE = 5.0  # times the typical amplitude; the prior's standard deviation is twice it
BENT = (
    5.0  # prior standard deviations, by which no other effect has bent a number of the fabric: up to 3.7 in 184 cases
)
POSSIBLE = 10.0  # the same, of what predicts as well as something plausible
DISTURBED = 0.1  # of what is wrong in a motion, by which it is predicted worse
MUCH_OF_ALL = 1 / 3  # that is wrong, of which predictions say that it is there
# standard errors between motions, from which they agree that there is something: 97.5 % of Student's t by one less than
# there are motions; of the best of TRIED causes, with a fourth of that chance
SURE = (12.71, 4.30, 3.18, 2.78, 2.57, 2.45, 2.36, 2.31, 2.26)
SURE_OF_BEST = (50.92, 8.86, 5.39, 4.31, 3.81, 3.52, 3.34, 3.21, 3.11)
NORMAL = 1.96  # the same of what mends most of all that is wrong
WORTH_SHARE = 0.02  # of the mean square, that a cause that is worth naming mends, or
WORTH_MM, WORTH_PULL = 3e-4, 5e-3  # m or N, RMS of what is gone from one episode


@dataclass(frozen=True, eq=False)
class Candidate:
    """A hypothesis that was fitted."""

    score: ScoreTest  # as screened
    fit: ModelFit
    prediction: HeldOutPrediction
    gain: Gain  # over the model without it
    sole_informative_motion: set[str]  # the motion that alone tells of it, if any
    t_threshold: float  # standard errors between motions that it must be away from zero
    worsens_another_motion: bool = False  # where one motion alone tells of it: positions of another are predicted worse
    is_contradicted: bool = False  # likewise, and that motion is clearly less likely
    restores_prior: bool = False  # a fitted number that had left its data sheet is back with it
    prior_shift: float = 0.0  # prior standard deviations, by which its twin had left the data sheet without it

    @property
    def hypothesis(self) -> Hypothesis:
        """What was added."""
        return self.score.hypothesis

    @property
    def amplitude(self) -> float:
        """Of what was added."""
        return self.fit.model.amplitudes[self.fit.model.place(self.hypothesis.name)]


@dataclass(frozen=True, eq=False)
class AcceptedCause:
    """One accepted cause with what cannot be told from it."""

    candidate: Candidate
    permutation_test: PermutationTest  # that it passed
    tried: list[Candidate]  # best among them
    rivals: list[Candidate]
    scores: list[ScoreTest]
    fit_before: ModelFit  # the model without it, with slopes along everything that was asked about
    noise: Noise  # by which they were compared

    def replaced_by(self, name: str) -> AcceptedCause | None:
        """With another of the causes that were tried; None: it was not."""
        best = next((c for c in self.tried if c.hypothesis.name == name), None)
        if best is None:
            return None
        others = [c for c in self.rivals if c is not best and c.hypothesis.implies != name]
        return replace(self, best=best, rivals=others)


def sole_informative_motions(steps: Sequence[AcceptedCause]) -> set[str]:
    """Motions that alone tell of one of the causes."""
    return {name for step in steps for name in step.candidate.sole_informative_motion}


def _likely(screened: Sequence[ScoreTest]) -> list[ScoreTest]:
    """What is present by slopes, or asks for so much that it would show and would matter or gain much.

    A typical amplitude need not show then. And a large effect bends the fitted parameters so far that slopes
    there ask for less of it than there is; so what gains very much is fitted, however little it asks for.
    """
    asks = lambda r: r.worth > VERY_MUCH or (r.shows and (r.worth > MUCH or r.excess > PRESENT))  # noqa: E731
    likely = [r for r in screened if r.decision == "present" or asks(r)]
    return sorted(likely, key=lambda r: -r.expected_gain)


def propose_candidates(found: ModelFit, screened: Sequence[ScoreTest], tried: int, after: int = 0) -> list[tuple[ScoreTest, Model]]:
    """The likeliest causes ``after`` so many, each with the model to which one leap leads."""
    return [(row, add_cause(found, row.hypothesis)) for row in _likely(screened)[after : after + tried]]


def evaluate_candidates(
    current: ModelFit,
    setting: DiagnosisData,
    begun: Sequence[tuple[ScoreTest, Model]],
    screened: list[ScoreTest],
    progress: Progress,
    more: Sequence[tuple[ScoreTest, Model]] = (),
) -> AcceptedCause | None:
    """The best of what was ``begun`` that is worth its name, with what cannot be told from it; None: nothing is.

    Where what predicts best is larger than is believed, what looks like it may be among the next likely ones.

    Args:
        current: the model so far, asked about what was begun.
        setting: the episodes.
        begun: (row as screened, model to fit) of each.
        screened: all rows, for the record.
        progress: called with one line for each episode that is simulated.
        more: as ``begun``, tried where that leads to nothing that can be believed.
    """
    likely = _tried(current, setting, begun, progress)
    if not likely:
        return None
    if more and not _plausible(max(likely, key=lambda c: c.gain.log_density)):
        likely += _tried(current, setting, more, progress)
    likeliest = max(likely, key=lambda c: c.gain.log_density).fit.linearisation
    # an effect that slopes describe badly has passed as noise until now: what the likeliest leaves over is the noise
    fits = [(c.score, c.fit) for c in likely]
    noise, like = fit_noise(likeliest), _common(likeliest, current, fits)
    tried = _compare_held_out(current, fits, setting.motions, noise, like)
    useful = _ranked(_themselves([c for c in tried if _useful(c, setting.motions)]))
    others = [c for c in tried if c not in useful]
    beside = lambda c: run_permutation_test(reweight_by_noise(c.fitted, noise, like), setting.motions, c.alone)  # noqa: E731
    chance = None
    while useful and not (chance := beside(useful[0])).is_passed:
        others, useful = [*others, useful[0]], useful[1:]
    if not useful or chance is None:
        return None
    best = useful[0]
    alike = lambda c: predict_held_out(reweight_by_noise(c.fitted, noise, like), setting.motions, best.sole_informative_motion)  # noqa: E731
    possible = [*useful, *(c for c in others if worth_naming(c, c.gain) and _agreed(c, setting.motions))]
    rivals = {c.hypothesis.name: c for c in reversed(possible) if c is not best and _rival(c, alike(c), best)}
    rivals |= {c.hypothesis.name: c for c in others if _open(c, alike(c), best)}
    return AcceptedCause(best, chance, tried, [*reversed(rivals.values())], screened, current, noise)


def _tried(
    current: ModelFit, setting: DiagnosisData, begun: Sequence[tuple[ScoreTest, Model]], progress: Progress
) -> list[Candidate]:
    """What was begun, fitted as far as that leads, beside the model without it; less what cannot be simulated."""
    fits: list[tuple[ScoreTest, ModelFit]] = []
    by = cap_noise(current.noise)
    for row, model in begun:
        trial = prefix_progress(progress, f"trying {row.hypothesis.name}")
        with suppress(*IMPOSSIBLE):
            fits.append((row, fit(model, setting, (), 0, trial, by, current.linearisation)))
    judged = lambda fits, every: _compare_held_out(  # noqa: E731
        current, fits, setting.motions, current.noise, _common(current.linearisation, current, every)
    )
    likely = judged(fits, fits)
    settled = _settled(likely, setting, progress)
    first, further = [fits[k] for k in settled], list(settled.values())
    both = (judged(own, [*fits, *further]) for own in (first, further))
    for k, before, after in zip(settled, *both, strict=True):
        likely[k] = _better(before, after)
    return likely


def _common(like: Linearisation, current: ModelFit, fits: Sequence[tuple[ScoreTest, ModelFit]]) -> Linearisation:
    """On the cells that all of these have."""
    return restrict_to_common_bins(like, [current.linearisation, *(f.linearisation for _, f in fits)])


def _settled(tried: list[Candidate], setting: DiagnosisData, progress: Progress) -> dict[int, tuple[ScoreTest, ModelFit]]:
    """The likelier ones, by number, where further steps lead: one step does for small effects only.

    Likely is what predicts well or still has far to go: a large effect that is half fitted predicts nothing.
    """
    hope = [c.gain.log_density + c.fit.expected_gain for c in tried]
    out = {}
    for k, (c, expected) in enumerate(zip(tried, hope, strict=True)):
        found = c.fit
        if expected > max(0.0, 0.5 * max(hope)) and found.expected_gain > CLEAR:
            further = prefix_progress(progress, f"trying {c.hypothesis.name} further")
            found = fit(found.model, setting, (), FURTHER, further, found.noise, found.linearisation, found.linearisation)
            out[k] = (c.score, found)
    return out


def _better(before: Candidate, after: Candidate) -> Candidate:
    """Further steps, unless they predict clearly worse; what has ended at nothing was no fit of the cause."""
    worse = after.gain.log_density < before.gain.log_density - HARDLY * abs(before.gain.log_density)
    return before if worse and (before.amplitude or not after.amplitude) else after


def _compare_held_out(
    current: ModelFit, fits: list[tuple[ScoreTest, ModelFit]], names: list[str], noise: Noise, like: Linearisation
) -> list[Candidate]:
    """Each fit beside the model without it, on motions held out; all by one noise, on the cells of ``like``."""
    before, out = reweight_by_noise(current, noise, like), []
    strained = {p.name for p, _ in current.model.strained}
    for row, found in fits:
        after = reweight_by_noise(found, noise, like)
        alone = find_sole_informative_motion(after, names)
        first, predicted = (predict_held_out(f, names, alone) for f in (before, after))
        gain = compare(first, predicted, 0.0)
        worse = _disturbed(first, predicted, names, alone) if alone else []
        contradicted = any(motion.log_density < -CLEAR for motion in worse)
        sure = standard_errors(gain, list_observed_motions(predicted.episode, names), alone, not current.model.accepted)
        relieves = bool(strained - {p.name for p, _ in found.model.strained})
        bent = _bent(current.model, row.hypothesis.equivalent_parameter)
        out.append(Candidate(row, found, predicted, gain, alone, sure, bool(worse), contradicted, relieves, bent))
    return out


def _bent(model: Model, twin: str) -> float:
    """Prior standard deviations of a parameter from its data sheet; 0 where the model has none of that name."""
    away = zip(model.parameters, model.values.tolist(), strict=True)
    return max((abs(c) / p.std for p, c in away if p.name == twin), default=0.0)


def _disturbed(first: HeldOutPrediction, second: HeldOutPrediction, names: Sequence[str], alone: set[str]) -> list[Gain]:
    """Of the other motions, those whose positions are predicted worse."""
    motions = compare_by_motion(first, second, 0.0, names).items()
    return [m for name, m in motions if name not in alone and m.rms_after > (1 + DISTURBED) * m.rms_before]


def standard_errors(gain: Gain, names: Sequence[str], alone: set[str], first: bool) -> float:
    """Standard errors between motions from which they agree that there is something.

    A further cause is the best of those tried on what a first one left, some of which is that one described badly.
    """
    # Of what mends that much of all that is wrong in motions it was not fitted to, predictions have said that it is
    # there; real motions may then differ about its size. Two motions differ once, which tells nothing.
    if first and len(set(names)) >= FEWEST and gain.rms_before**2 - gain.rms_after**2 > MUCH_OF_ALL * gain.rms_before**2:
        return NORMAL
    return between_motions(names, alone, SURE if first else SURE_OF_BEST)


def between_motions(names: Sequence[str], alone: Collection[str] = (), table: Sequence[float] = SURE) -> float:
    """Standard errors by which a mean over so few motions may be off; one that is ``alone`` counts as two.

    One motion agrees with nothing.
    """
    count = len(set(names)) + len(alone)
    return table[min(count - 2, len(table) - 1)] if count > 1 else math.inf


def _open(c: Candidate, predicted: HeldOutPrediction, best: Candidate) -> bool:
    """Predicts clearly better, though motions do not agree how large it is: the best of the others is not the cause."""
    h = c.hypothesis
    stands_in = bool(h.implies) and not h.is_relevant(c.amplitude)
    if h.effect == best.hypothesis.effect or stands_in or not (worth_naming(c, c.gain) and _plausible(c, POSSIBLE)):
        return False
    over = compare(predicted, best.prediction, 0.0)
    return over.log_density < -CLEAR and over.log_density_ci95[1] < 0


def _plausible(c: Candidate, most: float = PLAUSIBLE) -> bool:
    return abs(c.amplitude) < most * abs(c.hypothesis.typical)


def _useful(c: Candidate, names: Sequence[str]) -> bool:
    """What one motion alone tells has predicted no other one: it must surely gain what nulls' causes do not."""
    few = len(set(list_observed_motions(c.prediction.episode, names))) < FEWEST
    sure = not c.sole_informative_motion or c.gain.lower_bound_95 > (SURELY_OF_FEW if few else SURELY)
    return sure and worth_naming(c, c.gain) and known(c.fit, c.hypothesis.name, names, c)


def _agreed(c: Candidate, names: Sequence[str]) -> bool:
    """Of what predicts as well as a cause, less is asked than of a cause: it need not be there, it cannot be told.

    Halves of the one motion that tells of it need not agree: a law that is not quite right differs from early to late.
    Nor does a cause stand alone because its rival is a hair larger than is believed.
    """
    return known(c.fit, c.hypothesis.name, names, replace(c, sure=0.0 if c.sole_informative_motion else NORMAL), POSSIBLE)


def known(found: ModelFit, name: str, names: Sequence[str], c: Candidate, most: float = PLAUSIBLE) -> bool:
    """Of a size that makes sense and that numerics do not ask for, and motions agree so far that there is something.

    It makes sense up to ``most`` times the typical amplitude; what has ended at nothing is not there. Halves of the one
    motion that tells of it need not agree about its size where it gains overwhelmingly in both and leaves all others as
    they were: what creases do levels off with their rate, and its slopes there say little. Where another motion is
    clearly less likely with it, it is not there, whatever it gains. Nor need motions agree about a number that has left
    its data sheet so far that nothing else has bent it there.
    """
    if c.is_contradicted and c.prior_shift <= BENT:
        return False
    place = found.model.place(name)
    amplitude, largest = found.model.amplitudes[place], most * abs(found.model.accepted[place].typical)
    middle, std = (float(v[len(found.model.parameters) + place]) for v in jackknife(found, names, c.sole_informative_motion))
    if (c.sole_informative_motion and c.gain.lower_bound_95 > VERY_MUCH and not c.worsens_another_motion) or c.prior_shift > BENT:
        middle, std = amplitude, 0.0
    least = max(c.t_threshold * std, NORMAL * abs(c.score.mesh_bias))
    return c.t_threshold < math.inf and least < abs(middle) and 0 < abs(amplitude) < largest


def worth_naming(c: Candidate, gain: Gain) -> bool:
    """As ``worthwhile``; what is the same as a number that is fitted (a twin) must show beside the data sheet instead.

    Beside such a number nothing is left to mend.
    """
    return gain.lower_bound_95 > 0 or far_from_sheet(c, gain) if _twin(c) else worthwhile(gain)


def far_from_sheet(c: Candidate, gain: Gain) -> bool:
    """A twin of a number that is surely far off: with that number bent it predicts as well, and need not gain more."""
    if not _twin(c) or gain.log_density <= CLEAR:
        return False
    return c.prior_shift > BENT or (c.score.decision == "present" and c.score.expected_gain > VERY_MUCH)


def _twin(c: Candidate) -> bool:
    """The same as a number that is fitted anyway, and shows beside its data sheet."""
    return bool(c.hypothesis.equivalent_parameter) and c.hypothesis.equivalent_parameter in (p.name for p in c.fit.model.parameters) and c.score.is_visible


def worthwhile(gain: Gain) -> bool:
    """Large enough to be noticed, or surer than what chance gains, and surely a gain.

    Beside numbers that the cause has bent, hardly a millimetre may be left to mend.
    """
    seen, felt = gain.rms_removed
    mended = gain.mean_square_removed > WORTH_SHARE * gain.robust_rms[0] ** 2 or seen > WORTH_MM or felt > WORTH_PULL
    return (mended or gain.lower_bound_95 > SURELY) and gain.lower_bound_95 > 0 and not worsens(gain)


def worsens(gain: Gain) -> bool:
    """All positions together are predicted worse, whatever else is, and pulls hardly better."""
    return gain.rms_after > gain.rms_before and gain.rms_removed[1] < WORTH_PULL


def _themselves(useful: Sequence[Candidate]) -> list[Candidate]:
    """Less those that matter by what they bring along alone, which then predicts about as well without them."""
    found = {c.hypothesis.name: c for c in useful}
    brought = lambda c: None if c.hypothesis.matters(c.amplitude) else found.get(c.hypothesis.brings)  # noqa: E731
    alike = lambda c, other: other.gain.density > (1 - HARDLY) * c.gain.density  # noqa: E731
    return [c for c in useful if (other := brought(c)) is None or not alike(c, other)]


def _ranked(useful: Sequence[Candidate]) -> list[Candidate]:
    """The likeliest first; of those that predict as well as that, the one that mends most."""
    likeliest = max((c.gain.log_density for c in useful), default=0.0)
    alike = lambda c: c.gain.density > likeliest - CLEAR  # noqa: E731
    return sorted(useful, key=lambda c: (0, -c.gain.mean_square_removed) if alike(c) else (1, -c.gain.log_density))


def _rival(c: Candidate, predicted: HeldOutPrediction, best: Candidate) -> bool:
    """Predicts about as well: the paired difference is not clear, or no more than what two engines may differ by."""
    h = c.hypothesis
    if h.effect == best.hypothesis.effect or (h.implies == best.hypothesis.name and not h.is_relevant(c.amplitude)):
        return False
    over = compare(predicted, best.prediction, 0.0)
    hardly = over.log_density < HARDLY * best.gain.log_density and over.mean_square_removed < HARDLY * best.gain.mean_square_removed
    return over.log_density < CLEAR or over.lower_bound_95 < 0 or hardly
