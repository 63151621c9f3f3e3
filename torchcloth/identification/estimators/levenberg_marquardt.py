"""Levenberg-Marquardt on forward-mode sensitivities, with robust residuals and the covariance of the estimate."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from ..._utils.constants import Z_95
from ...errors import SimulationDiverged, UnstableStep
from ..residuals.metrics import HUBER_THRESHOLD, huber, noise_scale
from .box_qp import solve_box_qp


@dataclass(frozen=True)
class SolverSettings:
    """Settings of the Levenberg-Marquardt loop.

    Attributes:
        initial_damping: first damping, relative to the diagonal of the Hessian.
        min_damping: least damping after accepted steps.
        min_damping_after_rejection: least damping after a rejected step.
        damping_decrease: factor by which an accepted step divides the damping.
        damping_increase: factor by which a rejected step multiplies the damping.
        max_trials: trial steps from one point before the solver gives up there.
        min_gain_ratio: actual over predicted decrease, below which the tangents misled a step.
        max_misled_steps: consecutive misled steps that end the search: such tangents say nothing about finite steps.
        max_small_steps: consecutive steps below the tolerance, without an optimum, that end the search: it no longer
            moves. One ends it if exact slopes asked for a longer step, and only its damped rest went downhill: another
            one would be damped as much.
        broyden_tolerance: relative error of the predicted decrease up to which an updated Jacobian is good enough.
        min_gain_to_double: actual over predicted decrease, from which a step is doubled. Tangents along which ripples
            move overestimate the curvature of the cost, and a simulation costs far less than another linearisation.
        min_decrease_to_double: decrease of the cost, from which a step is worth another simulation.
        max_doublings: of one step.
    """

    initial_damping: float = 1e-3
    min_damping: float = 1e-6
    min_damping_after_rejection: float = 1e-2
    damping_decrease: float = 5
    damping_increase: float = 10
    max_trials: int = 6
    min_gain_ratio: float = 0.1
    max_misled_steps: int = 4
    max_small_steps: int = 2
    broyden_tolerance: float = 0.1
    min_gain_to_double: float = 1.25
    min_decrease_to_double: float = 0.05
    max_doublings: int = 3


@dataclass(frozen=True)
class NoiseModelSettings:
    """Assumptions about the residuals' noise: outliers, and how long errors last.

    Attributes:
        outlier_stds: standard deviations beyond a block's outlier distance from which a residual does not count.
        frames_per_time_block: frames at the reference rate within which residuals of one error group count as one
            observation.
        reference_rate_hz: frame rate [Hz] at which ``frames_per_time_block`` is counted: errors last for a time,
            whatever the rate of the recording.
        min_median_count: number of residuals below which their median says little about their scatter.
        infinite_dof: degrees of freedom beyond which Student's distribution is taken as the normal one.
    """

    outlier_stds: float = 5.0
    frames_per_time_block: int = 5
    reference_rate_hz: float = 30.0
    min_median_count: int = 12
    infinite_dof: int = 10**6


SOLVER_SETTINGS = SolverSettings()
DEFAULT_NOISE_MODEL = NoiseModelSettings()


class Linearised(NamedTuple):
    """Residuals of all episodes at one point; rows keep their meaning between points.

    Attributes:
        residual: [R] in units of the data.
        jacobian: [R, K].
        prior_weight: [R].
        frame: [R] int64, counted through all episodes.
        error_group: [R] int64, equal for residuals that share their error.
        block: [R] int64, kind of data; each kind has its own noise. None: all rows are of one kind.
        simulation_variance: [R] variance of one simulation's value, of slopes by regression. None: slopes are exact.
        slope_covariance: [K, K] covariance of such slopes, per unit of ``simulation_variance``.
        time_block: [R] int64, equal for frames nearer than the period of the reference rate. None: the frame.
    """

    residual: Tensor
    jacobian: Tensor
    prior_weight: Tensor
    frame: Tensor
    error_group: Tensor
    block: Tensor | None = None
    simulation_variance: Tensor | None = None
    slope_covariance: Tensor | None = None
    time_block: Tensor | None = None

    @property
    def blocks(self) -> Tensor:
        """[R] block of every row."""
        return torch.zeros_like(self.frame) if self.block is None else self.block

    @property
    def time_blocks(self) -> Tensor:
        """[R] time block of every row."""
        return self.frame if self.time_block is None else self.time_block


class Problem(NamedTuple):
    """A robust least-squares problem with a Gaussian prior.

    Attributes:
        linearise: callback, unknowns [K] -> residuals with Jacobian.
        evaluate: callback, unknowns [K] -> (residual [R], error group [R]), without derivatives.
        clip: callback, unknowns [K] -> the nearest legal unknowns [K].
        prior_mean: [K].
        prior_std: [K].
        max_step: [K], longest step of one iteration.
        noise_floor: least standard deviation of a residual, one for each block [B].
        outlier_distance: [B] residuals beyond it and ``outlier_stds`` do not count. None: all count.
        fixed_scales: noise scale, effective fraction and outlier cutoff of every iterate. None: each has its own.
        prior_precision: [K, K] precision of the prior. None: from ``prior_std``, uncorrelated.
        reported: number of unknowns, the first ones, that must come to rest: others are nuisances. None: all.
        noise_model: assumptions about the noise.
    """

    linearise: Callable[[Tensor], Linearised]
    evaluate: Callable[[Tensor], tuple[Tensor, Tensor]]
    clip: Callable[[Tensor], Tensor]
    prior_mean: Tensor
    prior_std: Tensor
    max_step: Tensor
    noise_floor: Tensor | float | None
    outlier_distance: Tensor | None = None
    fixed_scales: tuple[Tensor, Tensor, Tensor] | None = None
    prior_precision: Tensor | None = None
    reported: int | None = None
    noise_model: NoiseModelSettings = DEFAULT_NOISE_MODEL

    @property
    def precision(self) -> Tensor:
        """[K, K] precision of the prior."""
        return torch.diag(self.prior_std**-2) if self.prior_precision is None else self.prior_precision


class Iterate(NamedTuple):
    """One accepted point.

    Attributes:
        raw: [K] unconstrained unknowns.
        linear: residuals and Jacobian there.
        exact: whether the Jacobian was computed here, not updated from another point.
        scale: [B] standard deviation of a residual.
        effective_fraction: [B] effective over nominal number of observations, at most 1.
        outlier_cutoff: [B] in standard deviations.
        converged: whether the search converged; set on the point that is returned.
    """

    raw: Tensor
    linear: Linearised
    exact: bool
    scale: Tensor
    effective_fraction: Tensor
    outlier_cutoff: Tensor
    converged: bool = False

    @property
    def row_scales(self) -> tuple[Tensor, Tensor, Tensor]:
        """Standard deviation, weight and outlier cutoff of every row, [R] each."""
        block = self.linear.blocks
        return self.scale[block], self.effective_fraction[block] * self.linear.prior_weight, self.outlier_cutoff[block]

    def row_weights(self) -> tuple[Tensor, Tensor]:
        """Return each row's weight [R] in the normal equations and its standardised residual [R]."""
        scale, weight, cutoff = self.row_scales
        z = self.linear.residual / scale
        return weight * huber(z, cutoff)[1] / scale**2, z


