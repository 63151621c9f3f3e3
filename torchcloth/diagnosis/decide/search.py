"""Stepwise search for causes: screen, fit the likeliest anew, compare on motions held out, accept, and again."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from ...episodes.world import Hypothesis, Model
from ...episodes.world_cache import if_possible
from ..data.dataset import Progress, Setting, staged
from ..data.replicate_floor import Repeats, pairs_of, repeats
from ..inference.bifurcations import unstable, without
from ..inference.comparison import Gain, Predicted, compare, heard, predict
from ..inference.confounding import alike
from ..inference.fitting import Fitted, fit, weighed_alike
from ..inference.heterogeneity import disputed
from ..inference.lack_of_fit import is_lacking
from ..inference.noise import floor_of, least
from ..inference.prior_restarts import afresh, resettled
from ..inference.screening import MUCH, Row, screen
from ..inference.warm_start import approach
from .backward_elimination import mended, plainer, predicts_better, pruned, unheard
from .candidates import (
    FEWEST,
    FURTHER,
    SURELY,
    TRIED,
    WORTH_PULL,
    Candidate,
    Step,
    alone_in,
    begun_with,
    far_from_sheet,
    one_step,
    worsens,
)

MOST = 4  # causes
FAR = 10.0  # log density that a further step should gain, from which all causes are fitted on together
LEAST = 1 / 3  # of what is wrong, that all causes explain beside something else
FAINT = 0.08  # of what could be explained, where nothing is lacking
HALF = 0.5  # the same of a further cause, and of what only motions tell that do not fit; of what is gained, a law more


class Chain(NamedTuple):
    """Causes one after the other."""

    current: Fitted  # with all of them
    steps: list[Step]
    setting: Setting  # without the cells that jump with them


@dataclass(frozen=True, eq=False)
class Found:
    """The end of a search."""

    start: Fitted
    end: Fitted
    steps: list[Step]
    screened: list[Row]  # at the end
    held_out: tuple[Predicted, Predicted]  # by the model at the start and at the end
    whole: Gain | None  # of all causes together
    floor: float  # m, of a cell: what repetitions differ by, else what the sensor does
    sensor: float  # m, of a cell: noise and slow errors
    repeats: Repeats | None  # None: no episode repeats another
    setting: Setting  # without the cells that jump between shapes
    withdrawn: tuple[str, ...] = ()  # causes that were accepted, and that a law without a cause does more than
    impossible: tuple[str, ...] = ()  # what was asked about and cannot be simulated beside the fitted model

    @property
    def causes(self) -> list[Step]:
        """Those that are large enough to matter; the others stay in the model, so that nothing stands in for them.

        Of what cannot be told apart, by predictions or by slopes, one must matter, and the others be half as large as
        is of interest.
        """
        large = lambda told: any(h.matters(a) for h, a in told) and all(h.might_matter(a) for h, a in told)  # noqa: E731
        return [s for s in self.steps if large(self.alike(s))]

    @property
    def minor(self) -> list[Step]:
        """Those that stay in the model without a name: they, or what predicts as well, are too small to matter."""
        named = self.causes
        return [s for s in self.steps if s not in named]

    def rivals(self, step: Step) -> list[Candidate]:
        """A step's rivals in the end; none is what joined the model beside its cause."""
        there = {s.best.hypothesis.name for s in self.steps}
        return [c for c in step.rivals if c.hypothesis.name not in there]

    def unseen(self, step: Step) -> list[Row]:
        """What slopes cannot tell from a step's cause, where predictions did not and the model has it not."""
        h = step.best.hypothesis
        beaten = {c.hypothesis.name for c in step.tried} - {c.hypothesis.name for c in step.rivals}
        apart = beaten | {s.best.hypothesis.name for s in self.steps} - {h.name}
        others = [r for r in step.screened if r.gain > 0 and r.hypothesis.name not in apart]
        return alike(step.before, step.best.row, self.amplitude(step), others)

    def alike(self, step: Step) -> list[tuple[Hypothesis, float]]:
        """A step's cause in the end, its rivals and what slopes cannot tell from it, with amplitudes.

        Less what is the same by structure, whose amplitude tells nothing more.
        """
        h, rivals = step.best.hypothesis, [(c.hypothesis, c.amplitude) for c in self.rivals(step)]
        said = {*h.kin, *(other.name for other, _ in rivals)}
        unseen = [(r.hypothesis, r.amplitude) for r in self.unseen(step) if r.hypothesis.name not in said]
        return [(h, self.amplitude(step)), *rivals, *unseen]

    def amplitude(self, step: Step) -> float:
        """Of a step's cause in the end."""
        return self.end.model.amplitudes[self.end.model.place(step.best.hypothesis.name)]

    @property
    def left_out(self) -> float:
        """Share of the cells that jump."""
        jumping = sum(map(len, self.setting.unstable or ()))
        return jumping / (jumping + len(self.end.white.value))


