"""Residual force: local force laws that are learned from what stays unexplained. They describe, and name no cause.

Local laws (``effects.ResidualForce``) take the catalogue's place in the same search. Each is tested beside everything
that is fitted anyway, the most likely ones are fitted, and one is accepted only if held-out motions are predicted
better with it. This is orthogonal matching pursuit in finite steps, and its path is recorded.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch

from ...boundaries import Grasp
from ...effects import ResidualForce
from ...effects.residual import RESIDUAL_LAWS, RESIDUAL_PLACES, describe_term
from ...episodes.world import RESIDUAL_EFFECT_PREFIX, Hypothesis, World, WorldModel
from ..data.dataset import DiagnosisData, Progress
from ..decide.criteria import CRITERIA
from ..decide.search import SearchResult, extend_search, replace_by_law
from ..inference.comparison import Gain
from ..inference.fitting import ModelFit, fit

PARAMETER_LAWS = ("mass", "bend")  # applied everywhere they equal parameters of the base model
TYPICAL_FACTOR_BY_PLACE = {"inside": 2.0}  # the mean square of this weight is a fourth of that of "@edge"


def _add_term(term: str, world: World, coefficient: float) -> World:
    effects = dict(world.cloth.effects.items())
    effect: ResidualForce | None = effects.get(RESIDUAL_EFFECT_PREFIX)  # type: ignore[assignment]
    terms = {} if effect is None else dict(zip(effect.terms, effect.strength.value.tolist(), strict=True))
    grasped = [part.index for part in world.cloth.boundaries.values() if isinstance(part, Grasp)]
    index = torch.cat(grasped).tolist() if grasped else []
    new = ResidualForce(terms | {term: terms.get(term, 0.0) + coefficient}, index)
    return world.with_cloth({RESIDUAL_EFFECT_PREFIX: new})


def _make_hypothesis(law: str, place: str) -> Hypothesis:
    term = f"{law}@{place}".rstrip("@")
    apply: Callable[[World, float], World] = partial(_add_term, term)
    typical = RESIDUAL_LAWS[law].typical * TYPICAL_FACTOR_BY_PLACE.get(place, 1.0)
    return Hypothesis(f"{RESIDUAL_EFFECT_PREFIX}.{term}", RESIDUAL_LAWS[law].unit, typical, apply, signed=True)


RESIDUAL_HYPOTHESES = tuple(
    _make_hypothesis(law, place)
    for law in RESIDUAL_LAWS
    for place in RESIDUAL_PLACES
    if place or law not in PARAMETER_LAWS
)


@dataclass(frozen=True, eq=False)
class ResidualForceFit:
    """Local force laws that were learned.

    Attributes:
        search: the search among laws, from the model with its causes.
    """

    search: SearchResult

    @property
    def model(self) -> WorldModel:
        """The model with the residual force; its parameters and causes were fitted with it."""
        return self.search.end.model

    @property
    def terms(self) -> dict[str, float]:
        """Coefficient of each term, in SI units."""
        pairs = zip(self.model.accepted, self.model.amplitudes, strict=True)
        return {h.name.removeprefix(f"{RESIDUAL_EFFECT_PREFIX}."): a for h, a in pairs if is_residual(h)}

    @property
    def gain(self) -> Gain | None:
        """Gain over the model without the laws, on held-out motions; None: nothing was learned."""
        return self.search.total_gain

    def as_dict(self) -> dict[str, Any]:
        """Return the content of diagnosis.json."""
        gain, prefix = self.gain, f"{RESIDUAL_EFFECT_PREFIX}."
        return {
            "terms": [
                {
                    "law": term,
                    "coefficient": coefficient,
                    "unit": RESIDUAL_LAWS[term.partition("@")[0]].unit,
                    "description": describe_term(term, coefficient),
                }
                for term, coefficient in self.terms.items()
            ],
            "path": [
                {
                    "accepted": cause.candidate.hypothesis.name.removeprefix(prefix),
                    "log_density": cause.candidate.gain.log_density,
                    "rejected": [
                        c.hypothesis.name.removeprefix(prefix) for c in cause.tried if c is not cause.candidate
                    ],
                }
                for cause in self.search.accepted
            ],
            "gain": None if gain is None else {"rms_before": gain.rms_before, "rms_after": gain.rms_after, "unit": "m"},
        }


def is_residual(hypothesis: Hypothesis) -> bool:
    """Check whether a hypothesis is a law of a residual force, and no cause."""
    return hypothesis.name.startswith(f"{RESIDUAL_EFFECT_PREFIX}.")


def check_against_laws(result: SearchResult, progress: Progress = lambda _: None) -> SearchResult:
    """Drop the causes of a search if one law does clearly more: then something is wrong that nobody asked about.

    What is not in the catalogue may be explained in part by what is, for example a stiff patch by a wider grip.

    Args:
        result: the search.
        progress: called with one line for each episode that is simulated.
    """
    criteria, gain = CRITERIA.residual_law, result.total_gain
    if not result.causes or gain is None or gain.explained_fraction > criteria.max_explained_by_causes:
        return result
    start, here = result.start, result.start.linearisation
    laws = start.model.not_accepted(RESIDUAL_HYPOTHESES)
    fitted = fit(start.model, result.data, laws, 0, progress, start.noise, here, here)
    return replace_by_law(result, fitted, criteria.max_tried, progress)


def learn_residual_force(
    fitted: ModelFit, data: DiagnosisData, progress: Progress = lambda _: None
) -> ResidualForceFit:
    """Learn local laws that explain what a model with its causes leaves, if any does.

    Args:
        fitted: a model at its solution.
        data: the episodes that it was fitted to.
        progress: called with one line for each episode that is simulated.
    """
    laws = fitted.model.not_accepted(RESIDUAL_HYPOTHESES)
    here = fitted.linearisation
    start = fit(fitted.model, data, laws, 1, progress, before=here, here=here)
    return ResidualForceFit(extend_search(start, data, laws, progress, CRITERIA.residual_law.max_tried))
