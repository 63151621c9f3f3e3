"""Candidates that change a law about whose parameter motions disagree, started at their typical amplitude.

A law that differs along warp and weft shows in each motion as another stiffness of a law that does not. The fitted
parameter is a mean of these, and slopes there ask for little. No straight line leads from it to the effect, but a fit
that starts from the effect's side finds it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from ...episodes.world import Hypothesis, WorldModel
from ..causes.fabric import BENDING_EFFECTS, MEMBRANE_EFFECTS
from ..decide.criteria import CRITERIA
from .comparison import jackknife, list_observed_motions
from .fitting import ModelFit

EFFECTS_OF_PARAMETER = {"bending.stiffness": BENDING_EFFECTS, "youngs_modulus": MEMBRANE_EFFECTS}


def propose_from_heterogeneity(
    fitted: ModelFit, motions: Sequence[str], hypotheses: Sequence[Hypothesis]
) -> list[tuple[Hypothesis, WorldModel]]:
    """Propose causes that change a law about whose parameter motions disagree; an empty list in most cases.

    Args:
        fitted: fit without the causes.
        motions: label of each episode.
        hypotheses: to choose from.

    Returns:
        The causes with the models to start their fits from, both ways if they have a sign. The parameter about which
        motions disagree is back at its data sheet, the others stay where they were fitted.
    """
    criteria = CRITERIA.heterogeneity
    if len(set(list_observed_motions(fitted.whitened.episode, motions))) < criteria.min_motions:
        return []
    model, std, proposed = fitted.model, jackknife(fitted, motions)[1], []
    for k, parameter in enumerate(model.parameters):
        if float(std[k]) <= criteria.max_log_std.get(parameter.name, float("inf")):
            continue
        coordinates = model.coordinates.clone()
        coordinates[k] = 0.0
        start = replace(model, coordinates=coordinates)
        for h in model.not_accepted(hypotheses):
            if h.effect in EFFECTS_OF_PARAMETER.get(parameter.name, ()):
                signs = (1.0, -1.0) if h.signed else (1.0,)
                proposed += [(h, start.with_hypothesis(h, sign * h.typical)) for sign in signs]
    return proposed
