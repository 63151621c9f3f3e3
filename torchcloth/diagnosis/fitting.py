"""Gauss-Newton on whitened cells: parameters within their priors, amplitudes of accepted hypotheses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from .bursts import calmed
from .evidence import Evidence, as_held, as_rough, asked_about, gather, shared
from .leaping import columns, curvature, gained, leap, leap_with
from .noise import Noise, Whitened, fit_noise, unfitted, whitened
from .setting import Progress, Setting, staged
from .strides import further
from .world import Hypothesis, Model
from .worlds import IMPOSSIBLE

ENOUGH = 2.0  # log density that a further step should gain, and that the last one did, below which the search ends
ITERATIONS = 5  # at most


@dataclass(frozen=True, eq=False)
class Fitted:
    """A model where the data want it.

    Attributes:
        model: at the solution.
        evidence: at the solution, with the slopes along the hypotheses that were asked about.
        noise: as estimated there.
        white: evidence, whitened.
        covariance: [P + A, P + A] of the model's coordinates.
        ahead: log density that a further step is expected to gain.
    """

    model: Model
    evidence: Evidence
    noise: Noise
    white: Whitened
    covariance: Tensor
    ahead: float


def fit(
    model: Model,
    setting: Setting,
    hypotheses: Sequence[Hypothesis] = (),
    iterations: int = ITERATIONS,
    progress: Progress = lambda _: None,
    noise: Noise | None = None,
    before: Evidence | None = None,
    here: Evidence | None = None,
) -> Fitted:
    """Fit the model's parameters and amplitudes, then ask about the hypotheses there.

    Fits are compared with the same ``noise``; None: estimated. The nuisances' slopes are those of ``before``, if given.
    ``here`` is the evidence at the model's point, where that is known already: nothing of it is simulated again. A step
    into what is ``IMPOSSIBLE`` is not taken. A step goes on in ``strides``. Slopes promise too little where cloth ripples,
    so the search ends only where the last stride gained little, too; where there was none, the last step.
    """
    about = f"{len(hypotheses)} causes" if hypotheses else "as fitted"

    def look(at: Model, steps: int) -> Evidence:
        """After so many; once there are no more, at the hypotheses, too."""
        if steps < iterations:
            return gather(at, setting, (), staged(progress, f"fit {steps + 1}"), before)
        return gather(at, setting, hypotheses, staged(progress, about), before)

    asked = here is None and not iterations
    lately: float | None = 0.0
    here = here or look(model, 0)
    for taken in range(1, iterations + 1):
        before, level = before or here, noise or fit_noise(here)
        step, ahead = leap(whitened(here, level), model)
        if ahead < ENOUGH and lately < ENOUGH:
            break
        there, lately = further(model, here, level, step, setting)
        first, then = model, here
        try:
            model, here, asked = there, look(there, taken), taken == iterations
        except IMPOSSIBLE:
            break
        lately = gained(level, first, then, model, here) if lately is None else lately
    if hypotheses and not asked:
        here = here if before is None else as_held(here, before)
        here = asked_about(here, model, setting, hypotheses, staged(progress, about))
    return weighed(model, here, noise or fit_noise(here))


def weighed(model: Model, evidence: Evidence, noise: Noise) -> Fitted:
    """A model at a solution, its evidence there weighed by a noise."""
    white = calmed(whitened(evidence, noise))
    _, ahead = leap(white, model)
    return Fitted(model, evidence, noise, white, torch.linalg.inv(curvature(white, model)), ahead)


def with_cause(found: Fitted, hypothesis: Hypothesis) -> Model:
    """With one more cause, where one leap leads: the parameters make room for it.

    A parameter that is the cause's twin hands over what it does already.
    """
    index = [h.name for h in found.evidence.hypotheses].index(hypothesis.name)
    model = found.model.plus(hypothesis)
    names = [p.name for p in model.parameters]
    if hypothesis.twin in names:
        place, point = names.index(hypothesis.twin), model.point
        value = model.parameters[place].value
        point[-1], point[place] = value(float(point[place])) / value(0.0) - 1, 0.0
        model = model.at(point)
    step, _ = leap_with(whitened(found.evidence, unfitted()), model, found.evidence.own + index)
    return model.at(model.point + step)


def without_cause(found: Fitted, name: str) -> Model:
    """With one cause less, where one leap leads: the parameters take over what they can."""
    index = found.model.place(name)
    white, place = whitened(found.evidence, unfitted()), len(found.model.parameters) + index
    less = white._replace(value=white.value - found.model.amplitudes[index] * white.jacobian[:, place])
    less = columns(less, [k for k in range(found.evidence.own) if k != place])
    model = found.model.without(name)
    return model.at(model.point + leap(less, model)[0])


def weighed_alike(first: Fitted, second: Fitted) -> tuple[Fitted, Fitted]:
    """Both by the second's noise, on the cells that both have."""
    like = shared(second.evidence, [first.evidence])
    return renoised(first, second.noise, like), renoised(second, second.noise, like)


def renoised(found: Fitted, noise: Noise, like: Evidence) -> Fitted:
    """The same weighed by another noise, on the cells of ``like`` and with stretches as rough as those."""
    evidence = as_rough(found.evidence, like)
    return replace(found, evidence=evidence, noise=noise, white=calmed(whitened(evidence, noise)))
