"""Gauss-Newton on a growing part of an episode, with the size of the corrective force learnt on the way."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, cast

import torch
from torch import Tensor

from ..errors import SimulationDiverged
from ..identification.estimators import levenberg_marquardt
from .objective import Corrected

PARTS = (0.25, 0.5)  # of the frames: far from the truth a long motion is too nonlinear to start with
FABRIC = 3  # steps of each part where values of the fabric are uncertain
ROUNDS = 8  # of all frames, at most
LEAST = 0.01  # m/s^2, a thousandth of gravity
FASTEST = 1e4  # m/s^2, a thousand times gravity: no cloth needs that to be where it was seen
TRIES = 40  # of expectation and maximisation, on one linearisation
SMALL = 0.2  # standard errors per unknown, rms, of a step that ends the search
STEEP = 1e8  # information over the prior's, from which its square root is worked with: squared, digits are lost
LOST, USUAL = 5.0, 2e-3  # times the noise [m], which is as large where nobody says: so far off nothing was followed
GROWING = 3, 2  # where tangents run away: rounds of each beginning, and steps of each

Tell = Callable[[str, Tensor], None]  # stage, unknowns


class Smoothed(NamedTuple):
    """Where it ended."""

    raw: Tensor  # [K]
    final: levenberg_marquardt.Iterate
    root: Tensor  # [K, K], times its own transpose the covariance
    converged: bool
    holds: int  # frames in which tangents describe a motion

    @property
    def covariance(self) -> Tensor:
        """[K, K]."""
        return self.root @ self.root.mT


def smooth(objective: Corrected, tell: Tell) -> Smoothed:
    """The likeliest unknowns and their covariance, the force's size included (restricted maximum likelihood)."""
    begun, expected = _begun(objective, tell), objective.correction.std
    found = _rounds(objective, begun, tell)
    left, noise = objective.missed(found.raw), objective.floors.get("points", objective.episodes[0].noise)
    if found.holds == len(objective.episodes[0].times) or not left > LOST * (noise or USUAL):
        return found
    first, learnt = found, objective.correction.std  # it was sought where tangents are of no use
    objective.expecting(expected)
    found = _rounds(objective, _window_by_window(objective, begun, tell), tell)
    if objective.missed(found.raw) < left:
        return found
    objective.expecting(learnt)
    return first


def _rounds(objective: Corrected, raw: Tensor, tell: Tell) -> Smoothed:
    """Gauss-Newton on all frames, with the force's size learnt after each step."""
    converged = False
    for number in range(ROUNDS):
        tell(f"all frames, round {number + 1}", raw)
        final = levenberg_marquardt.minimise(objective.problem(), raw, 1, lambda _: False)
        raw = final.raw
        found = _learn(objective, final)
        prior = (found.step / objective.prior_std).square().sum()  # of what a round asks for: it may make none
        converged = float((found.told.root @ found.step).square().sum() + prior) < SMALL**2 * len(raw)
        if converged:
            break
    holds = holds_for(objective, raw)
    return Smoothed(raw, final, found.root, converged and holds == len(objective.episodes[0].times), holds)


def _begun(objective: Corrected, tell: Tell) -> Tensor:
    """[K] from beginnings, and where values of the fabric are uncertain from these first.

    A force that may be large does their work, and is learnt to be large: meanwhile it is expected to be the least.
    """
    raw, expected, fabric = objective.start, objective.correction.std, bool(objective.unknowns)
    if fabric:
        objective.expecting(torch.full_like(expected, LEAST))
    for share in (*PARTS, 1.0) if fabric else PARTS:
        part = objective.part(share) if share < 1 else objective
        if part.told and (share == 1 or len(part.episodes[0].times) < len(objective.episodes[0].times)):
            tell(f"the first {100 * share:.0f} % of the frames" if share < 1 else "all frames, the fabric", raw)
            raw = levenberg_marquardt.minimise(part.problem(), raw, FABRIC if fabric else 1, lambda _: False).raw
    objective.expecting(expected)
    return raw


