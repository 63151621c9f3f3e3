"""Slopes of a chaotic motion: by regression over simulations around a point, not by tangents.

Light cloth that buckles forgets small differences. After a change by a thousandth of its stiffness its ripples lie
elsewhere half a second later. Tangents describe that exactly and grow without bound (some 10 to 100 times in 0.3 s),
while the ripples themselves stay millimetres high. What a parameter does to the cloth as a whole shows over finite
steps, beyond the ripples. So simulations are spread around the point, as wide as the answer is uncertain. The straight
line through their residuals is the slope (statistical linearisation, as in iterative ensemble smoothers: Chen and
Oliver 2013). Their scatter about it is the contribution of the ripples, which the measured cloth has as well: rows are
weighted by this noise, and the errors are widened by it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from ..._utils.constants import Z_95
from ...errors import SimulationDiverged, UnstableStep
from ..residuals.metrics import noise_scale
from ..uncertainty.consider_covariance import solution_covariance, with_grasp_offsets
from ..uncertainty.identifiability import ParameterInfluence
from . import levenberg_marquardt
from .levenberg_marquardt import Iterate, Linearised
from .linearity import LinearityCheck
from .objective import Objective
from .predictability import PredictableFit, frames_within_episodes


@dataclass(frozen=True)
class SamplingSettings:
    """How simulations are spread around a point and what counts as a slope.

    Attributes:
        max_rounds: rounds of the search.
        max_stalled_rounds: rounds that know less than an earlier one and come no nearer to the data, after which the
            search ends. In 16 rigs of ``studies honesty`` it went on for one to eight rounds, and all numbers that it
            identified came from searches that converged within two.
        min_approach: relative decrease of the distance from the data that counts as nearer.
        max_error_growth: standard error over the least one of an earlier round, from which a round knows less. Where
            simulations see through the ripples, errors fall from round to round.
        wide_std: widest standard deviation of the simulations around a point, in longest steps.
        narrow_std: narrowest standard deviation, in longest steps.
        max_move_stds: longest move of a round, in these standard deviations.
        max_reuse_stds: distance within which simulations of earlier rounds count, in these standard deviations.
        converged_std_errors: standard errors of a step that ends the search.
        max_distance_ratio: a step that increases the distance by more than this factor is halved.
        max_halvings: largest number of such halvings.
        min_slope_to_error: mean square of a slope over that of its errors, from which it counts as one.
        min_relative_variance: least variance of a combination that the beginning determined, in units of each
            unknown's own.
        spare_pairs: pairs of simulations beyond those that the slopes need.
    """

    max_rounds: int = 8
    max_stalled_rounds: int = 2
    min_approach: float = 0.01
    max_error_growth: float = 1.5
    wide_std: float = 0.4
    narrow_std: float = 0.2
    max_move_stds: float = 1.5
    max_reuse_stds: float = 2.5
    converged_std_errors: float = 0.5
    max_distance_ratio: float = 1.25
    max_halvings: int = 4
    min_slope_to_error: float = 1.5
    min_relative_variance: float = 1e-6
    spare_pairs: int = 4


SAMPLING_SETTINGS = SamplingSettings()


class Sample(NamedTuple):
    """One simulation.

    Attributes:
        raw: [K] unknowns.
        residual: [R].
        x: [F, V, 3] m, frames of all episodes.
        force: [F, 3] N, of all grippers.
    """

    raw: Tensor
    residual: Tensor
    x: Tensor
    force: Tensor


class LinearRegression(NamedTuple):
    """The straight line through a cloud of simulations, and their scatter about it, in rows of equal noise.

    Attributes:
        linear: residuals and slopes at the centre.
        scatter: [N, R] of each simulation about the line.
        degrees_of_freedom: simulations less fitted numbers.
    """

    linear: Linearised
    scatter: Tensor
    degrees_of_freedom: int


class SampledFit(NamedTuple):
    """Where the search ended.

    Attributes:
        final: the solution.
        influence: how far each unknown moves the cloth.
        covariance: [K, K].
        simulations: number of simulated episodes.
    """

    final: Iterate
    influence: ParameterInfluence
    covariance: Tensor
    simulations: int


def fit_by_sampling(
    objective: Objective,
    failed: LinearityCheck,
    beginning: PredictableFit | None,
    rounds: int,
    on_round: Callable[[Tensor], object],
    strata: Tensor | None = None,
    could_identify: Callable[[Iterate, Tensor], bool] = lambda at, covariance: True,
) -> LinearityCheck | None:
    """Fit all frames by simulations spread around the solution.

    Args:
        objective: of all frames.
        failed: the solution by tangents, which failed the check.
        beginning: fit of the predictable beginning; it becomes the prior for the other frames.
        rounds: largest number of rounds.
        on_round: called with every point that the search comes to.
        strata: [E] groups of replicates, as in ``solution_covariance``.
        could_identify: whether a search that is at some point with a covariance [K, K] may yet identify something;
            else it ends, because simulations are dear.

    Returns:
        The solution, or None where too many simulations fail.
    """
    before, problem = objective.simulations, objective.problem()
    raw, mask, note = failed.final.raw, None, ""
    if beginning is not None:
        start, mask = beginning.checked.final.raw, rows_after_part(objective, beginning.objective)
        covariance = solution_covariance(beginning.objective, beginning.checked, strata)
        problem = _with_prior(problem, start, covariance)
        raw = _nearer_start(objective, start, raw)
        note = f" after the first {beginning.duration:.2f} s"
    try:
        result = _search(SampleCloud(objective, mask), problem, raw, rounds, on_round, could_identify)
    except SimulationDiverged:
        return None
    objective.simulations = before + result.simulations
    warning = (
        f"{failed.failure_reason}: slopes and errors{note} were taken from {result.simulations} simulations around the "
        "solution, and what moves the cloth less than its ripples do is not identifiable"
    )
    return LinearityCheck(result.final, result.influence, [warning], [], covariance=result.covariance)


def _with_prior(problem: levenberg_marquardt.Problem, mean: Tensor, covariance: Tensor) -> levenberg_marquardt.Problem:
    """The problem with an earlier estimate as its prior, correlations included."""
    deviation = covariance.diagonal().sqrt()
    std = torch.minimum(deviation, problem.prior_std)
    values, vectors = torch.linalg.eigh(covariance / deviation[:, None] / deviation)
    inverse = (vectors / values.clamp(min=SAMPLING_SETTINGS.min_relative_variance)) @ vectors.mT
    return problem._replace(prior_mean=mean, prior_std=std, prior_precision=inverse / std[:, None] / std)


def _nearer_start(objective: Objective, beginning: Tensor, by_tangents: Tensor) -> Tensor:
    """The end on the beginning, unless the end by tangents, which may have gone far, is nearer to all frames."""
    try:
        is_nearer = objective.mean_distance(by_tangents) < objective.mean_distance(beginning)
        return by_tangents if is_nearer else beginning
    except (SimulationDiverged, UnstableStep):
        return by_tangents


def rows_after_part(objective: Objective, part: Objective) -> Callable[[Linearised], Tensor]:
    """Return a function that tells which rows [R] of the whole belong to no frame of its beginning ``part``."""

    def mask(linear: Linearised) -> Tensor:
        used = torch.tensor([e.observed_count for e in part.episodes])[objective.episode_of_rows(linear)]
        return frames_within_episodes(objective, linear)[0] >= used

    return mask


def _search(
    cloud: SampleCloud,
    problem: levenberg_marquardt.Problem,
    start: Tensor,
    rounds: int,
    on_round: Callable[[Tensor], object],
    could_identify: Callable[[Iterate, Tensor], bool],
) -> SampledFit:
    """Gauss-Newton on slopes by regression, from ``start`` [K].

    Raises:
        SimulationDiverged: too few simulations around a point succeed.
    """
    objective, raw, s = cloud.objective, problem.clip(start), SAMPLING_SETTINGS
    widest, narrowest = s.wide_std * problem.max_step, s.narrow_std * problem.max_step
    spread = torch.minimum(torch.maximum(problem.prior_std, narrowest), widest)
    rounds_left, stalled_rounds, nearest = min(s.max_rounds, max(1, rounds)), 0, objective.mean_distance(raw)
    least_errors = torch.full_like(raw, torch.inf)
    while True:
        cloud.add(raw, spread)
        samples, rounds_left = cloud.near(raw, spread), rounds_left - 1
        regression = regress(samples, raw, cloud.rows)
        at = levenberg_marquardt.evaluate_point(problem, raw, regression.linear)
        at = _drop_insignificant_slopes(problem, at)
        gradient, hessian = levenberg_marquardt.normal_equations(problem, at)
        limit = s.max_move_stds * spread
        step = torch.linalg.solve(hessian, -gradient).clamp(-limit, limit)
        moved = _limit_distance(objective, problem, raw, step)
        variances = _ripple_covariance(problem, at, regression).diagonal()
        covariance = levenberg_marquardt.inflate_covariance(levenberg_marquardt.covariance(problem, at), variances)
        deviation, fabric = covariance.diagonal().sqrt(), len(objective.unknowns)
        distance = objective.mean_distance(moved)
        knows_less = bool((deviation > s.max_error_growth * least_errors)[:fabric].any())
        stalled_rounds += knows_less and not distance < (1 - s.min_approach) * nearest
        nearest, least_errors = min(nearest, distance), torch.minimum(least_errors, deviation)
        is_small_move = bool(((moved - raw).abs() <= s.converged_std_errors * deviation)[:fabric].all())
        converged = is_small_move and not knows_less  # errors that grew would make any move small
        on_round(moved)
        linear = at.linear._replace(residual=at.linear.residual + at.linear.jacobian @ (moved - raw))
        there = levenberg_marquardt.evaluate_point(problem, moved, linear)._replace(converged=converged)
        is_stalled = stalled_rounds == s.max_stalled_rounds or not could_identify(there, covariance)
        if converged or is_stalled or not rounds_left:
            simulations = len(cloud.samples) * len(objective.episodes)
            return SampledFit(there, _influence(objective, samples, raw), covariance, simulations)
        raw, spread = moved, torch.minimum(torch.maximum(deviation, narrowest), widest)


def _drop_insignificant_slopes(problem: levenberg_marquardt.Problem, at: Iterate) -> Iterate:
    """Set slopes to zero that are no larger than their own errors: ripples hide these unknowns."""
    weight, linear = at.row_weights()[0], at.linear
    if linear.simulation_variance is None or linear.slope_covariance is None:
        return at
    size = weight @ linear.jacobian.square()
    error = (weight * linear.simulation_variance).sum() * linear.slope_covariance.diagonal()
    jacobian = torch.where(size > SAMPLING_SETTINGS.min_slope_to_error * error, linear.jacobian, 0.0)
    return levenberg_marquardt.evaluate_point(problem, at.raw, linear._replace(jacobian=jacobian))


def _limit_distance(objective: Objective, problem: levenberg_marquardt.Problem, raw: Tensor, step: Tensor) -> Tensor:
    """Go as far along a step as the cloth does not move farther from the data than ripples would put it."""
    distance_here = objective.mean_distance(raw)
    for _ in range(SAMPLING_SETTINGS.max_halvings):
        moved = problem.clip(raw + step)
        try:
            if not objective.mean_distance(moved) > SAMPLING_SETTINGS.max_distance_ratio * distance_here:
                return moved
        except (SimulationDiverged, UnstableStep):
            pass
        step = 0.5 * step
    return raw


class SampleCloud:
    """Makes simulations around points of an objective, and stores them.

    Grasp offsets that are not fitted are drawn from their noise, so that they scatter as unknown numbers do.

    Args:
        objective: of all frames.
        mask: tells which rows count; None: all.

    Attributes:
        samples: simulations of all rounds.
        rows: what the rows mean, from the first simulation on.
    """

    def __init__(self, objective: Objective, mask: Callable[[Linearised], Tensor] | None) -> None:
        self.objective, self.mask = objective, mask
        self.wider, self.is_sampled_offset = with_grasp_offsets(objective)
        self.samples: list[Sample] = []
        self.first_of_round = 0
        self.rows: Linearised

    def add(self, raw: Tensor, spread: Tensor) -> None:
        """Simulate pairs on both sides of ``raw`` [K], with standard deviations ``spread`` [K]."""
        count, self.first_of_round = len(raw), len(self.samples)
        extra = self.is_sampled_offset
        for offset in _offsets(count, int(extra.sum()), len(self.samples)):
            shifted = self.objective.clip(raw + spread * offset[:count])
            point = self.wider.start.clone()
            point[~extra], point[extra] = shifted, offset[count:] * self.wider.prior_std[extra]
            try:
                self.rows, frames = self.wider.evaluate_all(point), self.wider.observe(point)
            except (SimulationDiverged, UnstableStep):
                continue
            forces = [w[1:, :3] for f in frames for w in f.wrench.values()]
            force = torch.cat(forces) if forces else raw.new_zeros(0, 3)
            residual = self.rows.residual if self.mask is None else self.rows.residual * self.mask(self.rows)
            self.samples.append(Sample(shifted, residual, torch.cat([f.x for f in frames]), force))

    def near(self, raw: Tensor, spread: Tensor) -> list[Sample]:
        """Return the simulations that count at a point.

        Simulations of this round always count: of many unknowns some always lie far out in one.

        Raises:
            SimulationDiverged: too few simulations.
        """
        reach = SAMPLING_SETTINGS.max_reuse_stds * spread
        earlier = [s for s in self.samples[: self.first_of_round] if bool(((s.raw - raw).abs() <= reach).all())]
        samples = [*earlier, *self.samples[self.first_of_round :]]
        if len(samples) < len(raw) + SAMPLING_SETTINGS.spare_pairs:
            raise SimulationDiverged(
                f"only {len(samples)} simulations around the solution went well",
                remedy="start nearer, or with a smaller dt",
            )
        return samples


def regress(samples: Sequence[Sample], raw: Tensor, rows: Linearised) -> LinearRegression:
    """Fit a straight line through the residuals about ``raw`` [K] by least squares.

    Rows are divided by their noise, which is that of the ripples and of the data.
    """
    design, residual = _design_matrix(samples, raw), torch.stack([s.residual for s in samples])
    solution = torch.linalg.lstsq(design, residual).solution
    scatter = residual - design @ solution
    degrees_of_freedom = len(design) - design.shape[1]
    variance = _pool_variance(scatter.square().sum(0) / degrees_of_freedom, rows)
    weight = _equalising_weight(solution[0], variance, rows.blocks)
    linear = rows._replace(
        residual=weight * solution[0],
        jacobian=weight[:, None] * solution[1:].mT,
        simulation_variance=weight**2 * variance,
        slope_covariance=torch.linalg.inv(design.mT @ design)[1:, 1:],
    )
    return LinearRegression(linear, weight * scatter, degrees_of_freedom)


def _equalising_weight(residual: Tensor, variance: Tensor, block: Tensor) -> Tensor:
    """[R] weights that give rows of a block equal noise, without a change of its mean square."""
    weight = torch.ones_like(residual)
    for b in block.unique():
        in_block = (block == b) & (residual != 0)
        if int(in_block.sum()) > 1:
            is_calm = variance[in_block] <= variance[in_block].median()  # few ripples: shows the sensor's noise
            floor = noise_scale(residual[in_block][is_calm], None) ** 2
            noise = (floor + variance[in_block]).sqrt()
            weight[in_block] = noise.square().mean().sqrt() / noise
    return weight


def _offsets(count: int, extra_count: int, seed: int) -> Tensor:
    """[N, K + extra] in standard deviations: antithetic pairs, with columns orthogonal among the unknowns."""
    pairs = count + SAMPLING_SETTINGS.spare_pairs
    generator = torch.Generator().manual_seed(seed)
    normal = torch.randn(pairs, count + extra_count, generator=generator, dtype=torch.float64)
    orthogonal = torch.linalg.qr(normal[:, :count])[0] * pairs**0.5
    half = torch.cat([orthogonal, normal[:, count:]], 1)
    return torch.cat([half, -half])


def _design_matrix(samples: Sequence[Sample], raw: Tensor) -> Tensor:
    offsets = torch.stack([s.raw for s in samples]) - raw
    return torch.cat([torch.ones(len(offsets), 1, dtype=offsets.dtype), offsets], 1)


def _pool_variance(variance: Tensor, rows: Linearised) -> Tensor:
    """[R] means over rows of one block, frame and error group: each alone is known to a factor of two at best."""
    groups = int(rows.error_group.max()) + 1
    group = (rows.blocks * (int(rows.frame.max()) + 1) + rows.frame) * groups + rows.error_group
    total, count = variance.new_zeros(2, int(group.max()) + 1).index_add(
        1, group, torch.stack([variance, torch.ones_like(variance)])
    )
    return (total / count.clamp(min=1))[group]


def _ripple_covariance(problem: levenberg_marquardt.Problem, at: Iterate, regression: LinearRegression) -> Tensor:
    """[K, K] of the estimate by ripples: the measured cloth ripples as one more simulation does."""
    inverse = torch.linalg.inv(levenberg_marquardt.information_matrix(problem, at))
    shifts = regression.scatter @ (at.row_weights()[0][:, None] * at.linear.jacobian) @ inverse
    degrees = regression.degrees_of_freedom
    widening = levenberg_marquardt.student_quantile(degrees) / Z_95
    return widening**2 * shifts.mT @ shifts / degrees + inverse @ problem.precision @ inverse


def _influence(objective: Objective, samples: Sequence[Sample], raw: Tensor) -> ParameterInfluence:
    """By regression of frames and forces, less what ripples alone would show."""
    design, count = _design_matrix(samples, raw), len(objective.unknowns)
    error = torch.linalg.pinv(design.mT @ design).diagonal()[1 : count + 1]

    def rms_slope(parts: list[Tensor]) -> Tensor:
        values = torch.stack(parts).to(design).flatten(1)
        if not values.shape[1]:  # no gripper measured a force
            return values.new_zeros(count)
        solution = torch.linalg.lstsq(design, values).solution
        slope = solution[1 : count + 1].unflatten(1, (-1, 3)).square().sum(-1).mean(1)
        variance = (values - design @ solution).square().sum(0).mean() / (len(design) - design.shape[1])
        ripples = 3 * variance
        is_significant = slope > SAMPLING_SETTINGS.min_slope_to_error * error * ripples
        return torch.where(is_significant, slope - error * ripples, 0.0).sqrt()

    return ParameterInfluence(rms_slope([s.x for s in samples]), rms_slope([s.force for s in samples]))
