"""Stepwise search for causes: screen, fit the likeliest anew, compare on motions held out, accept, and again."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

from .afresh import afresh, resettled
from .approach import approach
from .branches import unstable, without
from .comparison import Gain, Predicted, compare, predict, spread, telling
from .evidence import Evidence, Progress, Setting, staged
from .fitting import IMPOSSIBLE, Fitted, fit, renoised, with_cause, without_cause
from .lacking import explained, lack_of_fit
from .noise import Noise, fit_noise, floor_of, unfitted
from .placebo import Placebo, placebo
from .repeats import Repeats, pairs_of, repeats
from .screening import MUCH, PRESENT, Row, screen
from .world import Hypothesis, Model

MOST = 4  # causes
TRIED = 4  # hypotheses that are fitted at each step
FURTHER = 2  # steps of the likelier ones among them
FAR = 10.0  # log density that a further step should gain, from which all causes are fitted on together
HARDLY = 0.2  # of what the better of two models gains, in density and squares, that two engines may differ by
VERY_MUCH = 25.0  # log density; nulls' causes that ask for too little to show reach 16, and 27 once
CLEAR = 4.0  # log density below which two models predict alike
PLAUSIBLE = 5.0  # times the typical amplitude; the prior's standard deviation is twice it
MATTERS = 0.75  # of the smallest amplitude of interest: what is fitted may fall short of what is there
MOSTLY, HALF = 1 / 3, 1 / 2  # of what is wrong: least that all causes, or a further one, explain beside something else
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

    row: Row  # as screened
    fitted: Fitted
    predicted: Predicted
    gain: Gain  # over the model without it
    alone: set[str]  # the motion that alone tells of it, if any
    sure: float  # standard errors between motions that it must be away from zero

    @property
    def hypothesis(self) -> Hypothesis:
        """What was added."""
        return self.row.hypothesis

    @property
    def amplitude(self) -> float:
        """Of what was added."""
        return self.fitted.model.amplitudes[self.fitted.model.place(self.hypothesis.name)]


@dataclass(frozen=True, eq=False)
class Step:
    """One accepted cause with what cannot be told from it."""

    best: Candidate
    placebo: Placebo  # that it passed
    tried: list[Candidate]  # best among them
    rivals: list[Candidate]
    screened: list[Row]
    before: Fitted  # the model without it, with slopes along everything that was asked about


@dataclass(frozen=True, eq=False)
class Found:
    """The end of a search."""

    start: Fitted
    end: Fitted
    steps: list[Step]
    screened: list[Row]  # at the end
    whole: Gain | None  # of all causes together
    floor: float  # m, of a cell: what repetitions differ by, else what the sensor does
    sensor: float  # m, of a cell: noise and slow errors
    repeats: Repeats | None  # None: no episode repeats another
    setting: Setting  # without the cells that jump between shapes
    withdrawn: tuple[str, ...] = ()  # causes that were accepted, and that a law without a cause does more than

    @property
    def causes(self) -> list[Step]:
        """Those that are large enough to matter; the others stay in the model, so that nothing stands in for them."""
        return [s for s in self.steps if matters(s.best.hypothesis, self.amplitude(s))]

    @property
    def minor(self) -> list[Step]:
        """Those that stay in the model without a name."""
        return [s for s in self.steps if not matters(s.best.hypothesis, self.amplitude(s))]

    def amplitude(self, step: Step) -> float:
        """Of a step's cause in the end."""
        return self.end.model.amplitudes[self.end.model.place(step.best.hypothesis.name)]

    @property
    def left_out(self) -> float:
        """Share of the cells that jump."""
        jumping = sum(map(len, self.setting.unstable or ()))
        return jumping / (jumping + len(self.end.white.value))


def matters(hypothesis: Hypothesis, amplitude: float) -> bool:
    """Large enough to be named."""
    return abs(amplitude) > MATTERS * abs(hypothesis.smallest)


