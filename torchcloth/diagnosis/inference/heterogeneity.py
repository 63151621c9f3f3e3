"""Causes that change a law about whose number motions disagree, begun at their typical size.

A law that differs along warp and weft, say, shows in each motion as another stiffness of one that does not: the fitted
number is a mean of these, and slopes there ask for little. No straight line leads from it to the effect, but what lies
between is seen when both are fitted anew from the effect's side.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from ...episodes.world import Hypothesis, Model
from ..causes.fabric import OF_BENDING, OF_MEMBRANE
from .comparison import list_observed_motions, jackknife
from .fitting import ModelFit

# by the number of a law: standard error by how motions differ, in logarithms, beyond which they disagree, and the
# effects that change the law. In 115 sealed nulls the first is reached by two of bending and by none of the membrane
LAWS = {"bending.stiffness": (0.15, OF_BENDING), "youngs_modulus": (0.075, OF_MEMBRANE)}
FEWEST = 3  # motions, of which one may be the odd one


def propose_from_heterogeneity(found: ModelFit, names: Sequence[str], hypotheses: Sequence[Hypothesis]) -> list[tuple[Hypothesis, Model]]:
    """Causes with the models to begin fits of them at, both ways where they have a sign; none, as a rule.

    The number that is disputed is back at its data sheet, the others stay where they were fitted.
    """
    if len(set(list_observed_motions(found.whitened.episode, names))) < FEWEST:
        return []
    model, errors, out = found.model, jackknife(found, names)[1], []
    for place, parameter in enumerate(model.parameters):
        most, effects = LAWS.get(parameter.name, (float("inf"), ()))
        if float(errors[place]) <= most:
            continue
        values = model.values.clone()
        values[place] = 0.0
        begun = replace(model, values=values)
        for h in model.others(hypotheses):
            if h.effect in effects:
                out += [(h, begun.plus(h, way * h.typical)) for way in ((1.0, -1.0) if h.signed else (1.0,))]
    return out
