"""Gauss-Newton on a growing part of an episode, with the size of the corrective force learnt on the way."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from ..identification import gauss_newton
from .objective import Corrected

PARTS = (0.25, 0.5)  # of the frames: far from the truth a long motion is too nonlinear to start with
ROUNDS = 8  # of all frames, at most
LEAST = 0.01  # m/s^2, a thousandth of gravity
TRIES = 40  # of expectation and maximisation, on one linearisation
SMALL = 0.2  # standard errors per unknown, rms, of a step that ends the search

Told = Callable[[str, Tensor], None]  # stage, unknowns


class Smoothed(NamedTuple):
    """Where it ended."""

    raw: Tensor  # [K]
    final: gauss_newton.Iterate
    covariance: Tensor  # [K, K]
    converged: bool


def smooth(objective: Corrected, told: Told) -> Smoothed:
    """The likeliest unknowns and their covariance, the force's size included (restricted maximum likelihood)."""
    raw = objective.start
    for share in PARTS:
        part = objective.part(share)
        if len(part.episodes[0].times) < len(objective.episodes[0].times):
            told(f"the first {100 * share:.0f} % of the frames", raw)
            raw = gauss_newton.minimise(part.problem(), raw, 1, lambda _: False).raw
    converged = False
    for number in range(ROUNDS):
        told(f"all frames, round {number + 1}", raw)
        before = raw
        final = gauss_newton.minimise(objective.problem(), raw, 1, lambda _: False)
        raw = final.raw
        covariance = _learn(objective, final)
        step = raw - before
        converged = float(step @ torch.linalg.solve(covariance, step)) < SMALL**2 * len(raw)
        if converged:
            break
    return Smoothed(raw, final, covariance, converged)


def _learn(objective: Corrected, at: gauss_newton.Iterate) -> Tensor:
    """Set the prior's size of every mode to what the numbers and their errors show; the covariance with it.

    Expectation and maximisation (Dempster et al. 1977) on the linearised problem, where both are closed forms.
    """
    jacobian, weight = at.linear.jacobian, at.influence()[0][:, None]
    information = (weight * jacobian).mT @ jacobian
    pull = (weight * jacobian).mT @ (jacobian @ at.raw - at.linear.value)
    shape = len(objective.correction.windows), len(objective.correction.modes), 3
    for _ in range(TRIES):
        prior = objective.prior_std**-2
        covariance = torch.linalg.inv(information + torch.diag(prior))
        mean = covariance @ (pull + prior * objective.middle)
        squared = (mean.square() + covariance.diagonal())[objective.pushes].reshape(shape).mean((0, 2))
        objective.expecting(squared.sqrt().clamp(min=LEAST))
    return torch.linalg.inv(information + torch.diag(objective.prior_std**-2))
