"""What no force of the coarse modes explains: how far the cloth is off its estimate, frame by frame.

The residuals of a frame are taken as noise and a smooth random field without the coarse modes, those being the forces'.
Its size is the mean over its likelihood, frame by frame; the noise is that of all frames. The field widens the standard
errors and moves nothing: moved by it, hidden vertices came out worse where it was tried (docs/pose.md).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from .._utils.linalg import cross, dot
from ..episodes.observed import Episode
from ..losses import closest
from .modes import Modes

FAINT = 1e-3  # of the coarsest field's variance, below which finer ones are left out
SIZES = torch.cat([torch.zeros(1), torch.logspace(-4, -1.5, 26)])  # m, standard deviations that are tried
OUTLIER = 5.0  # standard deviations
FARTHEST = 2.0  # standard deviations of the field that residuals may claim
FEWEST = 20  # points that tell a field from noise: of a frame, or of several


class _Frame(NamedTuple):
    rows: Tensor  # [N, J] field at each point per unit of the field's numbers
    value: Tensor  # [N] m


def unexplained(
    x: Tensor, episode: Episode, faces: Tensor, modes: Modes, coarse: int, held: Tensor, noise: float, usual: float
) -> Tensor:
    """[T, V] m, root mean square of the field given the residuals: large where they show it, or where none are.

    Args:
        x: [T, V, 3] m, the estimate.
        episode: its clouds.
        faces: [F, 3].
        modes: all of the mesh.
        coarse: how many of them are the forces'.
        held: [T, V] vertices that lie where the grippers are.
        noise: least standard deviation of a point [m].
        usual: what it is taken for [m] where points are too few to tell it from the field.
    """
    kinds, which = held.unique(dim=0, return_inverse=True)
    of_kind = [_basis(modes, coarse, kind.nonzero()[:, 0]).to(x) for kind in kinds]
    bases = [of_kind[k] for k in which.tolist()]
    frames = [_rows(cloud, x[t], faces, bases[t], noise) for t, cloud in enumerate(episode.clouds)]
    noise = max(noise, _noise(frames) or usual)
    sizes = _smoothed(torch.tensor([_size(_around(frames, t), noise) for t in range(len(frames))]).to(x))
    each = zip(frames, bases, sizes, strict=True)
    return torch.stack([_left(frame, size * basis, size, noise) for frame, basis, size in each])


def _left(frame: _Frame | None, field: Tensor, size: Tensor, noise: float) -> Tensor:
    """[V] m, of one frame."""
    mean, covariance = field.new_zeros(len(field)), torch.eye(len(field)).to(field)
    if frame is not None:
        rows = size * frame.rows / noise
        covariance = torch.linalg.inv(covariance + rows.mT @ rows)
        mean = covariance @ (rows.mT @ frame.value) / noise
    squared, prior = (mean @ field).square(), field.square().sum(0)
    squared = torch.minimum(squared, FARTHEST**2 * prior)  # a wrong match is extrapolated without bounds
    return (squared + ((covariance @ field) * field).sum(0)).clamp(min=0).sqrt()


def _basis(modes: Modes, coarse: int, held: Tensor) -> Tensor:
    """[J, V] fields of a random field of unit mean square that vanishes where the cloth is held."""
    if coarse >= len(modes.wave):
        return modes.fields.new_zeros(0, modes.fields.shape[1])
    wave = modes.wave[coarse:]
    first = (
        wave[wave > 0].min() if bool((wave > 0).any()) else wave.new_ones(())
    )  # 0: constant fields of further pieces
    weight = torch.exp(-0.5 * ((wave / first) ** 2 - 1))  # neighbours agree over half a coarse mode
    kept = weight > FAINT
    fields = modes.fields[coarse:][kept] * weight[kept].sqrt()[:, None]
    if len(held):
        _, sizes, vectors = torch.linalg.svd(fields[:, held].mT)
        rank = int((sizes > 1e-9 * sizes.max()).sum())
        fields = vectors[rank:] @ fields
    return fields / fields.square().sum(0).mean().sqrt()


def _rows(cloud: Tensor, x: Tensor, faces: Tensor, basis: Tensor, noise: float) -> _Frame | None:
    if not len(cloud) or not len(basis):
        return None
    hits = closest(cloud, x, faces)
    a, b, c = x[hits.corners].unbind(1)
    normal = torch.nn.functional.normalize(cross(b - a, c - a), dim=-1)
    value = dot(normal, cloud - hits.on(x)).squeeze(-1)
    spread = max(noise, 1.4826 * float(value.abs().median()))
    good = (value.abs() < OUTLIER * spread) & ~hits.beyond
    if not bool(good.any()):
        return None
    rows = (hits.weights.unsqueeze(-1) * basis.mT[hits.corners]).sum(1)
    return _Frame(rows[good], value[good])


def _noise(frames: list[_Frame | None]) -> float:
    """Of a point [m]: what no smooth field explains, over all frames."""
    left, freedom = 0.0, 0
    for frame in frames:
        if frame is not None and len(frame.value) > 2 * frame.rows.shape[1]:
            fit = torch.linalg.lstsq(frame.rows, frame.value[:, None]).solution
            left += float((frame.value - (frame.rows @ fit)[:, 0]).square().sum())
            freedom += len(frame.value) - frame.rows.shape[1]
    return (left / freedom) ** 0.5 if freedom else 0.0


def _around(frames: list[_Frame | None], t: int) -> list[_Frame]:
    """A frame, with as many on both sides as it takes to have enough points; none where all have too few."""
    for reach in range(len(frames)):
        near = [frame for frame in frames[max(0, t - reach) : t + reach + 1] if frame is not None]
        if sum(len(frame.value) for frame in near) >= FEWEST:
            return near
    return []


def _size(frames: list[_Frame], noise: float) -> float:
    """Root mean square of the field's standard deviation over its likelihood [m]; NaN where nothing tells it."""
    if not frames:
        return torch.nan
    sizes = SIZES.to(frames[0].value)
    likely = torch.zeros_like(sizes)
    for frame in frames:
        values, vectors = torch.linalg.eigh(frame.rows.mT @ frame.rows)
        values = values.clamp(min=1e-12)
        along = (vectors.mT @ (frame.rows.mT @ frame.value)).square() / values  # squared residual along each direction
        variance = sizes[:, None] ** 2 * values + noise**2
        likely -= 0.5 * (variance.log() + along / variance).sum(1)
    squared = float((torch.softmax(likely, 0) * sizes**2).sum())
    most = float(torch.cat([frame.value for frame in frames]).square().mean())
    return min(squared, most) ** 0.5  # sparse points leave it open upwards


def _smoothed(size: Tensor) -> Tensor:
    """Root mean square over three frames; what nothing tells is the mean of all."""
    known = size.isfinite()
    if not bool(known.any()):
        return torch.zeros_like(size)
    squared = torch.where(known, size.square(), size[known].square().mean())
    padded = torch.cat([squared[:1], squared, squared[-1:]])
    return padded.unfold(0, 3, 1).mean(-1).sqrt()
