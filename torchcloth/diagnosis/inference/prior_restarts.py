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
from ..data.dataset import Progress, DiagnosisData, prefix_progress
from .fitting import ModelFit, fit, robust_step, robust_step_with, add_cause
from .linearise import linearise_hypotheses, linearise
from .noise import inflated_noise, whiten
from .warm_start import quadratic_warm_start

WORTH_TRYING = 0.5  # of what the best promises


def propose_from_prior(
    start: ModelFit,
    setting: DiagnosisData,
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
    about = prefix_progress(progress, "from the data sheet, causes")
    there = linearise(sheet, setting, hypotheses, about, start.linearisation)
    back = linearise_hypotheses(there, sheet, setting, away, prefix_progress(progress, "from the data sheet, the other way"))
    ways = [replace(start, model=sheet, evidence=evidence) for evidence in (there, back)]  # leaps ask for no more
    promised = sorted((pair for found in ways for pair in _promises(found)), key=lambda pair: -pair[0])
    likely: dict[str, ModelFit] = {}
    for gained, name, found in promised:
        if gained > max(least, WORTH_TRYING * promised[0][0]):
            likely.setdefault(name, found)
    named = {h.name: h for h in hypotheses}
    return [(named[name], add_cause(found, named[name])) for name, found in list(likely.items())[:tried]]


def refit_from_prior(
    found: ModelFit, setting: DiagnosisData, hypotheses: Sequence[Hypothesis], progress: Progress = lambda _: None
) -> ModelFit | None:
    """The same causes, fitted from the data sheet and asked about the others.

    None where that ends as far from it, or no world has the data sheet's numbers beside these causes.
    A number that has left its data sheet made up for causes that were not known then, and may hide the next one now.
    """
    model = replace(found.model, values=torch.zeros_like(found.model.values))
    left = model.others(hypotheses)
    try:
        near, _ = quadratic_warm_start(model, setting, prefix_progress(progress, "causes, from the data sheet"))
        anew = prefix_progress(progress, "causes, anew")
        again = fit(near, setting, progress=anew, before=found.linearisation)
        if again.model.strained:  # so that nobody asks what it says about the others
            return None
        return fit(again.model, setting, left, 0, anew, before=found.linearisation, here=again.linearisation)
    except IMPOSSIBLE:
        return None


def _promises(found: ModelFit) -> list[tuple[float, str, ModelFit]]:
    """(log density that a cause adds to what one leap should gain, its name, the fit), where the leap goes its way."""
    white, out = whiten(found.linearisation, inflated_noise()), []
    _, without = robust_step(white, found.model)
    for j, h in enumerate(found.linearisation.hypotheses):
        step, gained = robust_step_with(white, found.model.plus(h), found.linearisation.n_coordinates + j)
        if float(step[-1]) * h.typical > 0:
            out.append((gained - without, h.name, found))
    return out
