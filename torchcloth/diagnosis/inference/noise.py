"""Covariance of the residuals of a correct model: sensor noise, slowly varying correlated errors, nuisances.

    K = diag(s^2 / n + r^2 / 2) + (l^2 + r^2 / 2) R + q^2 d d' o S + N P N'

with the scatter s of n rows in a bin, the level l of slow errors, the roughness r, the depth level q, and the slope d
of a residual along the camera's depth. The correlation R falls with distance on the fabric and with time. S does the
same over wider parts of an image, because errors of a camera's depth vary slowly, and their effect on a bin depends on
how the cloth faces the ray. N are the slopes along clock, camera, grasp, rim, tare and mesh, and P their variances, so
that these are neither fixed nor free. The mesh counts as a nuisance because the truth may differ from the fine mesh
either way.

Levels of each kind of data and of the depth are estimated by restricted maximum likelihood after all asked slopes are
projected out, so that an effect does not pass as noise. The roughness of a time block is known beforehand (see
``linearise``). Half of it counts as independent and half as correlated, because ripples are neither.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ...errors import InvalidInput
from ..data.binning import BLOCK_NAMES, FORCE_BLOCK, BinnedResiduals, average_groups, time_blocks
from ..decide.criteria import CRITERIA
from .linearise import FINE_MESH_ERROR_FRACTION, Linearisation

MIN_BIN_VARIANCE = 1e-14  # keeps the covariance positive definite where all rows of a bin are equal


class Noise(NamedTuple):
    """Levels of the slow errors.

    Attributes:
        levels: [blocks] standard deviations by kind of data [m, N, N m].
        depth_level: standard deviation of a camera's depth [m].
    """

    levels: Tensor
    depth_level: float = 0.0

    def covariance(
        self,
        bins: BinnedResiduals,
        nuisance_slopes: Tensor,
        nuisance_stds: Tensor,
        parts: CovarianceParts | None = None,
    ) -> Tensor:
        """Return the [B, B] covariance of one episode.

        Args:
            bins: of the episode.
            nuisance_slopes: [B, N] slopes along the nuisances.
            nuisance_stds: [N] standard deviations of the nuisances.
            parts: parts that do not depend on the levels, if known.
        """
        moved, parts = nuisance_slopes * nuisance_stds, parts or CovarianceParts.compute(bins)
        half_roughness = 0.5 * parts.rough_variance
        slow = (self.levels[bins.block] ** 2 + half_roughness).sqrt()
        depth = self.depth_level * bins.depth_slope
        correlated = slow[:, None] * parts.correlation * slow + depth[:, None] * parts.depth_correlation * depth
        return torch.diag(parts.variance + half_roughness) + correlated + moved @ moved.mT

    def smooth_fraction(self, bins: BinnedResiduals) -> Tensor:
        """Return [B] the fraction of the variance that is not roughness."""
        smooth = self.smooth_variance(bins)
        return smooth / (smooth + _rough_variance(bins))

    def smooth_variance(self, bins: BinnedResiduals) -> Tensor:
        """Return [B] the variance without roughness and without nuisances."""
        return _sensor_variance(bins) + self.levels[bins.block] ** 2 + (self.depth_level * bins.depth_slope) ** 2


class CovarianceParts(NamedTuple):
    """Parts of one episode's covariance that do not depend on the levels.

    Attributes:
        variance: [B] variance of the mean by the scatter of rows.
        rough_variance: [B] variance by roughness.
        correlation: [B, B] of slow errors.
        depth_correlation: [B, B] of depth errors.
    """

    variance: Tensor
    rough_variance: Tensor
    correlation: Tensor
    depth_correlation: Tensor

    @staticmethod
    def compute(bins: BinnedResiduals) -> CovarianceParts:
        """Compute the parts of one episode's bins."""
        depth_correlation = _decay(bins, CRITERIA.noise.depth_error_length_m)
        return CovarianceParts(_sensor_variance(bins), _rough_variance(bins), _correlation(bins), depth_correlation)