def search(
    model: Model, setting: Setting, hypotheses: Sequence[Hypothesis], progress: Progress = lambda _: None
) -> Found:
    """Causes one after the other, until none is both present and useful on motions held out."""
    near, before = approach(model, setting, staged(progress, "from the data sheet"))
    start = fit(near, setting, hypotheses, progress=staged(progress, "base model"), before=before)
    jumping = unstable(start, setting, staged(progress, "folds that turn over"))
    if any(map(len, jumping)):
        setting, start = replace(setting, unstable=jumping), without(start, jumping)
    current, steps = _chain(start, setting, hypotheses, progress, TRIED)
    if not steps and any(row.lacking for row in lack_of_fit(start, setting.names)):
        screened = screen(start)
        rows = {row.hypothesis.name: row for row in screened}
        asked = [row.hypothesis for row in screened if row.sight]
        begun = [(rows[h.name], model) for h, model in afresh(start, setting, asked, TRIED, progress)]
        if first := _step(start, setting, begun, screened, progress):
            current, steps = _chain(start, setting, hypotheses, progress, TRIED, first)
    return _found(start, current, steps, setting)


def extend(
    start: Fitted,
    setting: Setting,
    hypotheses: Sequence[Hypothesis],
    progress: Progress = lambda _: None,
    tried: int = TRIED,
) -> Found:
    """As ``search``, from a fit that was asked about the hypotheses; each step fits the ``tried`` likeliest anew."""
    current, steps = _chain(start, setting, hypotheses, progress, tried)
    return _found(start, current, steps, setting)


def instead(found: Found, laws: Fitted, tried: int, progress: Progress = lambda _: None) -> Found:
    """The same without its causes where one of the laws alone does clearly more than all of them together.

    Args:
        found: a search with causes.
        laws: where it started, asked about laws that are no causes.
        tried: of them that are fitted anew.
        progress: called with one line for each episode that is simulated.
    """
    if found.whole is None:
        return found
    screened, names, gained = screen(laws), found.setting.names, found.whole.density
    promising = [row for row in screened if row.worth > gained]
    step = _step(laws, found.setting, _begun(laws, promising, tried), screened, progress)
    if step is None:
        return found
    alone = {name for s in found.steps for name in s.best.alone}
    law = renoised(step.best.fitted, found.end.noise, found.end.evidence)
    over = compare(predict(found.end, names, alone), predict(law, names, alone), 0.0)
    if over.ci95[0] < 0 or over.density < HALF * gained:
        return found
    withdrawn = tuple(s.best.hypothesis.name for s in found.causes)
    return replace(_found(found.start, found.start, [], found.setting), withdrawn=withdrawn)


def _chain(
    start: Fitted,
    setting: Setting,
    hypotheses: Sequence[Hypothesis],
    progress: Progress,
    tried: int,
    first: Step | None = None,
) -> tuple[Fitted, list[Step]]:
    """(the model with all causes, the steps that led to it), after ``first`` if that is known."""
    current, steps, step = start, [], first
    while len(steps) < MOST:
        if step is None:
            other = resettled(current, setting, hypotheses, progress) if steps and current.model.strained else None
            if other is not None and _predicts(other, current, setting.names) > 0:
                current, other = other, None
            screened = screen(current)
            begun = _begun(current, screened, tried)
            begun += [] if other is None else _begun(other, screen(other), tried)
            step = _step(current, setting, begun, screened, progress)
        if step is None:
            break
        best, before = step.best.fitted, current
        left = best.model.others(hypotheses)
        now = staged(progress, f"with {step.best.hypothesis.name}")
        current = fit(best.model, setting, left, FURTHER, now, before=start.evidence, here=best.evidence)
        if steps and _beside_the_point(before, current, setting.names, HALF):
            current = before
            break
        steps, step = [*steps, step], None
    current, steps = _pruned(current, steps, setting, hypotheses, progress)
    if steps and current.ahead > FAR:
        left = current.model.others(hypotheses)
        current = fit(current.model, setting, left, progress=staged(progress, "all"), before=current.evidence)
    return (start, []) if steps and _beside_the_point(start, current, setting.names, MOSTLY) else (current, steps)


def _begun(found: Fitted, screened: Sequence[Row], tried: int) -> list[tuple[Row, Model]]:
    """The likeliest causes, each with the model to which one leap leads."""
    return [(row, with_cause(found, row.hypothesis)) for row in _likely(screened)[:tried]]


def _predicts(one: Fitted, other: Fitted, names: Sequence[str]) -> float:
    """Log density by which one fit of a model predicts motions held out better than another."""
    first, second = (predict(renoised(f, other.noise, other.evidence), names) for f in (other, one))
    return compare(first, second, 0.0).density


