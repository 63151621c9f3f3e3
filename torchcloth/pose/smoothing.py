"""Gauss-Newton on a growing part of an episode, which also learns the size of the corrective force."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, cast

import torch
from torch import Tensor

from ..errors import SimulationDiverged
from ..identification.estimators import levenberg_marquardt
from .objective import CorrectedObjective


@dataclass(frozen=True)
class SmoothingSettings:
    """How the pose is searched for.

    Attributes:
        beginnings: fractions of the frames that are fitted first: far from the truth a long motion is too nonlinear to
            start with.
        fabric_steps: steps on each beginning where values of the fabric are uncertain.
        max_rounds: rounds on all frames.
        max_em_iterations: iterations of expectation and maximisation on one linearisation.
        converged_std_errors: rms standard errors per unknown of a step that ends the search.
        min_force_std_m_per_s2: least standard deviation of the force's prior [m/s^2], a thousandth of gravity.
        max_force_std_m_per_s2: largest plausible force [m/s^2], a thousand times gravity.
        max_squared_information: information over the prior's above which no square is formed, because that would lose
            digits.
        max_distance_over_noise: rms distance over the noise above which the search followed nothing.
        default_noise_m: noise of a point where none is stated [m].
        growing_rounds: rounds on each beginning where tangents run away.
        growing_steps: steps of each of these rounds.
    """

    beginnings: tuple[float, ...] = (0.25, 0.5)
    fabric_steps: int = 3
    max_rounds: int = 8
    max_em_iterations: int = 40
    converged_std_errors: float = 0.2
    min_force_std_m_per_s2: float = 0.01
    max_force_std_m_per_s2: float = 1e4
    max_squared_information: float = 1e8
    max_distance_over_noise: float = 5.0
    default_noise_m: float = 2e-3
    growing_rounds: int = 3
    growing_steps: int = 2


SMOOTHING_SETTINGS = SmoothingSettings()

ReportProgress = Callable[[str, Tensor], None]  # called with (stage, unknowns)


class SmoothedPose(NamedTuple):
    """Where the search ended.

    Attributes:
        raw: [K] unknowns.
        final: the last linearisation.
        covariance_root: [K, K], whose product with its own transpose is the covariance.
        converged: whether the search converged.
        predictable_frames: number of frames in which tangents describe a motion.
    """

    raw: Tensor
    final: levenberg_marquardt.Iterate
    covariance_root: Tensor
    converged: bool
    predictable_frames: int

    @property
    def covariance(self) -> Tensor:
        """[K, K] covariance of the unknowns."""
        return self.covariance_root @ self.covariance_root.mT


def smooth(objective: CorrectedObjective, report: ReportProgress) -> SmoothedPose:
    """Find the likeliest unknowns, their covariance and the force's size (restricted maximum likelihood)."""
    start, initial_std = _fit_beginnings(objective, report), objective.force.mode_std
    result = _fit_all_frames(objective, start, report)
    distance = objective.rms_distance(result.raw)
    noise = objective.noise_floors.get("points", objective.episodes[0].noise_std)
    limit = SMOOTHING_SETTINGS.max_distance_over_noise * (noise or SMOOTHING_SETTINGS.default_noise_m)
    is_predictable = result.predictable_frames == len(objective.episodes[0].times)
    if is_predictable or not distance > limit:
        return result
    first_result, learnt_std = result, objective.force.mode_std  # the search went where tangents are of no use
    objective.set_force_prior(initial_std)
    result = _fit_all_frames(objective, _fit_window_by_window(objective, start, report), report)
    if objective.rms_distance(result.raw) < distance:
        return result
    objective.set_force_prior(learnt_std)
    return first_result


def _fit_all_frames(objective: CorrectedObjective, raw: Tensor, report: ReportProgress) -> SmoothedPose:
    """Gauss-Newton on all frames; the force's size is learnt after each step."""
    converged = False
    for number in range(SMOOTHING_SETTINGS.max_rounds):
        report(f"all frames, round {number + 1}", raw)
        final = levenberg_marquardt.minimise(objective.problem(), raw, 1, lambda _: False)
        raw = final.raw
        learnt = _learn_force_prior(objective, final)
        prior = (learnt.step / objective.prior_std).square().sum()  # the next step counts, even if none is made
        size = float((learnt.information.root @ learnt.step).square().sum() + prior)
        converged = size < SMOOTHING_SETTINGS.converged_std_errors**2 * len(raw)
        if converged:
            break
    predictable_frames = count_predictable_frames(objective, raw)
    converged = converged and predictable_frames == len(objective.episodes[0].times)
    return SmoothedPose(raw, final, learnt.covariance_root, converged, predictable_frames)


def _fit_beginnings(objective: CorrectedObjective, report: ReportProgress) -> Tensor:
    """[K] from beginnings of the motion, and where values of the fabric are uncertain, from these first.

    A force that may be large would do the fabric's work, and would be learnt to be large. So its prior is the narrowest
    meanwhile.
    """
    raw, initial_std, has_fabric = objective.start, objective.force.mode_std, bool(objective.unknowns)
    if has_fabric:
        least = SMOOTHING_SETTINGS.min_force_std_m_per_s2
        objective.set_force_prior(torch.full_like(initial_std, least))
    beginnings = SMOOTHING_SETTINGS.beginnings
    steps = SMOOTHING_SETTINGS.fabric_steps if has_fabric else 1
    for fraction in (*beginnings, 1.0) if has_fabric else beginnings:
        part = objective.first_fraction(fraction) if fraction < 1 else objective
        is_shorter = len(part.episodes[0].times) < len(objective.episodes[0].times)
        if part.has_data and (fraction == 1 or is_shorter):
            name = f"the first {100 * fraction:.0f} % of the frames" if fraction < 1 else "all frames, the fabric"
            report(name, raw)
            raw = levenberg_marquardt.minimise(part.problem(), raw, steps, lambda _: False).raw
    objective.set_force_prior(initial_std)
    return raw