class TrialStep(NamedTuple):
    """A step that was evaluated.

    Attributes:
        step: [K].
        residual: [R] there.
        error_group: [R] there.
        decrease: of the robust cost.
    """

    step: Tensor
    residual: Tensor
    error_group: Tensor
    decrease: float


def minimise(
    problem: Problem,
    start: Tensor,
    iterations: int,
    on_iterate: Callable[[Iterate], bool],
    tolerance: float = 0.1,
    settings: SolverSettings = SOLVER_SETTINGS,
) -> Iterate:
    """Minimise the robust cost until a step, damped or not, is below ``tolerance`` standard errors.

    Between exact linearisations the Jacobian is updated by Broyden's rank-one formula, as long as the linear model
    predicts the steps. Scale and correlation of the residuals are estimated anew at every accepted point.

    Args:
        problem: the residuals and the prior.
        start: [K] unconstrained unknowns.
        iterations: largest number of steps.
        on_iterate: called with the start and every accepted point; returns True to stop.
        tolerance: standard errors of a step that ends the search.
        settings: damping and when to trust the linear model.

    Returns:
        The last accepted point, linearised exactly. It has not converged if consecutive steps brought a small part of
        what the tangents promised, or went nowhere.
    """
    current = _linearise(problem, start)
    stop, converged, damping = on_iterate(current), False, settings.initial_damping
    misled_steps = small_steps = 0
    for _ in range(iterations):
        if stop:
            break
        damping_before = damping
        trial, gain_ratio, damping = _step(problem, current, damping, settings)
        if trial is None:
            if current.exact:  # no step helps
                converged = _is_near_minimum(problem, current, tolerance)
                break
            current = _linearise(problem, current.raw)
            continue
        before, current = current, trial
        misled_steps = misled_steps + 1 if gain_ratio < settings.min_gain_ratio else 0
        stop = on_iterate(current) or misled_steps == settings.max_misled_steps
        if _is_small_step(problem, before, trial.raw - before.raw, tolerance):
            if before.exact and _is_near_minimum(problem, before, tolerance):
                converged = True
                break
            small_steps += 1
            was_blocked = before.exact and damping > damping_before
            stop = stop or was_blocked or small_steps == settings.max_small_steps
            current = _linearise(problem, trial.raw)
        else:
            small_steps = 0
            if abs(gain_ratio - 1) > settings.broyden_tolerance and not stop:
                current = _linearise(problem, trial.raw)
    last = current if current.exact else _linearise(problem, current.raw)
    return last._replace(converged=converged)


