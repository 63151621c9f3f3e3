"""Levenberg-Marquardt on forward-mode sensitivities: few iterations, and the covariance comes with it."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from ...errors import SimulationDiverged, UnstableStep
from ..residuals.metrics import HUBER, huber, noise_scale
from .box_qp import bounded

MISLED = 0.1, 4  # gains below it, so many in a row, show tangents that say nothing of finite steps
TRUSTED = 0.1  # error of the predicted decrease up to which an updated Jacobian is good enough
GATE = 5.0  # standard deviations
NORMAL = 1.95996  # the 97.5 % quantile
WINDOW, PACE = 5, 30.0  # frames, at so many a second, within which residuals of one patch count as one observation
MANY = 10**6  # degrees of freedom, beyond which Student's distribution is the normal one
FEW = 12  # residuals, of which the median says little of their scatter


class Linearised(NamedTuple):
    """Residuals of all episodes at one point; rows keep their meaning between points."""

    value: Tensor  # [R] in units of the data
    jacobian: Tensor  # [R, K]
    factor: Tensor  # [R] prior weight
    frame: Tensor  # [R] int64, counted through all episodes
    patch: Tensor  # [R] int64, what errs together
    block: Tensor | None = None  # [R] int64, kind of data: each has noise of its own. None: all alike
    wobble: Tensor | None = None  # [R] variance of one simulation's value, of slopes by regression; None: exact ones
    blur: Tensor | None = None  # [K, K] covariance of such slopes, for each unit of ``wobble``
    moment: Tensor | None = None  # [R] int64, the same for frames that are nearer than 1 / PACE s. None: the frame

    @property
    def kind(self) -> Tensor:
        """[R] the block of every row."""
        return torch.zeros_like(self.frame) if self.block is None else self.block

    @property
    def when(self) -> Tensor:
        """[R] the moment of every row: errors last for a time, whatever the rate of frames."""
        return self.frame if self.moment is None else self.moment


class Problem(NamedTuple):
    """Callbacks of the fit."""

    linearise: Callable[[Tensor], Linearised]
    evaluate: Callable[[Tensor], tuple[Tensor, Tensor]]  # raw -> (value [R], patch [R]), without derivatives
    clip: Callable[[Tensor], Tensor]
    prior_mean: Tensor  # [K]
    prior_std: Tensor  # [K]
    longest: Tensor  # [K], longest step
    noise: Tensor | float | None  # least standard deviation of a residual, for each block [B]
    gate: Tensor | None = None  # [B] residuals beyond it and five standard deviations do not count; None: all do
    scales: tuple[Tensor, Tensor, Tensor] | None = None  # scale, share and gate of every iterate; None: its own
    correlated: Tensor | None = None  # [K, K] precision of what is known before; None: of the deviations alone

    @property
    def precision(self) -> Tensor:
        """[K, K] of what is known before."""
        return torch.diag(self.prior_std**-2) if self.correlated is None else self.correlated


class Iterate(NamedTuple):
    """One accepted point."""

    raw: Tensor
    linear: Linearised
    exact: bool  # the Jacobian was computed here, not updated from elsewhere
    scale: Tensor  # [B] standard deviation of a residual
    share: Tensor  # [B] independent observations per residual, <= 1
    gate: Tensor  # [B] in standard deviations
    converged: bool = False  # set on the point that is returned

    @property
    def rows(self) -> tuple[Tensor, Tensor, Tensor]:
        """Standard deviation, weight and gate of every row [R]."""
        kind = self.linear.kind
        return self.scale[kind], self.share[kind] * self.linear.factor, self.gate[kind]

    def influence(self) -> tuple[Tensor, Tensor]:
        """(weight of each row [R] in the normal equations, its standardised residual)."""
        scale, factor, gate = self.rows
        z = self.linear.value / scale
        return factor * huber(z, gate)[1] / scale**2, z


def minimise(
    problem: Problem,
    start: Tensor,
    iterations: int,
    on_iterate: Callable[[Iterate], bool],
    tolerance: float = 0.1,
) -> Iterate:
    """Minimise the robust cost until a step is below ``tolerance`` standard errors, damped or not.

    ``on_iterate`` sees the start and every accepted point and returns True to stop.

    Between exact linearisations the Jacobian is updated by Broyden's rank-one formula as long as the linear model
    predicts the steps. Scale and correlation of the residuals are re-estimated at every accepted point. The returned
    point is linearised exactly. Steps that bring a small part of what the tangents promise, one after the other, end
    the search without convergence.
    """
    current = _linearise(problem, start)
    stop, converged, damping, misled = on_iterate(current), False, 1e-3, 0
    for _ in range(iterations):
        if stop:
            break
        trial, gain, damping = _step(problem, current, damping)
        if trial is None:
            if current.exact:  # no step helps
                converged = _is_near(problem, current, tolerance)
                break
            current = _linearise(problem, current.raw)
            continue
        before, current = current, trial
        misled = misled + 1 if gain < MISLED[0] else 0
        stop = on_iterate(current) or misled == MISLED[1]
        if _is_small(problem, before, trial.raw - before.raw, tolerance):
            if before.exact and _is_near(problem, before, tolerance):
                converged = True
                break
            current = _linearise(problem, trial.raw)
        elif abs(gain - 1) > TRUSTED and not stop:
            current = _linearise(problem, trial.raw)
    return _exact(problem, current)._replace(converged=converged)


def _step(problem: Problem, at: Iterate, damping: float) -> tuple[Iterate | None, float, float]:
    """(accepted point or None, actual over predicted decrease, next damping)."""
    gradient, hessian = normal_equations(problem, at)
    now = cost(problem, at, at.raw, at.linear.value)
    low, high = _reach(problem, at)
    for _ in range(6):
        step = bounded(hessian + damping * torch.diag(hessian.diagonal()), -gradient, low, high)
        raw = at.raw + step
        value, patch = _try(problem, raw)
        if value is not None:
            predicted = -float(gradient @ step + 0.5 * step @ hessian @ step)
            decrease = now - cost(problem, at, raw, value)
            if decrease > 0:
                gain = decrease / max(predicted, 1e-12)
                return _updated(problem, at, raw, step, value, patch), gain, max(damping / 5, 1e-6)
        damping = max(10 * damping, 1e-2)
    return None, 0.0, damping


def _reach(problem: Problem, at: Iterate) -> tuple[Tensor, Tensor]:
    """[K], the longest steps down and up."""
    low, high = (problem.clip(at.raw + sign * problem.longest) - at.raw for sign in (-1, 1))
    return low, high


def _try(problem: Problem, raw: Tensor) -> tuple[Tensor | None, Tensor | None]:
    try:
        return problem.evaluate(raw)
    except (SimulationDiverged, UnstableStep):
        return None, None


def _updated(problem: Problem, at: Iterate, raw: Tensor, step: Tensor, value: Tensor, patch: Tensor | None) -> Iterate:
    """The new point with Broyden's update of the Jacobian."""
    missed = value - at.linear.value - at.linear.jacobian @ step
    jacobian = at.linear.jacobian + torch.outer(missed, step) / (step @ step)
    return _iterate(problem, raw, at.linear._replace(value=value, jacobian=jacobian, patch=patch), exact=False)