def minimal_noise() -> Noise:
    """Return the smallest levels, hardly more than the sensor's."""
    criteria = CRITERIA.noise
    levels = torch.tensor([criteria.min_slow_error[name] for name in BLOCK_NAMES], dtype=torch.float64)
    return Noise(levels, criteria.min_depth_error_m)


def inflated_noise() -> Noise:
    """Return the levels to fit by while residuals are mostly model error."""
    levels, depth_level = minimal_noise()
    factor = CRITERIA.noise.fitting_factor
    return Noise(factor * levels, factor * depth_level)


def cap_noise(noise: Noise) -> Noise:
    """Return levels no larger than the inflated ones: residuals of a model that may be wrong are not all noise."""
    cap = inflated_noise()
    return Noise(torch.minimum(noise.levels, cap.levels), min(noise.depth_level, cap.depth_level))


class WhitenedBins(NamedTuple):
    """Bins of all episodes in units in which those of a correct model are independent with variance one.

    Attributes:
        value: [B] residuals.
        jacobian: [B, coordinates + hypotheses] slopes.
        episode: [B] int64, index of the episode.
        log_determinants: [E] of each episode's covariance.
        cholesky_factors: of each episode's covariance.
        time_block: [B] time block, whose bins share a robust weight.
        row_weight: [B] factor by which rows were multiplied after whitening.
    """

    value: Tensor
    jacobian: Tensor
    episode: Tensor
    log_determinants: Tensor
    cholesky_factors: list[Tensor]
    time_block: Tensor
    row_weight: Tensor


def whiten(result: Linearisation, noise: Noise, parts: Sequence[CovarianceParts] | None = None) -> WhitenedBins:
    """Multiply residuals and slopes by the inverse Cholesky factor of every episode's covariance.

    Args:
        result: residuals and slopes.
        noise: levels of the covariance.
        parts: parts of the covariance of each episode, if known.

    Raises:
        InvalidInput: no bin is left.
    """
    if not any(len(bins.value) for bins in result.bins):
        raise _no_bins_error()
    values, slopes, index, log_determinants, factors = [], [], [], [], []
    n_columns = result.n_coordinates + len(result.hypotheses)
    for k, (bins, stds) in enumerate(zip(result.bins, result.nuisance_stds, strict=True)):
        nuisance_slopes = torch.cat([bins.jacobian[:, n_columns:], result.mesh_differences[k][:, None]], 1)
        nuisance_stds = torch.cat([stds, stds.new_tensor([FINE_MESH_ERROR_FRACTION])])
        covariance = noise.covariance(bins, nuisance_slopes, nuisance_stds, parts[k] if parts else None)
        factor = torch.linalg.cholesky(covariance)
        columns = torch.cat([bins.value[:, None], bins.jacobian[:, :n_columns]], 1)
        columns = torch.linalg.solve_triangular(factor, columns, upper=False)
        values.append(columns[:, 0])
        slopes.append(columns[:, 1:])
        index.append(torch.full((len(bins.value),), k))
        log_determinants.append(2 * factor.diagonal().log().sum())
        factors.append(factor)
    value = torch.cat(values)
    return WhitenedBins(
        value=value,
        jacobian=torch.cat(slopes),
        episode=torch.cat(index),
        log_determinants=torch.stack(log_determinants),
        cholesky_factors=factors,
        time_block=time_blocks(result.bins),
        row_weight=torch.ones_like(value),
    )


def fit_noise(result: Linearisation, sweeps: int = 2) -> Noise:
    """Estimate the levels by restricted maximum likelihood, one kind of data after the other on a grid of factors.

    Args:
        result: residuals and slopes; all slopes are projected out.
        sweeps: passes over the kinds of data, the first on a coarse grid, the others on a fine one.
    """
    noise = minimal_noise()
    blocks: list[int | None] = torch.cat([bins.block for bins in result.bins]).unique().tolist()
    if any(bool(bins.depth_slope.any()) for bins in result.bins):
        blocks.append(None)  # the depth level
    else:
        noise = noise._replace(depth_level=0.0)
    parts = [CovarianceParts.compute(bins) for bins in result.bins]
    factors = 10 ** torch.linspace(-0.5, 1.75, 10, dtype=torch.float64)
    for sweep in range(sweeps):
        for b in blocks:
            level = float(noise.depth_level if b is None else noise.levels[b])
            grid = (level * (factors if sweep == 0 else factors[:5] ** 0.3)).tolist()
            noise = max(
                (_with_level(noise, b, v) for v in grid), key=lambda n: _restricted_likelihood(result, n, parts)
            )
    return noise


