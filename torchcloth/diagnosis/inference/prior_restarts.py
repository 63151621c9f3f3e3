"""Causes tried from the data sheet, where the fitted model leads to none, and fits begun there anew.

An effect bends the numbers that are fitted without it, until slopes there ask for little of it or point away from it.
The data sheet does not know of the effect, and is often nearer. What pulls and what pushes need not be alike, so signed
causes are asked about both ways.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from ...episodes.world import Hypothesis, Model
from ...episodes.world_cache import IMPOSSIBLE
from ..data.dataset import Progress, Setting, staged
from .fitting import Fitted, fit, leap, leap_with, with_cause
from .linearise import asked_about, gather
from .noise import unfitted, whitened
from .warm_start import approach

WORTH_TRYING = 0.5  # of what the best promises


def afresh(
    start: Fitted,
    setting: Setting,
    hypotheses: Sequence[Hypothesis],
    tried: int,
    progress: Progress = lambda _: None,
    least: float = 0.0,
) -> list[tuple[Hypothesis, Model]]:
    """The ``tried`` causes that promise most, each with the model to which one joint step from the data sheet leads.

    Without those that promise little beside the best, or at most ``least`` in log density.
    """
    sheet = replace(start.model, values=torch.zeros_like(start.model.values))
    away = [h.opposite for h in hypotheses if h.reverses]
    about = staged(progress, "from the data sheet, causes")
    there = gather(sheet, setting, hypotheses, about, start.evidence)
    back = asked_about(there, sheet, setting, away, staged(progress, "from the data sheet, the other way"))
    ways = [replace(start, model=sheet, evidence=evidence) for evidence in (there, back)]  # leaps ask for no more
    promised = sorted((pair for found in ways for pair in _promises(found)), key=lambda pair: -pair[0])
    likely: dict[str, Fitted] = {}
    for gained, name, found in promised:
        if gained > max(least, WORTH_TRYING * promised[0][0]):
            likely.setdefault(name, found)
    named = {h.name: h for h in hypotheses}
    return [(named[name], with_cause(found, named[name])) for name, found in list(likely.items())[:tried]]


def resettled(
    found: Fitted, setting: Setting, hypotheses: Sequence[Hypothesis], progress: Progress = lambda _: None
) -> Fitted | None:
    """The same causes, fitted from the data sheet and asked about the others.

    None where that ends as far from it, or no world has the data sheet's numbers beside these causes.
    A number that has left its data sheet made up for causes that were not known then, and may hide the next one now.
    """
    model = replace(found.model, values=torch.zeros_like(found.model.values))
    left = model.others(hypotheses)
    try:
        near, _ = approach(model, setting, staged(progress, "causes, from the data sheet"))
        anew = staged(progress, "causes, anew")
        again = fit(near, setting, progress=anew, before=found.evidence)
        if again.model.strained:  # so that nobody asks what it says about the others
            return None
        return fit(again.model, setting, left, 0, anew, before=found.evidence, here=again.evidence)
    except IMPOSSIBLE:
        return None


def _promises(found: Fitted) -> list[tuple[float, str, Fitted]]:
    """(log density that a cause adds to what one leap should gain, its name, the fit), where the leap goes its way."""
    white, out = whitened(found.evidence, unfitted()), []
    _, without = leap(white, found.model)
    for j, h in enumerate(found.evidence.hypotheses):
        step, gained = leap_with(white, found.model.plus(h), found.evidence.own + j)
        if float(step[-1]) * h.typical > 0:
            out.append((gained - without, h.name, found))
    return out