def take_step(problem: Problem, start: Tensor, settings: SolverSettings = SOLVER_SETTINGS) -> Iterate:
    """Take one step from ``start`` [K]; at its end the Jacobian is an update. Where no step helps, stay there."""
    at = _linearise(problem, start)
    trial, *_ = _step(problem, at, settings.initial_damping, settings)
    return at if trial is None else trial


def _step(
    problem: Problem, at: Iterate, damping: float, settings: SolverSettings
) -> tuple[Iterate | None, float, float]:
    """(accepted point or None, actual over predicted decrease, next damping)."""
    gradient, hessian = normal_equations(problem, at)
    cost_here = robust_cost(problem, at, at.raw, at.linear.residual)
    bounds = _step_bounds(problem, at)
    for _ in range(settings.max_trials):
        step = solve_box_qp(hessian + damping * torch.diag(hessian.diagonal()), -gradient, *bounds)
        trial = _try_step(problem, at, step, cost_here)
        if trial is not None and trial.decrease > 0:
            predicted = -float(gradient @ step + 0.5 * step @ hessian @ step)
            gain_ratio = trial.decrease / max(predicted, 1e-12)
            if gain_ratio > settings.min_gain_to_double and trial.decrease > settings.min_decrease_to_double:
                trial = _extend_step(problem, at, trial, cost_here, bounds, settings.max_doublings)
            damping = max(damping / settings.damping_decrease, settings.min_damping)
            return _broyden_update(problem, at, trial), gain_ratio, damping
        damping = max(settings.damping_increase * damping, settings.min_damping_after_rejection)
    return None, 0.0, damping


def _try_step(problem: Problem, at: Iterate, step: Tensor, cost_here: float) -> TrialStep | None:
    """Evaluate a step from a point with a robust cost; None where the simulation fails."""
    try:
        residual, error_group = problem.evaluate(at.raw + step)
    except (SimulationDiverged, UnstableStep):
        return None
    return TrialStep(step, residual, error_group, cost_here - robust_cost(problem, at, at.raw + step, residual))


def _extend_step(
    problem: Problem, at: Iterate, trial: TrialStep, cost_here: float, bounds: tuple[Tensor, Tensor], max_doublings: int
) -> TrialStep:
    """Double a step for as long as the cost falls farther."""
    for _ in range(max_doublings):
        longer = _try_step(problem, at, (2 * trial.step).clamp(*bounds), cost_here)
        if longer is None or not longer.decrease > trial.decrease:
            break
        trial = longer
    return trial


def _step_bounds(problem: Problem, at: Iterate) -> tuple[Tensor, Tensor]:
    """Longest steps [K] down and up."""
    low, high = (problem.clip(at.raw + sign * problem.max_step) - at.raw for sign in (-1, 1))
    return low, high