def count_predictable_frames(objective: CorrectedObjective, raw: Tensor) -> int:
    """Count the frames before a push of the expected size moves the cloth by more than its extent, by tangents."""
    slopes = objective.simulate_with_tangents(raw)[1].x[objective.force_slice]
    stds = objective.force.number_stds.to(slopes)[:, None, None, None]
    displacement = (slopes * stds).square().sum(-1).mean(-1).sqrt().amax(0)
    is_far = ~(displacement <= objective.cloth.mesh.extent)  # NaN is far
    return int(is_far.nonzero()[0]) if bool(is_far.any()) else len(is_far)


def _fit_window_by_window(objective: CorrectedObjective, raw: Tensor, report: ReportProgress) -> Tensor:
    """[K] from beginnings that grow by one window: tangents of a push far ahead describe no motion."""
    count = objective.episodes[0].observed_count
    for _, last in objective.force.windows[:-1]:
        part = cast("CorrectedObjective", objective.first_fraction((last + 1) / count))
        if not part.has_data:
            continue
        report(f"the first {last + 1} of {count} frames", raw)
        part.set_force_prior(objective.force.mode_std)
        for _ in range(SMOOTHING_SETTINGS.growing_rounds):
            at = levenberg_marquardt.minimise(part.problem(), raw, SMOOTHING_SETTINGS.growing_steps, lambda _: False)
            raw = at.raw
            _learn_force_prior(part, at)
        objective.set_force_prior(part.force.mode_std)
    return raw


class DataInformation(NamedTuple):
    """Information of the data about all unknowns at a point: least squares of at most as many rows as unknowns.

    Attributes:
        root: [K or less, K], whose own transpose times it is the information.
        residual: [K or less].
    """

    root: Tensor
    residual: Tensor

    @classmethod
    def from_iterate(cls, at: levenberg_marquardt.Iterate) -> DataInformation:
        """Reduce the weighted rows of an iterate."""
        weight = at.row_weights()[0].sqrt()
        q, r = torch.linalg.qr(weight[:, None] * at.linear.jacobian)
        return cls(r, -(q.mT @ (weight * at.linear.residual)))


class _LearntPrior(NamedTuple):
    """What a linearisation says with the learnt prior.

    Attributes:
        information: of the data.
        covariance_root: [K, K] of the posterior.
        step: [K] to the likeliest unknowns.
    """

    information: DataInformation
    covariance_root: Tensor
    step: Tensor


def _learn_force_prior(objective: CorrectedObjective, at: levenberg_marquardt.Iterate) -> _LearntPrior:
    """Set the prior's size of every mode to what the unknowns and their errors show.

    The method is expectation and maximisation (Dempster et al. 1977) on the linearised problem, where both steps have a
    closed form.
    """
    information = DataInformation.from_iterate(at)
    shape = (len(objective.force.windows), len(objective.force.modes), 3)
    limit = SMOOTHING_SETTINGS.max_force_std_m_per_s2
    for _ in range(SMOOTHING_SETTINGS.max_em_iterations):
        root, step = compute_posterior(information, objective.prior_std, objective.prior_mean - at.raw)
        second_moment = ((at.raw + step).square() + root.square().sum(1))[objective.force_slice]
        variance = second_moment.reshape(shape).mean((0, 2))
        if not bool((variance < limit**2).all()):
            raise SimulationDiverged(
                "pose: the force that corrects the simulation grows without end",
                got=f"more than {limit:g} m/s^2",
                remedy="the motion amplifies small pushes too much: fewer modes or frames, or a better fabric",
            )
        objective.set_force_prior(variance.sqrt().clamp(min=SMOOTHING_SETTINGS.min_force_std_m_per_s2))
    root, step = compute_posterior(information, objective.prior_std, objective.prior_mean - at.raw)
    return _LearntPrior(information, root, step)


def compute_posterior(information: DataInformation, prior_std: Tensor, offset: Tensor) -> tuple[Tensor, Tensor]:
    """Compute the posterior of data and priors.

    It is computed in units of the priors' standard deviations, where no eigenvalue of the information is below 1. Where
    steep tangents make others so large that rounding would hide this, no square is formed.

    Args:
        information: of the data.
        prior_std: [K].
        offset: [K] of the priors' means from the point.

    Returns:
        A root [K, K], whose product with its own transpose is the covariance, and the step [K] to the mean.
    """
    scaled, scaled_offset = information.root * prior_std, offset / prior_std
    eye = torch.eye(len(prior_std), dtype=scaled.dtype)
    if float(scaled.square().sum(0).amax()) < SMOOTHING_SETTINGS.max_squared_information:
        factor = torch.linalg.cholesky(scaled.mT @ scaled + eye)
        root = prior_std[:, None] * torch.linalg.solve_triangular(factor, eye, upper=False).mT
        return root, root @ (root.mT @ ((scaled.mT @ information.residual + scaled_offset) / prior_std))
    q, r = torch.linalg.qr(torch.cat([scaled, eye]))
    root = prior_std[:, None] * torch.linalg.solve_triangular(r, eye, upper=True)
    return root, root @ (q.mT @ torch.cat([information.residual, scaled_offset]))