def search(
    model: Model, setting: Setting, hypotheses: Sequence[Hypothesis], progress: Progress = lambda _: None
) -> Found:
    """Causes one after the other, until none is both present and useful on motions held out."""
    hypotheses = model.others(hypotheses)
    near, before = approach(model, setting, staged(progress, "from the data sheet"))
    start = fit(near, setting, hypotheses, progress=staged(progress, "base model"), before=before)
    jumping = unstable(start, setting, staged(progress, "folds that turn over"))
    if any(map(len, jumping)):
        setting, start = setting.less(jumping), without(start, jumping)
    current, steps, left = _chain(start, setting, hypotheses, progress, TRIED)
    if not steps:
        current, steps, left = _anew(start, setting, hypotheses, progress)
    if not steps:
        current, steps, left = _of_disputed(start, setting, hypotheses, progress)
    impossible = (*_impossible(start, hypotheses), *(_impossible(current, hypotheses) if steps else ()))
    return replace(_found(start, current, steps, left), impossible=tuple(dict.fromkeys(impossible)))


def _impossible(found: Fitted, hypotheses: Sequence[Hypothesis]) -> list[str]:
    """What was asked about and could not be simulated beside the model."""
    able = {h.name for h in found.evidence.hypotheses}
    return [h.name for h in found.model.others(hypotheses) if h.name not in able]


def _anew(start: Fitted, setting: Setting, hypotheses: Sequence[Hypothesis], progress: Progress) -> Chain:
    """As ``_chain``, with a first cause that is begun at the data sheet.

    Where nothing is lacking any more, it must surely gain what nulls' causes do not.
    """
    lacking = is_lacking(start, setting.names)
    if not lacking and len(set(heard(start.white.episode, setting.names))) < FEWEST:
        return Chain(start, [], setting)
    screened = screen(start)
    rows = {row.hypothesis.name: row for row in screened}
    asked = [row.hypothesis for row in screened if row.sight]
    least = 0.0 if lacking else MUCH
    likely = if_possible(lambda: afresh(start, setting, asked, TRIED, progress, least)) or []
    first = one_step(start, setting, [(rows[h.name], model) for h, model in likely], screened, progress)
    if first is None or not (lacking or first.best.gain.least > SURELY):
        return Chain(start, [], setting)
    return _chain(start, setting, hypotheses, progress, TRIED, first)


def _of_disputed(start: Fitted, setting: Setting, hypotheses: Sequence[Hypothesis], progress: Progress) -> Chain:
    """As ``_chain``, with a first cause of a law about whose number motions disagree."""
    begun, screened = disputed(start, setting.names, hypotheses), screen(start)
    rows = {row.hypothesis.name: row for row in screened if row.sight}
    likely = [(rows[h.name], model) for h, model in begun if h.name in rows]
    first = one_step(start, setting, likely, screened, staged(progress, "disputed"), ()) if likely else None
    return Chain(start, [], setting) if first is None else _chain(start, setting, hypotheses, progress, TRIED, first)


def extend(
    start: Fitted,
    setting: Setting,
    hypotheses: Sequence[Hypothesis],
    progress: Progress = lambda _: None,
    tried: int = TRIED,
) -> Found:
    """As ``search``, from a fit that was asked about the hypotheses, until nothing is lacking any more.

    Each step fits the ``tried`` likeliest anew.
    """
    sound = lambda found: not is_lacking(found, setting.names)  # noqa: E731
    return _found(start, *_chain(start, setting, hypotheses, progress, tried, enough=sound))


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
    step = one_step(laws, found.setting, begun_with(laws, promising, tried), screened, progress)
    if step is None:
        return found
    alone = alone_in(found.steps)
    law, end = (predict(f, names, alone) for f in weighed_alike(step.best.fitted, found.end))
    over = compare(end, law, 0.0)
    if over.least < 0 or over.density < HALF * gained:
        return found
    withdrawn = tuple(s.best.hypothesis.name for s in found.causes)
    none = _found(found.start, found.start, [], found.setting)
    return replace(none, withdrawn=withdrawn, impossible=found.impossible)