def _broyden_update(problem: Problem, at: Iterate, trial: TrialStep) -> Iterate:
    step = trial.step
    prediction_error = trial.residual - at.linear.residual - at.linear.jacobian @ step
    jacobian = at.linear.jacobian + torch.outer(prediction_error, step) / (step @ step)
    linear = at.linear._replace(residual=trial.residual, jacobian=jacobian, error_group=trial.error_group)
    return _iterate(problem, at.raw + step, linear, exact=False)


def evaluate_point(problem: Problem, raw: Tensor, linear: Linearised) -> Iterate:
    """Return a point with the noise scales that its residuals have; their derivatives may be zero."""
    return _iterate(problem, raw, linear, exact=False)


def _linearise(problem: Problem, raw: Tensor) -> Iterate:
    return _iterate(problem, raw, problem.linearise(raw), exact=True)


def _iterate(problem: Problem, raw: Tensor, linear: Linearised, exact: bool) -> Iterate:
    if problem.fixed_scales is not None:
        return Iterate(raw, linear, exact, *problem.fixed_scales)
    block, settings = linear.blocks, problem.noise_model
    count = int(block.max()) + 1
    floor = problem.noise_floor
    floor = floor if isinstance(floor, Tensor) else torch.full((count,), floor or 0.0)
    scale = torch.tensor([noise_scale(linear.residual[block == b], float(floor[b])) for b in range(count)])
    cutoff = torch.full((count,), torch.inf)
    if problem.outlier_distance is not None:
        cutoff = settings.outlier_stds + problem.outlier_distance[:count].to(scale) / scale
    scale, cutoff = scale.to(linear.residual), cutoff.to(linear.residual)
    fraction = _effective_fraction(linear, scale, cutoff, settings).clamp(max=1.0)
    return Iterate(raw, linear, exact, scale, fraction, cutoff)


def _effective_fraction(linear: Linearised, scale: Tensor, cutoff: Tensor, settings: NoiseModelSettings) -> Tensor:
    """Effective over nominal number of observations [B], from how residuals add up within correlated groups.

    Residuals of a wrong shape agree over centimetres and frames. Counted one by one, they would overrule every prior
    and promise errors that are far too small.
    """
    block, group = linear.blocks, _correlated_groups(linear, settings)
    z = linear.residual / scale[block]
    z = huber(z, cutoff[block])[1] * z
    out = torch.ones_like(scale)
    for b in range(len(scale)):
        in_block = block == b
        summed = z.new_zeros(int(group.max()) + 1).index_add(0, group[in_block], z[in_block])
        out[b] = (z[in_block] ** 2).sum() / (summed * summed).sum().clamp(min=1e-12)
    return out


def _correlated_groups(linear: Linearised, settings: NoiseModelSettings) -> Tensor:
    """[R], equal for rows of one error group within one window of time."""
    window = linear.time_blocks // settings.frames_per_time_block
    return window * (int(linear.error_group.max()) + 1) + linear.error_group


def robust_cost(problem: Problem, at: Iterate, raw: Tensor, residual: Tensor) -> float:
    """Compute the robust cost with the scales of ``at``, so that points can be compared."""
    offset = raw - problem.prior_mean
    prior = offset @ problem.precision @ offset
    scale, weight, cutoff = at.row_scales
    return float((weight * huber(residual / scale, cutoff)[0]).sum() + 0.5 * prior)


def normal_equations(problem: Problem, at: Iterate) -> tuple[Tensor, Tensor]:
    """Return gradient [K] and approximate Hessian [K, K] of the robust cost with its prior."""
    weighted = at.row_weights()[0][:, None] * at.linear.jacobian
    gradient = weighted.mT @ at.linear.residual + problem.precision @ (at.raw - problem.prior_mean)
    return gradient, _data_information(at, weighted) + problem.precision


