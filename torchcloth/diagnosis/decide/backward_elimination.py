"""What a search has accepted is doubted: causes that others make needless, or that stand for something unknown."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

from ...episodes.world import Hypothesis
from ...episodes.world_cache import IMPOSSIBLE
from ..data.dataset import Progress, Setting, staged
from ..inference.comparison import compare, of_episodes, predict
from ..inference.fitting import Fitted, fit, renoised, weighed_alike, without_cause
from ..inference.lack_of_fit import explained, is_lacking, lack_of_fit
from ..inference.linearise import shared
from ..inference.noise import floor_of
from ..inference.permutation_test import placebo
from .candidates import CLEAR, FURTHER, Step, alone_in, known, worth_naming, worthwhile


def pruned(
    current: Fitted, steps: list[Step], setting: Setting, hypotheses: Sequence[Hypothesis], progress: Progress
) -> tuple[Fitted, list[Step]]:
    """Less the causes that the others have made needless."""
    for step in steps:
        name = step.best.hypothesis.name
        sure = known(current, name, setting.names, step.best)
        less, now = without_cause(current, name), staged(progress, f"without {name}")
        try:
            less = fit(less, setting, (), 0, now, current.noise, current.evidence)
        except IMPOSSIBLE:  # what it does keeps the others from what no cloth does
            continue
        without, there = (predict(f, setting.names, step.best.alone) for f in weighed_alike(less, current))
        gain = compare(without, there, 0.0)
        if sure and worth_naming(step.best, gain):
            continue
        steps = [s for s in steps if s is not step]
        left = less.model.others(hypotheses)
        current = fit(less.model, setting, left, 1, progress, before=current.evidence, here=less.evidence)
    return current, steps


def plainer(
    current: Fitted, steps: list[Step], setting: Setting, hypotheses: Sequence[Hypothesis], progress: Progress
) -> tuple[Fitted, list[Step]]:
    """With what a cause brings along instead of it, where nothing of its own that matters is left.

    Drag that comes with wind, where the wind stood for a camera that is off until that was found.
    """
    for k, step in enumerate(steps):
        h, model = step.best.hypothesis, current.model
        other = step.instead(h.brings)
        if (
            other is None
            or h.matters(model.amplitudes[model.place(h.name)])
            or h.brings in (o.name for o in model.accepted)
        ):
            continue
        brought, alone = other.best.hypothesis, other.best.alone
        plain = without_cause(current, h.name).plus(brought, brought.typical)  # what is there when h has gone
        left, now = plain.others(hypotheses), staged(progress, f"{h.brings} instead of {h.name}")
        try:
            found = fit(plain, setting, left, FURTHER, now, before=current.evidence)
        except IMPOSSIBLE:
            continue
        chance = placebo(renoised(other.best.fitted, found.noise, found.evidence), setting.names, alone)
        if chance.passed and predicts_better(current, found, setting.names) < CLEAR:
            current, steps = found, [*steps[:k], replace(other, placebo=chance), *steps[k + 1 :]]
    return current, steps


def mended(start: Fitted, end: Fitted, names: Sequence[str], alone: Collection[str] = ()) -> float:
    """Share of what is wrong that is gone; 1 where nothing is lacking any more, or was before and less is wrong now.

    Of less than half, more is still there: whatever makes it may well do what passed for the causes, too. Where both
    meshes agree about less than half of the motions, the share held out, of all. Of cells that both fits have: points
    that vacuum finds on another part of the cloth would come back as if the causes had brought what is wrong with them.
    """
    alike = (replace(f, evidence=shared(f.evidence, [other.evidence])) for f, other in ((start, end), (end, start)))
    first, left = (lack_of_fit(found, names) for found in alike)
    folded = {row.episode for row in (*first, *left) if not row.stable}
    if 2 * len(folded) <= len(names):
        if not is_lacking(end, names):
            return 1.0
        share = explained(first, left)
        return share if share < 0 or any(row.lacking for row in first) else 1.0
    before, after = (predict(f, names, alone) for f in weighed_alike(start, end))
    return compare(before, after, floor_of(end.evidence, end.noise)).explained


def unheard(start: Fitted, end: Fitted, steps: Sequence[Step], names: Sequence[str]) -> bool:
    """Of the causes, motions that fit in the end say nothing, where some do."""
    left = lack_of_fit(end, names)  # a motion whose cells all jump is not among them
    sound = {row.motion for row in left} - {row.motion for row in left if row.lacking or not row.stable}
    told = [k for k, name in enumerate(names) if name in sound]
    alone = alone_in(steps)
    if not told:
        return False
    first, last = (predict(f, names, alone) for f in weighed_alike(start, end))
    return not worthwhile(compare(of_episodes(first, told), of_episodes(last, told), 0.0))


def predicts_better(one: Fitted, other: Fitted, names: Sequence[str]) -> float:
    """Log density by which one fit of a model predicts motions held out better than another."""
    second, first = (predict(f, names) for f in weighed_alike(one, other))
    return compare(first, second, 0.0).density
