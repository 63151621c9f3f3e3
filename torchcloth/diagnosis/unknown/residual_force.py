"""A force for what stays unexplained, learned from it: it describes, and is never named as a cause.

Local laws (``effects.ResidualForce``) take the catalogue's place in the same search: each is asked for beside all that
is fitted anyway, the likeliest are fitted anew, and one is kept only if motions that were held out are predicted
better with it. That is orthogonal matching pursuit in finite steps, and its path is kept.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch

from ...boundaries import Grasp
from ...effects import ResidualForce
from ...effects.residual import LAWS, PLACES, describe
from ...episodes.world import RESIDUAL, Hypothesis, Model, World
from ..data.dataset import Progress, DiagnosisData
from ..decide.search import SearchResult, extend_search, replace_by_law
from ..inference.comparison import Gain
from ..inference.fitting import ModelFit, fit

TRIED = 2  # laws that are fitted at each step
NEARLY_ALL = 0.9  # of what can be explained, beyond which no law does clearly more
FITTED = ("mass", "bend")  # everywhere alike they are parameters of the base model
AT = {"inside": 2.0}  # of a law's typical coefficient: this weight's mean square is a fourth of "@edge"'s


def _with(term: str, world: World, coefficient: float) -> World:
    own: ResidualForce | None = dict(world.cloth.effects.items()).get(RESIDUAL)  # type: ignore[assignment]
    terms = {} if own is None else dict(zip(own.terms, own.strength.value.tolist(), strict=True))
    held = [part.index for part in world.cloth.boundaries.values() if isinstance(part, Grasp)]
    index = torch.cat(held).tolist() if held else []
    new = ResidualForce(terms | {term: terms.get(term, 0.0) + coefficient}, index)
    return world.with_cloth({RESIDUAL: new})


def _term(law: str, place: str) -> Hypothesis:
    term = f"{law}@{place}".rstrip("@")
    change: Callable[[World, float], World] = partial(_with, term)
    return Hypothesis(f"{RESIDUAL}.{term}", LAWS[law].unit, LAWS[law].typical * AT.get(place, 1.0), change, signed=True)


TERMS = tuple(_term(law, place) for law in LAWS for place in PLACES if place or law not in FITTED)


@dataclass(frozen=True, eq=False)
class ResidualForceFit:
    """What was learned.

    Attributes:
        found: the search among laws, from the model with its causes.
    """

    search: SearchResult

    @property
    def model(self) -> Model:
        """With the residual force; its parameters and causes were fitted beside it."""
        return self.search.end.model

    @property
    def terms(self) -> dict[str, float]:
        """Coefficient [SI] by term."""
        pairs = zip(self.model.accepted, self.model.amplitudes, strict=True)
        return {h.name.removeprefix(f"{RESIDUAL}."): a for h, a in pairs if is_residual(h)}

    @property
    def gain(self) -> Gain | None:
        """On motions held out, over the model without it; None: nothing was learned."""
        return self.search.total_gain

    def as_dict(self) -> dict[str, Any]:
        """The content of diagnosis.json."""
        gain = self.gain
        return {
            "terms": [
                {"law": term, "coefficient": c, "unit": LAWS[term.partition("@")[0]].unit, "told": describe(term, c)}
                for term, c in self.terms.items()
            ],
            "path": [
                {
                    "kept": s.candidate.hypothesis.name.removeprefix(f"{RESIDUAL}."),
                    "log_density": s.candidate.gain.log_density,
                    "instead_of": [c.hypothesis.name.removeprefix(f"{RESIDUAL}.") for c in s.tried if c is not s.candidate],
                }
                for s in self.search.accepted
            ],
            "gain": None if gain is None else {"rms_before": gain.rms_before, "rms_after": gain.rms_after, "unit": "m"},
        }


def is_residual(hypothesis: Hypothesis) -> bool:
    """Whether it is a law of a residual force, and no cause."""
    return hypothesis.name.startswith(f"{RESIDUAL}.")


def check_against_laws(found: SearchResult, progress: Progress = lambda _: None) -> SearchResult:
    """A search with its causes, or without where one law does clearly more: something that nobody asked about.

    What is not in the catalogue may be done in part by what is: a stiff patch by a wider grip.
    """
    if not found.causes or found.total_gain is None or found.total_gain.explained_fraction > NEARLY_ALL:
        return found
    start, setting = found.start, found.data
    asked, known = start.model.others(TERMS), start.linearisation
    laws = fit(start.model, setting, asked, 0, progress, start.noise, known, known)
    return replace_by_law(found, laws, TRIED, progress)


def learn_residual_force(found: ModelFit, setting: DiagnosisData, progress: Progress = lambda _: None) -> ResidualForceFit:
    """Local laws that mend what a model with its causes leaves, if any does.

    Args:
        found: a model at its solution.
        setting: the episodes that it was fitted to.
        progress: called with one line for each thing that is simulated.
    """
    laws = found.model.others(TERMS)
    start = fit(found.model, setting, laws, 1, progress, before=found.linearisation, here=found.linearisation)
    return ResidualForceFit(extend_search(start, setting, laws, progress, TRIED))