def _data_information(at: Iterate, weighted: Tensor) -> Tensor:
    """[K, K] information of the data, without what errors of the slopes pretend to add."""
    information = weighted.mT @ at.linear.jacobian
    if at.linear.simulation_variance is None or at.linear.slope_covariance is None:
        return information
    informed = (information.diagonal() > 0).to(information)
    unit = information.diagonal().sqrt() + (1 - informed)
    variance = (at.row_weights()[0] * at.linear.simulation_variance).sum()
    corrected = information - variance * at.linear.slope_covariance * informed[:, None] * informed
    values, vectors = torch.linalg.eigh(corrected / unit[:, None] / unit)
    return unit[:, None] * (vectors * values.clamp(min=0.0)) @ vectors.mT * unit


def information_matrix(problem: Problem, at: Iterate) -> Tensor:
    """Return the information [K, K] of data and prior."""
    return normal_equations(problem, at)[1]


def robust_curvature(problem: Problem, at: Iterate) -> Tensor:
    """Return the curvature [K, K] of the robust cost: beyond the Huber threshold residuals have a slope only."""
    scale, weight, _ = at.row_scales
    weight = weight * ((at.linear.residual / scale).abs() <= HUBER_THRESHOLD) / scale**2
    return (weight[:, None] * at.linear.jacobian).mT @ at.linear.jacobian + problem.precision


def _is_small_step(problem: Problem, at: Iterate, step: Tensor, tolerance: float) -> bool:
    """Whether a step of the reported unknowns is below ``tolerance`` standard errors in every direction."""
    return step_in_std_errors(problem, information_matrix(problem, at), step) < tolerance


def step_in_std_errors(problem: Problem, information: Tensor, step: Tensor, ignored: Sequence[int] = ()) -> float:
    """Return how long a step [K] of the reported unknowns is, by their marginal information, without ``ignored``."""
    count = len(step) if problem.reported is None else problem.reported
    counts = torch.tensor([k < count and k not in ignored for k in range(len(step))])
    coupling = information[~counts][:, counts]
    marginal = information[counts][:, counts]
    marginal = marginal - coupling.mT @ torch.linalg.solve(information[~counts][:, ~counts], coupling)
    return max(0.0, float(step[counts] @ marginal @ step[counts])) ** 0.5


def _is_near_minimum(problem: Problem, at: Iterate, tolerance: float) -> bool:
    """Whether the undamped step is small; a damped one may be short because of its damping."""
    gradient, hessian = normal_equations(problem, at)
    step = solve_box_qp(hessian, -gradient, *_step_bounds(problem, at))
    return _is_small_step(problem, at, step, tolerance)


def covariance(problem: Problem, at: Iterate) -> Tensor:
    """Return the covariance [K, K] of the estimate, with residuals correlated within and between nearby frames.

    It is a sandwich estimate, never smaller than what the effective number of observations would give. What fitting
    took out of the residuals is put back. With few observations it is widened as Student's distribution is, so that
    an interval of 1.96 standard deviations holds the truth. Model error that lasts for the whole motion is not covered.
    """
    at = at._replace(linear=_observed_rows(at.linear))
    at = at._replace(scale=_small_sample_scale(problem, at))
    rows_left, groups_left = _leverage_correction(problem, at)
    fraction = at.effective_fraction
    if problem.fixed_scales is None:
        fraction = _effective_fraction(at.linear, at.scale, at.outlier_cutoff, problem.noise_model)
    at = at._replace(effective_fraction=torch.minimum(fraction * groups_left, rows_left))
    inverse = torch.linalg.inv(information_matrix(problem, at))
    weight = at.row_weights()[0] / groups_left.sqrt()[at.linear.blocks]
    scores = (weight * at.linear.residual)[:, None] * at.linear.jacobian
    time_blocks = at.linear.time_blocks
    summed = torch.zeros(int(time_blocks.max()) + 1, scores.shape[1], dtype=scores.dtype)
    summed = summed.index_add(0, time_blocks, scores)
    summed = summed[summed.abs().sum(1) > 0]
    meat = _newey_west(summed) * len(summed) / max(1, len(summed) - 1)
    sandwich = inverse @ (meat + problem.precision) @ inverse
    limit = problem.noise_model.infinite_dof
    degrees = _degrees_of_freedom(problem, at, inverse)
    widening = [student_quantile(n) / Z_95 if n < limit else 1.0 for n in degrees]
    widening = torch.tensor(widening).to(sandwich)
    return inflate_covariance(sandwich, inverse.diagonal()) * widening[:, None] * widening


