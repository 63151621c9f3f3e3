"""Uncertainty of shapes that no coarse mode of the corrective force explains, frame by frame.

The residuals of a frame are taken as noise and a smooth random field without the coarse modes, which are the force's.
The field's size is its mean over the likelihood, frame by frame; the noise is that of all frames. The field widens the
standard errors and moves nothing: where it was used to move hidden vertices, these came out worse
(docs/explanation/pose.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from .._utils.linalg import cross, dot
from ..episodes.observed import Episode
from ..identification.residuals.metrics import MAD_TO_STD
from ..losses import find_closest_points
from .modes import Modes

FIELD_STD_GRID_M = torch.cat([torch.zeros(1), torch.logspace(-4, -1.5, 26)])  # standard deviations that are compared


@dataclass(frozen=True)
class FineScaleSettings:
    """How the field of fine shapes is estimated.

    Attributes:
        min_mode_variance: variance of a mode over that of the coarsest one, below which it is left out.
        outlier_stds: standard deviations from which a point is an outlier.
        max_field_stds: largest field that residuals may claim, in standard deviations of the field.
        min_points: number of points, of one frame or of several, that separate a field from noise.
        min_relative_singular_value: below which a constraint of the gripped vertices is dependent.
    """

    min_mode_variance: float = 1e-3
    outlier_stds: float = 5.0
    max_field_stds: float = 2.0
    min_points: int = 20
    min_relative_singular_value: float = 1e-9


FINE_SCALE_SETTINGS = FineScaleSettings()


class _Frame(NamedTuple):
    """Residuals of one frame.

    Attributes:
        rows: [N, J] field at each point, per unit of the field's numbers.
        residual: [N] m, along the surface's normal.
    """

    rows: Tensor
    residual: Tensor


def estimate_fine_scale_std(
    x: Tensor,
    episode: Episode,
    faces: Tensor,
    modes: Modes,
    coarse: int,
    is_gripped: Tensor,
    noise_floor: float,
    default_noise: float,
) -> Tensor:
    """Estimate the root mean square [T, V] m of the field given the residuals.

    It is large where residuals show a field, or where there are none.

    Args:
        x: [T, V, 3] m, the estimate.
        episode: with its clouds.
        faces: [F, 3].
        modes: all modes of the mesh.
        coarse: number of modes of the force.
        is_gripped: [T, V] vertices that are where the grippers are.
        noise_floor: least standard deviation of a point [m].
        default_noise: standard deviation of a point where there are too few to separate it from the field [m].
    """
    grips, grip_of_frame = is_gripped.unique(dim=0, return_inverse=True)
    basis_of_grip = [_build_basis(modes, coarse, grip.nonzero()[:, 0]).to(x) for grip in grips]
    bases = [basis_of_grip[k] for k in grip_of_frame.tolist()]
    frames = [_match_frame(cloud, x[t], faces, bases[t], noise_floor) for t, cloud in enumerate(episode.clouds)]
    noise = max(noise_floor, _estimate_noise(frames) or default_noise)
    sizes = torch.tensor([_estimate_field_std(_neighbouring_frames(frames, t), noise) for t in range(len(frames))])
    sizes = _smooth_sizes(sizes.to(x))
    per_frame = zip(frames, bases, sizes, strict=True)
    return torch.stack([_posterior_rms(frame, size * basis, size, noise) for frame, basis, size in per_frame])


def _posterior_rms(frame: _Frame | None, field: Tensor, size: Tensor, noise: float) -> Tensor:
    """[V] m, of one frame."""
    mean, covariance = field.new_zeros(len(field)), torch.eye(len(field)).to(field)
    if frame is not None:
        rows = size * frame.rows / noise
        covariance = torch.linalg.inv(covariance + rows.mT @ rows)
        mean = covariance @ (rows.mT @ frame.residual) / noise
    squared, prior = (mean @ field).square(), field.square().sum(0)
    # a wrong match would be extrapolated without bounds
    squared = torch.minimum(squared, FINE_SCALE_SETTINGS.max_field_stds**2 * prior)
    return (squared + ((covariance @ field) * field).sum(0)).clamp(min=0).sqrt()


def _build_basis(modes: Modes, coarse: int, gripped: Tensor) -> Tensor:
    """[J, V] fields of a random field of unit mean square that vanishes at the gripped vertices."""
    if coarse >= len(modes.wave_numbers):
        return modes.fields.new_zeros(0, modes.fields.shape[1])
    wave_numbers = modes.wave_numbers[coarse:]
    positive = wave_numbers[wave_numbers > 0]  # 0: constant fields of further pieces
    first = positive.min() if len(positive) else wave_numbers.new_ones(())
    variance = torch.exp(-0.5 * ((wave_numbers / first) ** 2 - 1))  # neighbours agree over half a coarse mode
    is_used = variance > FINE_SCALE_SETTINGS.min_mode_variance
    fields = modes.fields[coarse:][is_used] * variance[is_used].sqrt()[:, None]
    if len(gripped):
        _, sizes, vectors = torch.linalg.svd(fields[:, gripped].mT)
        rank = int((sizes > FINE_SCALE_SETTINGS.min_relative_singular_value * sizes.max()).sum())
        fields = vectors[rank:] @ fields
    return fields / fields.square().sum(0).mean().sqrt()


def _match_frame(cloud: Tensor, x: Tensor, faces: Tensor, basis: Tensor, noise_floor: float) -> _Frame | None:
    if not len(cloud) or not len(basis):
        return None
    hits = find_closest_points(cloud, x, faces)
    a, b, c = x[hits.corners].unbind(1)
    normal = torch.nn.functional.normalize(cross(b - a, c - a), dim=-1)
    residual = dot(normal, cloud - hits.interpolate(x)).squeeze(-1)
    scale = max(noise_floor, MAD_TO_STD * float(residual.abs().median()))
    is_inlier = (residual.abs() < FINE_SCALE_SETTINGS.outlier_stds * scale) & ~hits.is_beyond_edge
    if not bool(is_inlier.any()):
        return None
    rows = (hits.weights.unsqueeze(-1) * basis.mT[hits.corners]).sum(1)
    return _Frame(rows[is_inlier], residual[is_inlier])


def _estimate_noise(frames: list[_Frame | None]) -> float:
    """Standard deviation of a point [m] that no smooth field explains, over all frames; 0 if there are too few."""
    square_sum, degrees_of_freedom = 0.0, 0
    for frame in frames:
        if frame is not None and len(frame.residual) > 2 * frame.rows.shape[1]:
            fit = torch.linalg.lstsq(frame.rows, frame.residual[:, None]).solution
            square_sum += float((frame.residual - (frame.rows @ fit)[:, 0]).square().sum())
            degrees_of_freedom += len(frame.residual) - frame.rows.shape[1]
    return (square_sum / degrees_of_freedom) ** 0.5 if degrees_of_freedom else 0.0


def _neighbouring_frames(frames: list[_Frame | None], t: int) -> list[_Frame]:
    """A frame with as many on both sides as it takes to have enough points; empty if all have too few."""
    for reach in range(len(frames)):
        near = [frame for frame in frames[max(0, t - reach) : t + reach + 1] if frame is not None]
        if sum(len(frame.residual) for frame in near) >= FINE_SCALE_SETTINGS.min_points:
            return near
    return []


def _estimate_field_std(frames: list[_Frame], noise: float) -> float:
    """Root mean square of the field's standard deviation over its likelihood [m]; NaN without data."""
    if not frames:
        return torch.nan
    grid = FIELD_STD_GRID_M.to(frames[0].residual)
    log_likelihood = torch.zeros_like(grid)
    for frame in frames:
        values, vectors = torch.linalg.eigh(frame.rows.mT @ frame.rows)
        values = values.clamp(min=1e-12)
        along = (vectors.mT @ (frame.rows.mT @ frame.residual)).square() / values  # squared residual by direction
        variance = grid[:, None] ** 2 * values + noise**2
        log_likelihood -= 0.5 * (variance.log() + along / variance).sum(1)
    squared = float((torch.softmax(log_likelihood, 0) * grid**2).sum())
    mean_square = float(torch.cat([frame.residual for frame in frames]).square().mean())
    return min(squared, mean_square) ** 0.5  # sparse points do not bound it


def _smooth_sizes(size: Tensor) -> Tensor:
    """Root mean square over three frames; a frame without data has the mean of all."""
    is_known = size.isfinite()
    if not bool(is_known.any()):
        return torch.zeros_like(size)
    squared = torch.where(is_known, size.square(), size[is_known].square().mean())
    padded = torch.cat([squared[:1], squared, squared[-1:]])
    return padded.unfold(0, 3, 1).mean(-1).sqrt()