def _chain(
    start: Fitted,
    setting: Setting,
    hypotheses: Sequence[Hypothesis],
    progress: Progress,
    tried: int,
    first: Step | None = None,
    enough: Callable[[Fitted], bool] = lambda _: False,
) -> Chain:
    """The model with all causes, after ``first`` if known, until it is ``enough``."""
    nothing = Chain(start, [], setting)

    def asked(found: Fitted, progress: Progress) -> Fitted:
        left = found.model.others(hypotheses)
        return fit(found.model, setting, left, 0, progress, before=start.evidence, here=found.evidence)

    current, steps, step = start, [], first
    while len(steps) < MOST:
        if step is None:
            other = resettled(current, setting, hypotheses, progress) if steps and current.model.strained else None
            if other is not None and predicts_better(other, current, setting.names) > 0:
                current, other = other, None
            screened = screen(current)
            begun = begun_with(current, screened, tried)
            begun += [] if other is None else begun_with(other, screen(other), tried)
            more = begun_with(current, screened, tried, after=tried)
            step = one_step(current, setting, begun, screened, progress, more)
        if step is None:
            break
        best, before, cells = step.best.fitted, current, (start, setting)
        now = staged(progress, f"with {step.best.hypothesis.name}")
        current = fit(best.model, setting, (), FURTHER, now, before=start.evidence, here=best.evidence)
        if is_lacking(current, setting.names):
            start, current, setting = _still(start, current, setting, now)
        if steps and mended(before, current, setting.names, alone_in([*steps, step])) < HALF:
            current, (start, setting) = before, cells
            break
        steps, step = [*steps, step], None
        if enough(current):
            break
        current = asked(current, now)
    current, steps = plainer(current, steps, setting, hypotheses, progress)
    current, steps = pruned(current, steps, setting, hypotheses, progress)
    if steps and current.ahead > FAR:
        here, now = current.evidence, staged(progress, "all")
        current = fit(current.model, setting, progress=now, before=here, here=here)
        current = current if enough(current) else asked(current, now)
        current, steps = pruned(current, steps, setting, hypotheses, progress)
    share = mended(start, current, setting.names, alone_in(steps)) if steps else 1.0
    little = share < LEAST or (share < HALF and unheard(start, current, steps, setting.names))
    far = any(far_from_sheet(step.best, step.best.gain) for step in steps)
    if little or (steps and not far and _idle(_of_all(start, current, steps, setting), start, steps, setting)):
        return nothing
    return Chain(current, steps, setting)


def _still(start: Fitted, current: Fitted, setting: Setting, progress: Progress) -> tuple[Fitted, Fitted, Setting]:
    """Less the cells that jump with the causes in the model, where they are all that is lacking.

    Slack that a loose grip leaves buckles to either side.
    """
    more = unstable(current, setting, staged(progress, "folds that turn over"))
    if not any(map(len, more)) or is_lacking(still := without(current, more), setting.names):
        return start, current, setting
    return without(start, more), still, setting.less(more)


def _of_all(start: Fitted, current: Fitted, steps: list[Step], setting: Setting) -> Gain:
    """What all causes together gain."""
    return compare(*_held_out(start, current, steps, setting), floor_of(current.evidence, least()))


def _idle(whole: Gain, start: Fitted, steps: list[Step], setting: Setting) -> bool:
    """Positions are predicted worse, or hardly better where nothing was lacking, and pulls hardly better.

    Hardly better is enough of what a number of the fabric, which is back with its data sheet, did until then.
    """
    if worsens(whole):
        return True
    faint = whole.explained < FAINT and whole.mended[1] < WORTH_PULL
    return faint and not any(s.best.relieves for s in steps) and not is_lacking(start, setting.names)


def _held_out(start: Fitted, current: Fitted, steps: list[Step], setting: Setting) -> tuple[Predicted, Predicted]:
    """By the model without its causes and with them."""
    first, last = weighed_alike(start, current)
    held_out = lambda found: predict(found, setting.names, alone_in(steps))  # noqa: E731
    return held_out(first), held_out(last)


def _found(start: Fitted, current: Fitted, steps: list[Step], setting: Setting) -> Found:
    screened = screen(current)
    alone = alone_in(steps)
    last = predict(current, setting.names, alone)
    sensor = floor_of(current.evidence, least())  # slow errors that were fitted may be the model's own
    repeated = repeats(last, pairs_of(setting.recordings, setting.episodes))
    floor = sensor if repeated is None else repeated.rms
    held_out = _held_out(start, current, steps, setting)
    whole = compare(*held_out, floor) if steps else None
    return Found(start, current, steps, screened, held_out, whole, floor, sensor, repeated, setting)