def _degrees_of_freedom(problem: Problem, at: Iterate, inverse: Tensor) -> list[int]:
    """[K] degrees of freedom of each variance, whose parts come from several blocks (Satterthwaite 1946).

    A parameter that six readings determine is known as six readings are, however many other data there are. The prior
    is taken as exact.
    """
    weight, block = at.row_weights()[0], at.linear.blocks
    counted = (at.row_scales[1] * (weight > 0)).double()
    squares = torch.zeros(len(inverse), dtype=inverse.dtype)
    for b in block.unique().tolist():
        in_block = block == b
        jacobian = at.linear.jacobian[in_block]
        information = (weight[in_block, None] * jacobian).mT @ jacobian
        parts = (inverse @ information @ inverse).diagonal().square()
        squares += parts / counted[in_block].sum().clamp(min=1)
    degrees = inverse.diagonal().square() / squares.clamp(min=1e-300)
    return [max(2, round(n)) for n in degrees.clamp(max=problem.noise_model.infinite_dof).tolist()]


def _observed_rows(linear: Linearised) -> Linearised:
    """Leave out rows of what was not observed: they are zero, have no slopes, and are no observations."""
    observed = (linear.residual != 0) | (linear.jacobian != 0).any(1)
    if not bool(observed.any()):
        return linear
    names = [name for name in Linearised._fields if name != "slope_covariance"]
    rows = {name: row[observed] for name in names if (row := getattr(linear, name)) is not None}
    return linear._replace(**rows)


def _small_sample_scale(problem: Problem, at: Iterate) -> Tensor:
    """[B] standard deviations; of few residuals not below the plain one, because a fit may meet half of them."""
    block, scale = at.linear.blocks, at.scale.clone()
    for b in block.unique().tolist():
        residual = at.linear.residual[block == b]
        if len(residual) < problem.noise_model.min_median_count:
            scale[b] = torch.maximum(scale[b], residual.square().mean().sqrt())
    return scale


def _leverage_correction(problem: Problem, at: Iterate) -> tuple[Tensor, Tensor]:
    """Fractions [B] of the residuals' squares, and [B] of the squares of the groups' common part, that fitting left.

    Parameters move whole groups: fitting takes out as many groups as there are parameters that the data determine,
    rather than the prior.
    """
    block, group = at.linear.blocks, _correlated_groups(at.linear, problem.noise_model)
    inverse = torch.linalg.inv(information_matrix(problem, at))
    leverage = at.row_weights()[0] * ((at.linear.jacobian @ inverse) * at.linear.jacobian).sum(1)
    rows_left, groups_left = torch.ones_like(at.scale), torch.ones_like(at.scale)
    for b in block.unique().tolist():
        in_block = block == b
        fitted, row_count = float(leverage[in_block].sum()), int(in_block.sum())
        group_count = len(group[in_block].unique())
        rows_left[b] = max(1 - fitted / row_count, 1 / row_count)
        # at least what is left within groups
        groups_left[b] = max(1 - fitted / group_count, float(rows_left[b]) / group_count)
    return rows_left, groups_left


def inflate_covariance(covariance: Tensor, variances: Tensor) -> Tensor:
    """Return a covariance [K, K] whose variances are at least the given ones [K]; correlations stay."""
    factor = torch.sqrt((variances / covariance.diagonal()).clamp(min=1.0))
    return covariance * factor[:, None] * factor[None, :]


def student_quantile(degrees_of_freedom: int) -> float:
    """Return the 97.5 % quantile of Student's distribution."""
    from scipy.special import stdtrit

    return float(stdtrit(degrees_of_freedom, 0.975))


def _newey_west(scores: Tensor) -> Tensor:
    """Sum of the scores' outer products over nearby frames, with Bartlett weights (Newey and West 1987)."""
    lags = max(1, round(len(scores) ** 0.5))
    total = scores.mT @ scores
    for lag in range(1, min(lags, len(scores) - 1) + 1):
        cross = scores[lag:].mT @ scores[:-lag]
        total = total + (1 - lag / (lags + 1)) * (cross + cross.mT)
    return total