def judged(problem: Problem, raw: Tensor, linear: Linearised) -> Iterate:
    """A point with the noise scales that its residuals have; their derivatives may be zero."""
    return _iterate(problem, raw, linear, exact=False)


def _linearise(problem: Problem, raw: Tensor) -> Iterate:
    return _iterate(problem, raw, problem.linearise(raw), exact=True)


def _exact(problem: Problem, at: Iterate) -> Iterate:
    return at if at.exact else _linearise(problem, at.raw)


def _iterate(problem: Problem, raw: Tensor, linear: Linearised, exact: bool) -> Iterate:
    if problem.scales is not None:
        return Iterate(raw, linear, exact, *problem.scales)
    kind = linear.kind
    count = int(kind.max()) + 1
    floor = problem.noise if isinstance(problem.noise, Tensor) else torch.full((count,), problem.noise or 0.0)
    scale = torch.tensor([noise_scale(linear.value[kind == b], float(floor[b])) for b in range(count)])
    gate = torch.full((count,), torch.inf) if problem.gate is None else GATE + problem.gate[:count].to(scale) / scale
    scale, gate = scale.to(linear.value), gate.to(linear.value)
    share = _independent_share(linear, scale, gate).clamp(max=1.0)
    return Iterate(raw, linear, exact, scale, share, gate)