def holds_for(objective: Corrected, raw: Tensor) -> int:
    """Frames in which no push of the size that is expected moves the cloth farther than it is long, by tangents."""
    moved = objective.tangents(raw)[1].x[objective.pushes]
    size = (moved * objective.correction.stds.to(moved)[:, None, None, None]).square().sum(-1).mean(-1).sqrt().amax(0)
    far = ~(size <= objective.cloth.mesh.extent)  # NaN is far
    return int(far.nonzero()[0]) if bool(far.any()) else len(far)


def _window_by_window(objective: Corrected, raw: Tensor, tell: Tell) -> Tensor:
    """[K] from beginnings that grow by one window: a push far ahead has tangents that end in no motion."""
    count = objective.episodes[0].observed
    rounds, steps = GROWING
    for _, last in objective.correction.windows[:-1]:
        part = cast("Corrected", objective.part((last + 1) / count))
        if not part.told:
            continue
        tell(f"the first {last + 1} of {count} frames", raw)
        part.expecting(objective.correction.std)
        for _ in range(rounds):
            at = levenberg_marquardt.minimise(part.problem(), raw, steps, lambda _: False)
            raw = at.raw
            _learn(part, at)
        objective.expecting(part.correction.std)
    return raw


class Told(NamedTuple):
    """What data tell of all unknowns about a point: least squares of no more rows than there are unknowns."""

    root: Tensor  # [K or less, K], times its own transpose from the left the information
    value: Tensor  # [K or less]

    @classmethod
    def of(cls, at: levenberg_marquardt.Iterate) -> Told:
        """By weighted rows."""
        weight = at.influence()[0].sqrt()
        q, r = torch.linalg.qr(weight[:, None] * at.linear.jacobian)
        return cls(r, -(q.mT @ (weight * at.linear.value)))


class _Learnt(NamedTuple):
    told: Told
    root: Tensor  # [K, K] of the covariance
    step: Tensor  # [K] to the likeliest unknowns


def _learn(objective: Corrected, at: levenberg_marquardt.Iterate) -> _Learnt:
    """Set the prior's size of every mode to what the numbers and their errors show.

    Expectation and maximisation (Dempster et al. 1977) on the linearised problem, where both are closed forms.
    """
    told, shape = Told.of(at), (len(objective.correction.windows), len(objective.correction.modes), 3)
    for _ in range(TRIES):
        root, step = posterior(told, objective.prior_std, objective.middle - at.raw)
        squared = ((at.raw + step).square() + root.square().sum(1))[objective.pushes].reshape(shape).mean((0, 2))
        if not bool((squared < FASTEST**2).all()):
            raise SimulationDiverged(
                "pose: the force that corrects the simulation grows without end",
                got=f"more than {FASTEST:g} m/s^2",
                remedy="the motion amplifies small pushes too much: fewer modes or frames, or a better fabric",
            )
        objective.expecting(squared.sqrt().clamp(min=LEAST))
    return _Learnt(told, *posterior(told, objective.prior_std, objective.middle - at.raw))


def posterior(told: Told, prior_std: Tensor, offset: Tensor) -> tuple[Tensor, Tensor]:
    """(root [K, K], whose product with its own transpose is the covariance by data and priors, step [K] to the mean).

    In units of the priors' standard deviations, where no eigenvalue of the information is below 1. Where steep tangents
    make others so large that rounding would take this away, no square is formed.

    Args:
        told: by the data.
        prior_std: [K].
        offset: [K] of the priors' means from the point.
    """
    scaled, wanted = told.root * prior_std, offset / prior_std
    eye = torch.eye(len(prior_std), dtype=scaled.dtype)
    if float(scaled.square().sum(0).amax()) < STEEP:
        factor = torch.linalg.cholesky(scaled.mT @ scaled + eye)
        root = prior_std[:, None] * torch.linalg.solve_triangular(factor, eye, upper=False).mT
        return root, root @ (root.mT @ ((scaled.mT @ told.value + wanted) / prior_std))
    q, r = torch.linalg.qr(torch.cat([scaled, eye]))
    root = prior_std[:, None] * torch.linalg.solve_triangular(r, eye, upper=True)
    return root, root @ (q.mT @ torch.cat([told.value, wanted]))
