"""Gauss-Newton on a growing part of an episode, with the size of the corrective force learnt on the way."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from ..errors import SimulationDiverged
from ..identification import gauss_newton
from .objective import Corrected

PARTS = (0.25, 0.5)  # of the frames: far from the truth a long motion is too nonlinear to start with
ROUNDS = 8  # of all frames, at most
LEAST = 0.01  # m/s^2, a thousandth of gravity
FASTEST = 1e4  # m/s^2, a thousand times gravity: no cloth needs that to be where it was seen
TRIES = 40  # of expectation and maximisation, on one linearisation
SMALL = 0.2  # standard errors per unknown, rms, of a step that ends the search

Tell = Callable[[str, Tensor], None]  # stage, unknowns


class Smoothed(NamedTuple):
    """Where it ended."""

    raw: Tensor  # [K]
    final: gauss_newton.Iterate
    root: Tensor  # [K, K], times its own transpose the covariance
    converged: bool

    @property
    def covariance(self) -> Tensor:
        """[K, K]."""
        return self.root @ self.root.mT


def smooth(objective: Corrected, tell: Tell) -> Smoothed:
    """The likeliest unknowns and their covariance, the force's size included (restricted maximum likelihood)."""
    raw = objective.start
    for share in PARTS:
        part = objective.part(share)
        if part.told and len(part.episodes[0].times) < len(objective.episodes[0].times):
            tell(f"the first {100 * share:.0f} % of the frames", raw)
            raw = gauss_newton.minimise(part.problem(), raw, 1, lambda _: False).raw
    converged = False
    for number in range(ROUNDS):
        tell(f"all frames, round {number + 1}", raw)
        final = gauss_newton.minimise(objective.problem(), raw, 1, lambda _: False)
        raw = final.raw
        root, information, best = _learn(objective, final)
        step = best - raw  # what a round asks for, not what it came to: one that fails makes no step at all
        prior = (step / objective.prior_std).square().sum()
        converged = float(step @ information @ step + prior) < SMALL**2 * len(raw)
        if converged:
            break
    return Smoothed(raw, final, root, converged)


def _learn(objective: Corrected, at: gauss_newton.Iterate) -> tuple[Tensor, Tensor, Tensor]:
    """Set the prior's size of every mode to what the numbers and their errors show.

    Returns:
        (root of the covariance with that prior [K, K], information of the data [K, K], the likeliest unknowns with
        both [K], of the linearised problem)

    Expectation and maximisation (Dempster et al. 1977) on the linearised problem, where both are closed forms.
    """
    jacobian, weight = at.linear.jacobian, at.influence()[0][:, None]
    information = (weight * jacobian).mT @ jacobian
    pull = (weight * jacobian).mT @ (jacobian @ at.raw - at.linear.value)
    shape = len(objective.correction.windows), len(objective.correction.modes), 3

    def solved() -> tuple[Tensor, Tensor]:
        root = root_of(information, objective.prior_std)
        return root, root @ (root.mT @ (pull + objective.middle / objective.prior_std**2))

    for _ in range(TRIES):
        root, mean = solved()
        squared = (mean.square() + root.square().sum(1))[objective.pushes].reshape(shape).mean((0, 2))
        if not bool((squared < FASTEST**2).all()):
            raise SimulationDiverged(
                "pose: the force that corrects the simulation grows without end",
                got=f"more than {FASTEST:g} m/s^2",
                remedy="the motion amplifies small pushes too much: fewer modes or frames, or a better fabric",
            )
        objective.expecting(squared.sqrt().clamp(min=LEAST))
    root, mean = solved()
    return root, information, mean


def root_of(information: Tensor, prior_std: Tensor) -> Tensor:
    """[K, K], whose product with its own transpose is the covariance by data and priors.

    In units of the priors' standard deviations, where no eigenvalue is below 1. Steep tangents can make others so large
    that rounding takes this away: what they leave of such a direction is then the prior.
    """
    scaled = prior_std[:, None] * information * prior_std
    scaled = 0.5 * (scaled + scaled.mT)
    eye = torch.eye(len(scaled), dtype=scaled.dtype)
    factor, failed = torch.linalg.cholesky_ex(scaled + eye)
    if not int(failed):
        return prior_std[:, None] * torch.linalg.solve_triangular(factor, eye, upper=False).mT
    values, vectors = torch.linalg.eigh(scaled)
    return prior_std[:, None] * vectors * (1 + values.clamp(min=0)).rsqrt()
