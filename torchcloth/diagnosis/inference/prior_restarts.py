"""Candidates started from the data sheet, and fits restarted there.

An effect shifts the parameters that are fitted without it, until slopes there ask for little of it or point away from
it. The data sheet knows nothing of the effect, and is often nearer. Signed causes are tried both ways, because pulling
and pushing may differ.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from ...episodes.world import Hypothesis, WorldModel
from ...episodes.world_cache import IMPOSSIBLE_WORLD_ERRORS
from ..data.dataset import DiagnosisData, Progress, prefix_progress
from ..decide.criteria import CRITERIA
from .fitting import ModelFit, add_cause, fit, robust_step, robust_step_with
from .linearise import linearise, linearise_hypotheses
from .noise import inflated_noise, whiten
from .warm_start import quadratic_warm_start


def propose_from_prior(
    start: ModelFit,
    data: DiagnosisData,
    hypotheses: Sequence[Hypothesis],
    max_tried: int,
    progress: Progress = lambda _: None,
    min_gain: float = 0.0,
) -> list[tuple[Hypothesis, WorldModel]]:
    """Propose the causes that promise most by one joint step from the data sheet.

    Args:
        start: fit without the causes.
        data: the episodes.
        hypotheses: to choose from.
        max_tried: largest number of causes.
        progress: called with one line for each episode that is simulated.
        min_gain: log density that a cause must promise. It must also promise a part of what the best one does.

    Returns:
        The causes, each with the model to which the step leads.
    """
    sheet = replace(start.model, coordinates=torch.zeros_like(start.model.coordinates))
    opposites = [h.opposite for h in hypotheses if h.is_reversible]
    stage = prefix_progress(progress, "from the data sheet, causes")
    forward = linearise(sheet, data, hypotheses, stage, start.linearisation)
    stage = prefix_progress(progress, "from the data sheet, the other way")
    backward = linearise_hypotheses(forward, sheet, data, opposites, stage)
    # robust steps need no more of a fit than its model and linearisation
    fits = [replace(start, model=sheet, linearisation=result) for result in (forward, backward)]
    promised = sorted((row for fitted in fits for row in _expected_gains(fitted)), key=lambda row: -row[0])
    likely: dict[str, ModelFit] = {}
    for gain, name, fitted in promised:
        if gain > max(min_gain, CRITERIA.restart.min_relative_gain * promised[0][0]):
            likely.setdefault(name, fitted)
    by_name = {h.name: h for h in hypotheses}
    return [(by_name[name], add_cause(fitted, by_name[name])) for name, fitted in list(likely.items())[:max_tried]]


def refit_from_prior(
    fitted: ModelFit, data: DiagnosisData, hypotheses: Sequence[Hypothesis], progress: Progress = lambda _: None
) -> ModelFit | None:
    """Fit the same causes again from the data sheet, and linearise along the others.

    A parameter that has left its data sheet made up for causes that were not known then, and may hide the next one.

    Args:
        fitted: fit with causes.
        data: the episodes.
        hypotheses: all that are asked about.
        progress: called with one line for each episode that is simulated.

    Returns:
        The fit; None if a parameter leaves its data sheet again, or if the data sheet's values cannot be simulated with
        these causes.
    """
    model = replace(fitted.model, coordinates=torch.zeros_like(fitted.model.coordinates))
    others = model.not_accepted(hypotheses)
    try:
        near, _ = quadratic_warm_start(model, data, prefix_progress(progress, "causes, from the data sheet"))
        stage = prefix_progress(progress, "causes, anew")
        refitted = fit(near, data, progress=stage, before=fitted.linearisation)
        if refitted.model.strained_parameters:
            return None
        return fit(refitted.model, data, others, 0, stage, before=fitted.linearisation, here=refitted.linearisation)
    except IMPOSSIBLE_WORLD_ERRORS:
        return None


def _expected_gains(fitted: ModelFit) -> list[tuple[float, str, ModelFit]]:
    """Return (log density that a cause adds to one robust step, its name, the fit), where the step has its sign."""
    whitened, out = whiten(fitted.linearisation, inflated_noise()), []
    _, gain_without = robust_step(whitened, fitted.model)
    for j, h in enumerate(fitted.linearisation.hypotheses):
        column = fitted.linearisation.n_coordinates + j
        step, gain = robust_step_with(whitened, fitted.model.with_hypothesis(h), column)
        if float(step[-1]) * h.typical > 0:
            out.append((gain - gain_without, h.name, fitted))
    return out