def _with_level(noise: Noise, block: int | None, value: float) -> Noise:
    """Replace the level of one kind of data; None: of the depth."""
    if block is None:
        return noise._replace(depth_level=value)
    levels = noise.levels.clone()
    levels[block] = value
    return noise._replace(levels=levels)


def _restricted_likelihood(result: Linearisation, noise: Noise, parts: Sequence[CovarianceParts]) -> float:
    whitened = whiten(result, noise, parts)
    scale = whitened.jacobian.norm(dim=0).clamp(min=1e-12)
    u, s, _ = torch.linalg.svd(whitened.jacobian / scale, full_matrices=False)
    has_rank = s > CRITERIA.noise.rank_tolerance * s[0]
    u, s = u[:, has_rank], s[has_rank]
    residual = whitened.value - u @ (u.mT @ whitened.value)
    restriction = 2 * (s.log().sum() + scale.log().sum())
    return float(-0.5 * (whitened.log_determinants.sum() + restriction + residual @ residual))


def _sensor_variance(bins: BinnedResiduals) -> Tensor:
    """Return [B] the variance of each mean by the scatter of its rows, pooled over a kind of data."""
    out = torch.zeros_like(bins.value)
    for b in bins.block.unique():
        is_block = bins.block == b
        out[is_block] = bins.row_std[is_block].square().median() / bins.count[is_block]
    return out + MIN_BIN_VARIANCE


def _rough_variance(bins: BinnedResiduals) -> Tensor:
    """Return [B] the mean square roughness of each time block."""
    return average_groups(time_blocks([bins]), (CRITERIA.noise.roughness_steps * bins.roughness).square())


def _correlation(bins: BinnedResiduals) -> Tensor:
    """Return [B, B] of slow errors: those of one kind and axis, if seen or measured by one gripper, are correlated."""
    same_kind = (bins.block[:, None] == bins.block) & (bins.channel[:, None] % 3 == bins.channel % 3)
    is_position = bins.block < FORCE_BLOCK
    same_sensor = (is_position[:, None] & is_position) | (bins.channel[:, None] == bins.channel)
    return torch.where(same_kind & same_sensor, _decay(bins, CRITERIA.noise.slow_error_length_m), 0.0)


def _decay(bins: BinnedResiduals, length: float) -> Tensor:
    """Return [B, B] from 1 to 0 with distance on the fabric, which is zero between forces, and with time."""
    distance = torch.cdist(bins.rest_position, bins.rest_position).square() / (2 * length**2)
    return torch.exp(-distance - (bins.time[:, None] - bins.time).abs() / CRITERIA.noise.slow_error_time_s)


def compute_noise_floor(result: Linearisation, noise: Noise) -> float:
    """Return the RMS [m] that a correct model leaves of a position bin, without an episode's nuisances.

    Raises:
        InvalidInput: no position bin is left.
    """
    total, count = 0.0, 0
    for bins in result.bins:
        is_position = bins.block < FORCE_BLOCK
        variance = noise.smooth_variance(bins)[is_position]
        total, count = total + float(variance.sum()), count + int(is_position.sum())
    if not count:
        raise _no_bins_error()
    return (total / count) ** 0.5


def _no_bins_error() -> InvalidInput:
    return InvalidInput(
        "episodes",
        got="no part of the cloth whose response is continuous, and the same on the fine mesh",
        expected="some",
        remedy="shorter or slower motions, with more of the cloth in view",
    )