def _found(start: Fitted, current: Fitted, steps: list[Step], setting: Setting) -> Found:
    screened = screen(current)
    alone = {name for step in steps for name in step.best.alone}
    last, sensor = predict(current, setting.names, alone), floor_of(current.evidence, current.noise)
    repeated = repeats(last, pairs_of(setting.recordings, setting.episodes))
    floor = sensor if repeated is None else repeated.rms
    first = predict(renoised(start, current.noise, current.evidence), setting.names, alone)
    whole = compare(first, last, floor) if steps else None
    return Found(start, current, steps, screened, whole, floor, sensor, repeated, setting)


def _likely(screened: Sequence[Row]) -> list[Row]:
    """What is present by slopes, or asks for so much that it would show and would matter or gain much.

    A typical amplitude need not show then. And a large effect bends the fitted parameters so far that slopes
    there ask for less of it than there is; so what gains very much is fitted, however little it asks for.
    """
    asks = lambda r: r.worth > VERY_MUCH or (r.shows and (r.worth > MUCH or r.excess > PRESENT))  # noqa: E731
    sane = lambda r: abs(r.reached) < PLAUSIBLE * abs(r.hypothesis.typical)  # noqa: E731
    likely = [r for r in screened if r.decision == "present" or (asks(r) and sane(r))]
    return sorted(likely, key=lambda r: -r.worth)


def _pruned(
    current: Fitted, steps: list[Step], setting: Setting, hypotheses: Sequence[Hypothesis], progress: Progress
) -> tuple[Fitted, list[Step]]:
    """Less the causes that the others have made needless."""
    for step in steps:
        name, last = step.best.hypothesis.name, step is steps[-1]
        known = _known(current, name, setting.names, step.best)
        if known and last:  # it has just been tried
            continue
        less = without_cause(current, name)
        less = fit(less, setting, (), 0, staged(progress, f"without {name}"), current.noise, current.evidence)
        plain, alone = renoised(less, current.noise, current.evidence), step.best.alone
        gain = compare(predict(plain, setting.names, alone), predict(current, setting.names, alone), 0.0)
        if known and _worthwhile(gain):
            continue
        steps = [s for s in steps if s is not step]
        left = less.model.others(hypotheses)
        current = fit(less.model, setting, left, 1, progress, before=current.evidence)
    return current, steps


def _beside_the_point(start: Fitted, end: Fitted, names: Sequence[str], share: float) -> bool:
    """More of what is wrong is still there: whatever makes it may well do what passed for the causes, too."""
    left = lack_of_fit(end, names)
    return any(row.lacking for row in left) and explained(lack_of_fit(start, names), left) < share


def _step(
    current: Fitted,
    setting: Setting,
    begun: Sequence[tuple[Row, Model]],
    screened: list[Row],
    progress: Progress,
) -> Step | None:
    fits: list[tuple[Row, Fitted]] = []
    for row, model in begun:
        trial = staged(progress, f"trying {row.hypothesis.name}")
        with suppress(*IMPOSSIBLE):
            fits.append((row, fit(model, setting, (), 0, trial, unfitted(), current.evidence)))
    if not fits:
        return None
    now = lambda fits: _compared(current, fits, setting.names, current.noise, current.evidence)  # noqa: E731
    likely = now(fits)
    settled = _settled(likely, setting, progress)
    for k, after in zip(settled, now(list(settled.values())), strict=True):
        likely[k] = _better(likely[k], after)
    likeliest = max(likely, key=lambda c: c.gain.density).fitted.evidence
    # an effect that slopes describe badly has passed as noise until now: what the likeliest leaves over is the noise
    noise = fit_noise(likeliest)
    tried = _compared(current, [(c.row, c.fitted) for c in likely], setting.names, noise, likeliest)
    useful = _ranked([c for c in tried if _useful(c, setting.names)])
    beside = lambda c: placebo(renoised(c.fitted, noise, likeliest), setting.names, c.alone)  # noqa: E731
    chance = None
    while useful and not (chance := beside(useful[0])).passed:
        useful = useful[1:]
    if not useful or chance is None:
        return None
    best = useful[0]
    alike = lambda c: predict(renoised(c.fitted, noise, likeliest), setting.names, best.alone)  # noqa: E731
    rivals = [c for c in useful if c is not best and _rival(c, alike(c), best)]
    return Step(best, chance, tried, rivals, screened, current)