def _independent_share(linear: Linearised, scale: Tensor, gate: Tensor) -> Tensor:
    """[B], effective over nominal number of observations, from how residuals add up within patches and windows.

    Residuals of a wrong shape agree over centimetres and frames; counted one by one they would overrule every prior
    and promise errors far too small.
    """
    kind, group = linear.kind, _groups(linear)
    z = linear.value / scale[kind]
    z = huber(z, gate[kind])[1] * z
    out = torch.ones_like(scale)
    for b in range(len(scale)):
        own = kind == b
        summed = z.new_zeros(int(group.max()) + 1).index_add(0, group[own], z[own])
        out[b] = (z[own] ** 2).sum() / (summed * summed).sum().clamp(min=1e-12)
    return out


def _groups(linear: Linearised) -> Tensor:
    """[R], equal for what errs together."""
    return (linear.when // WINDOW) * (int(linear.patch.max()) + 1) + linear.patch


def cost(problem: Problem, at: Iterate, raw: Tensor, value: Tensor) -> float:
    """Robust cost with the scales of ``at``, so that points can be compared."""
    off = raw - problem.prior_mean
    prior = off @ problem.precision @ off
    scale, factor, gate = at.rows
    return float((factor * huber(value / scale, gate)[0]).sum() + 0.5 * prior)


def normal_equations(problem: Problem, at: Iterate) -> tuple[Tensor, Tensor]:
    """(gradient [K], approximate Hessian [K, K]) of the robust cost with its priors."""
    weighted = at.influence()[0][:, None] * at.linear.jacobian
    gradient = weighted.mT @ at.linear.value + problem.precision @ (at.raw - problem.prior_mean)
    return gradient, _told(at, weighted) + problem.precision


def _told(at: Iterate, weighted: Tensor) -> Tensor:
    """[K, K], information of the data; less what errors of the slopes pretend to add."""
    found = weighted.mT @ at.linear.jacobian
    if at.linear.wobble is None or at.linear.blur is None:
        return found
    told = (found.diagonal() > 0).to(found)
    unit = found.diagonal().sqrt() + (1 - told)
    less = found - (at.influence()[0] * at.linear.wobble).sum() * at.linear.blur * told[:, None] * told
    values, vectors = torch.linalg.eigh(less / unit[:, None] / unit)
    return unit[:, None] * (vectors * values.clamp(min=0.0)) @ vectors.mT * unit


def information(problem: Problem, at: Iterate) -> Tensor:
    """[K, K] of data and priors."""
    return normal_equations(problem, at)[1]


def curvature(problem: Problem, at: Iterate) -> Tensor:
    """[K, K] of the robust cost itself: beyond the Huber bound residuals have a slope and no curvature."""
    scale, factor, _ = at.rows
    weight = factor * ((at.linear.value / scale).abs() <= HUBER) / scale**2
    return (weight[:, None] * at.linear.jacobian).mT @ at.linear.jacobian + problem.precision


def _is_small(problem: Problem, at: Iterate, step: Tensor, tolerance: float) -> bool:
    """Below ``tolerance`` standard errors in every direction."""
    _, hessian = normal_equations(problem, at)
    return float(step @ hessian @ step) < tolerance**2


def _is_near(problem: Problem, at: Iterate, tolerance: float) -> bool:
    """Whether the step that is not damped, and so not short for that, is small."""
    gradient, hessian = normal_equations(problem, at)
    return _is_small(problem, at, bounded(hessian, -gradient, *_reach(problem, at)), tolerance)


def covariance(problem: Problem, at: Iterate) -> Tensor:
    """Covariance of the estimate [K, K]: sandwich with residuals correlated within and between nearby frames.

    Never smaller than what the counted independent observations would give. Model error that lasts is beyond it. What
    fitting took out of the residuals is put back, and few observations widen it as Student's distribution does, so that
    the interval of 1.96 deviations holds the truth.
    """
    at = at._replace(linear=_seen(at.linear))
    at = at._replace(scale=_of_few(at))
    rows, groups = _left(problem, at)
    share = _independent_share(at.linear, at.scale, at.gate) if problem.scales is None else at.share
    share = torch.minimum(share * groups, rows)
    at = at._replace(share=share)
    inverse = torch.linalg.inv(information(problem, at))
    weight = at.influence()[0] / groups.sqrt()[at.linear.kind]
    scores = (weight * at.linear.value)[:, None] * at.linear.jacobian
    count = int(at.linear.when.max()) + 1
    summed = torch.zeros(count, scores.shape[1], dtype=scores.dtype).index_add(0, at.linear.when, scores)
    summed = summed[summed.abs().sum(1) > 0]
    meat = _long_run(summed) * len(summed) / max(1, len(summed) - 1)
    robust = inverse @ (meat + problem.precision) @ inverse
    wide = torch.tensor([student(n) / NORMAL if n < MANY else 1.0 for n in _freedom(problem, at, inverse)]).to(robust)
    return at_least(robust, inverse.diagonal()) * wide[:, None] * wide


def _freedom(problem: Problem, at: Iterate, inverse: Tensor) -> list[int]:
    """[K] degrees of freedom of each variance, whose parts are of several kinds of data (Satterthwaite 1946).

    A parameter of which six readings tell is known as six readings are, however many of other things there are beside.
    What the prior tells is exact.
    """
    weight, kind = at.influence()[0], at.linear.kind
    counted = (at.rows[1] * (weight > 0)).double()
    squares = torch.zeros(len(inverse), dtype=inverse.dtype)
    for b in kind.unique().tolist():
        own = kind == b
        told = (weight[own, None] * at.linear.jacobian[own]).mT @ at.linear.jacobian[own]
        squares += (inverse @ told @ inverse).diagonal().square() / counted[own].sum().clamp(min=1)
    freedom = inverse.diagonal().square() / squares.clamp(min=1e-300)
    return [max(2, round(n)) for n in freedom.clamp(max=MANY).tolist()]


def _seen(linear: Linearised) -> Linearised:
    """Without rows of what was not seen, which are zero and have no slopes: no observations, however many they are."""
    seen = (linear.value != 0) | (linear.jacobian != 0).any(1)
    rows = ("value", "jacobian", "factor", "frame", "patch", "block", "wobble", "moment")
    own = {name: row[seen] for name in rows if (row := getattr(linear, name)) is not None}
    return linear._replace(**own) if bool(seen.any()) else linear


def _of_few(at: Iterate) -> Tensor:
    """[B] standard deviations; of few residuals not below the plain one, for a fit may meet half of them exactly."""
    kind, scale = at.linear.kind, at.scale.clone()
    for b in kind.unique().tolist():
        own = at.linear.value[kind == b]
        if len(own) < FEW:
            scale[b] = torch.maximum(scale[b], own.square().mean().sqrt())
    return scale


def _left(problem: Problem, at: Iterate) -> tuple[Tensor, Tensor]:
    """[B] and [B], share of the residuals' squares, and of those of what each group has in common, that fitting left.

    Parameters move whole groups: as many of them as the data determine, rather than the priors, take out that many.
    """
    kind, group = at.linear.kind, _groups(at.linear)
    inverse = torch.linalg.inv(information(problem, at))
    taken = at.influence()[0] * ((at.linear.jacobian @ inverse) * at.linear.jacobian).sum(1)
    rows, groups = torch.ones_like(at.scale), torch.ones_like(at.scale)
    for b in kind.unique().tolist():
        own = kind == b
        count, nominal, some = float(taken[own].sum()), int(own.sum()), len(group[own].unique())
        rows[b] = max(1 - count / nominal, 1 / nominal)
        groups[b] = max(1 - count / some, float(rows[b]) / some)  # at least what is left within groups
    return rows, groups


def at_least(covariance: Tensor, variances: Tensor) -> Tensor:
    """A covariance [K, K] with variances not below these [K]; correlations stay."""
    inflate = torch.sqrt((variances / covariance.diagonal()).clamp(min=1.0))
    return covariance * inflate[:, None] * inflate[None, :]


def student(freedom: int) -> float:
    """The 97.5 % quantile of Student's distribution, to 3 % from two degrees of freedom on (Fisher and Cornish)."""
    z, n = NORMAL, freedom
    second = (5 * z**5 + 16 * z**3 + 3 * z) / (96 * n**2)
    return z + (z**3 + z) / (4 * n) + second + (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / (384 * n**3)


def _long_run(scores: Tensor) -> Tensor:
    """Sum of the scores' outer products over nearby frames, Bartlett weights (Newey and West 1987)."""
    lags = max(1, round(len(scores) ** 0.5))
    total = scores.mT @ scores
    for lag in range(1, min(lags, len(scores) - 1) + 1):
        cross = scores[lag:].mT @ scores[:-lag]
        total = total + (1 - lag / (lags + 1)) * (cross + cross.mT)
    return total