def _ranked(useful: Sequence[Candidate]) -> list[Candidate]:
    """The likeliest first; of those that predict as well as that, the one that mends most."""
    likeliest = max((c.gain.density for c in useful), default=0.0)
    alike = lambda c: c.gain.density > likeliest - CLEAR  # noqa: E731
    return sorted(useful, key=lambda c: (0, -c.gain.fallen) if alike(c) else (1, -c.gain.density))


def _settled(tried: list[Candidate], setting: Setting, progress: Progress) -> dict[int, tuple[Row, Fitted]]:
    """The likelier ones, by number, where further steps lead: one step does for small effects only.

    Likely is what predicts well or still has far to go: a large effect that is half fitted predicts nothing.
    """
    hope = [c.gain.density + c.fitted.ahead for c in tried]
    out = {}
    for k, (c, expected) in enumerate(zip(tried, hope, strict=True)):
        found = c.fitted
        if expected > max(0.0, 0.5 * max(hope)) and found.ahead > CLEAR:
            further = staged(progress, f"trying {c.hypothesis.name} further")
            found = fit(found.model, setting, (), FURTHER, further, unfitted(), found.evidence, found.evidence)
            out[k] = (c.row, found)
    return out


def _better(before: Candidate, after: Candidate) -> Candidate:
    """Further steps, unless they predict clearly worse."""
    return before if after.gain.density < before.gain.density - HARDLY * abs(before.gain.density) else after


def _compared(
    current: Fitted, fits: list[tuple[Row, Fitted]], names: list[str], noise: Noise, like: Evidence
) -> list[Candidate]:
    """Each fit beside the model without it, on motions held out; all by one noise, as rough as ``like``."""
    before, out = renoised(current, noise, like), []
    for row, found in fits:
        after = renoised(found, noise, like)
        alone = telling(after, names)
        predicted = predict(after, names, alone)
        gain = compare(predict(before, names, alone), predicted, 0.0)
        sure = standard_errors(gain, names, alone, not current.model.accepted)
        out.append(Candidate(row, found, predicted, gain, alone, sure))
    return out


def standard_errors(gain: Gain, names: Sequence[str], alone: set[str], first: bool) -> float:
    """Standard errors between motions from which they agree that there is something.

    A further cause is the best of those tried on what a first one left, some of which is that one described badly.
    """
    motions = len(set(names))
    # Of what mends that much of all that is wrong in motions it was not fitted to, predictions have said that it is
    # there; real motions may then differ about its size. Two motions differ once, which tells nothing.
    if first and motions > 2 and gain.before**2 - gain.after**2 > MOSTLY * gain.before**2:
        return NORMAL
    return (SURE if first else SURE_OF_BEST)[min(motions + len(alone) - 2, len(SURE) - 1)]


def _useful(c: Candidate, names: Sequence[str]) -> bool:
    return _worthwhile(c.gain) and _known(c.fitted, c.hypothesis.name, names, c)


def _known(found: Fitted, name: str, names: Sequence[str], c: Candidate) -> bool:
    """Of a size that makes sense, and that motions agree about so far that there is something."""
    place = found.model.place(name)
    middle, std = (float(v[len(found.model.parameters) + place]) for v in spread(found, names, c.alone))
    largest = PLAUSIBLE * abs(found.model.accepted[place].typical)
    return c.sure * std < abs(middle) and abs(found.model.amplitudes[place]) < largest


def _worthwhile(gain: Gain) -> bool:
    seen, felt = gain.mended
    mended = gain.fallen > WORTH_SHARE * gain.calm[0] ** 2 or seen > WORTH_MM or felt > WORTH_PULL
    return mended and gain.ci95[0] > 0


def _rival(c: Candidate, predicted: Predicted, best: Candidate) -> bool:
    """Predicts about as well: the paired difference is not clear, or no more than what two engines may differ by."""
    if c.hypothesis.effect == best.hypothesis.effect:
        return False
    over = compare(predicted, best.predicted, 0.0)
    hardly = over.density < HARDLY * best.gain.density and over.fallen < HARDLY * best.gain.fallen
    return over.density < CLEAR or over.ci95[0] < 0 or hardly
