"""How residuals of a true model err together: sensor, slow errors, and what differs from episode to episode.

    K = diag(spread^2 / n + r^2 / 2) + (level^2 + r^2 / 2) R + depth^2 d d' o S + N P N',  r = ROUGH rough

R falls with distance on the fabric and with time, and so does S, over wider parts of an image: a camera's depths err
slowly and together, and what that does to a cell depends on how the cloth faces the ray (d). N are the slopes along
clock, camera, grasp, rim, tare and mesh (the difference between two, of which the truth may have more or less), and P
their variances, so that these are neither fixed nor free. The levels, one for each kind of data, and the depths' come
from restricted maximum likelihood after everything that is asked about is projected out: an effect must not pass as
noise. How rough a stretch of time is (``evidence.gather``) is known beforehand; ripples neither agree with their
neighbours nor do they not.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ...errors import InvalidInput
from ..data.binning import BLOCK_NAMES, FORCE_BLOCK, BinnedResiduals, average_groups, time_blocks
from .linearise import FINE_MESH_ERROR_FRACTION, Linearisation

REACH, MEMORY = 0.1, 0.3  # m, s, over which slow errors agree
ACROSS = 0.3  # m, over which those of a camera's depths do
FLOOR = {"points": 1e-4, "edges": 3e-4, "markers": 1e-4, "force": 5e-3, "torque": 5e-4}  # m, N, N m: of one cell
DEPTH = 1e-4  # m, least slow error of depths
UNFITTED = 5.0  # slow errors over their least size, to fit by: those of a model that is wrong yet say nothing
ROUGH = 3.0  # steps along every parameter by which two engines' cloths may differ in effect
RANK = 1e-9  # relative, of directions that count in the likelihood


class Noise(NamedTuple):
    """Levels of slow errors by kind of data, and of a camera's depths."""

    levels: Tensor  # [blocks], in the data's units
    depth_level: float = 0.0  # m

    def covariance(self, cells: BinnedResiduals, nuisance: Tensor, std: Tensor, parts: CovarianceParts | None = None) -> Tensor:
        """[C, C] of one episode; ``nuisance`` [C, N] slopes, ``std`` [N], ``parts`` of these cells if known."""
        moved, known = nuisance * std, parts or CovarianceParts.compute(cells)
        rough = 0.5 * known.rough_variance
        slow = (self.levels[cells.block] ** 2 + rough).sqrt()
        deep = self.depth_level * cells.depth_slope
        agreed = slow[:, None] * known.correlation * slow + deep[:, None] * known.depth_correlation * deep
        return torch.diag(known.variance + rough) + agreed + moved @ moved.mT

    def smooth_fraction(self, cells: BinnedResiduals) -> Tensor:
        """[C] share of the variance that is no roughness."""
        smooth_variance = self.smooth_variance(cells)
        return smooth_variance / (smooth_variance + _rough(cells))

    def smooth_variance(self, cells: BinnedResiduals) -> Tensor:
        """[C] the other variance, but for what differs from episode to episode."""
        return _white(cells) + self.levels[cells.block] ** 2 + (self.depth_level * cells.depth_slope) ** 2


class CovarianceParts(NamedTuple):
    """Of one episode's covariance, what no level changes."""

    variance: Tensor  # [C]
    rough_variance: Tensor  # [C]
    correlation: Tensor  # [C, C]
    depth_correlation: Tensor  # [C, C]

    @staticmethod
    def compute(cells: BinnedResiduals) -> CovarianceParts:
        """Computed."""
        return CovarianceParts(_white(cells), _rough(cells), _together(cells), _fading(cells, ACROSS))


def minimal_noise() -> Noise:
    """The sensor's and hardly more."""
    return Noise(torch.tensor([FLOOR[name] for name in BLOCK_NAMES], dtype=torch.float64), DEPTH)


def inflated_noise() -> Noise:
    """To fit by, where residuals are mostly the model's."""
    level, depth = minimal_noise()
    return Noise(UNFITTED * level, UNFITTED * depth)


def cap_noise(noise: Noise) -> Noise:
    """The smaller levels of these and of ``unfitted``: what a model leaves that may be wrong is not all noise."""
    most = inflated_noise()
    return Noise(torch.minimum(noise.levels, most.levels), min(noise.depth_level, most.depth_level))


class WhitenedBins(NamedTuple):
    """All episodes' cells in units in which a true model's are independent and of variance one."""

    value: Tensor  # [C]
    jacobian: Tensor  # [C, own + hypotheses]
    episode: Tensor  # [C] int64
    log_determinants: Tensor  # [E], of each covariance
    cholesky_factors: list[Tensor]  # Cholesky factors
    time_block: Tensor  # [C] of time, whose cells err together
    row_weight: Tensor  # [C] by which rows were multiplied beyond that


def whiten(evidence: Linearisation, noise: Noise, parts: Sequence[CovarianceParts] | None = None) -> WhitenedBins:
    """Cells and slopes by the inverse Cholesky factor of every episode's covariance; ``parts`` of it, if known.

    Raises:
        InvalidInput: no cell is left.
    """
    if not any(len(cells.value) for cells in evidence.bins):
        raise _nothing_left()
    values, slopes, index, logs, roots = [], [], [], [], []
    count = evidence.n_coordinates + len(evidence.hypotheses)
    for k, (cells, std) in enumerate(zip(evidence.bins, evidence.nuisance_stds, strict=True)):
        nuisance = torch.cat([cells.jacobian[:, count:], evidence.mesh_differences[k][:, None]], 1)
        stds = torch.cat([std, std.new_tensor([FINE_MESH_ERROR_FRACTION])])
        root = torch.linalg.cholesky(noise.covariance(cells, nuisance, stds, parts[k] if parts else None))
        both = torch.cat([cells.value[:, None], cells.jacobian[:, :count]], 1)
        both = torch.linalg.solve_triangular(root, both, upper=False)
        values.append(both[:, 0])
        slopes.append(both[:, 1:])
        index.append(torch.full((len(cells.value),), k))
        logs.append(2 * root.diagonal().log().sum())
        roots.append(root)
    value, log, stretch = torch.cat(values), torch.stack(logs), time_blocks(evidence.bins)
    return WhitenedBins(value, torch.cat(slopes), torch.cat(index), log, roots, stretch, torch.ones_like(value))


def fit_noise(evidence: Linearisation, sweeps: int = 2) -> Noise:
    """Levels by restricted maximum likelihood, one kind of data after the other on a grid of factors."""
    found = minimal_noise()
    present = torch.cat([c.block for c in evidence.bins]).unique().tolist()
    if any(bool(c.depth_slope.any()) for c in evidence.bins):
        present.append(None)
    else:
        found = found._replace(depth=0.0)
    parts = [CovarianceParts.compute(cells) for cells in evidence.bins]
    factors = 10 ** torch.linspace(-0.5, 1.75, 10, dtype=torch.float64)
    for sweep in range(sweeps):
        for b in present:
            own = float(found.depth_level if b is None else found.levels[b])
            tried = (own * (factors if sweep == 0 else factors[:5] ** 0.3)).tolist()
            found = max((_with(found, b, v) for v in tried), key=lambda n: _likelihood(evidence, n, parts))
    return found


def _with(noise: Noise, block: int | None, value: float) -> Noise:
    """With another level of one kind of data; None: of depths."""
    if block is None:
        return noise._replace(depth=value)
    level = noise.levels.clone()
    level[block] = value
    return noise._replace(level=level)


def _likelihood(evidence: Linearisation, noise: Noise, parts: Sequence[CovarianceParts]) -> float:
    """Restricted log-likelihood, all that is asked about projected out."""
    found = whiten(evidence, noise, parts)
    scale = found.jacobian.norm(dim=0).clamp(min=1e-12)
    u, s, _ = torch.linalg.svd(found.jacobian / scale, full_matrices=False)
    u, s = u[:, s > RANK * s[0]], s[s > RANK * s[0]]
    left = found.value - u @ (u.mT @ found.value)
    restricted = 2 * (s.log().sum() + scale.log().sum())
    return float(-0.5 * (found.log_determinants.sum() + restricted + left @ left))


def _white(cells: BinnedResiduals) -> Tensor:
    """[C] variance of each mean by what rows of a cell differ by, pooled over a kind of data."""
    out = torch.zeros_like(cells.value)
    for b in cells.block.unique():
        own = cells.block == b
        out[own] = cells.row_std[own].square().median() / cells.count[own]
    return out + 1e-14


def _rough(cells: BinnedResiduals) -> Tensor:
    """[C] mean square over each stretch."""
    return average_groups(time_blocks([cells]), (ROUGH * cells.roughness).square())


def _together(cells: BinnedResiduals) -> Tensor:
    """[C, C] correlation of slow errors: of one kind and axis, all that is seen or what one gripper feels."""
    same = (cells.block[:, None] == cells.block) & (cells.channel[:, None] % 3 == cells.channel % 3)
    seen = cells.block < FORCE_BLOCK
    alike = (seen[:, None] & seen) | (cells.channel[:, None] == cells.channel)
    return torch.where(same & alike, _fading(cells, REACH), 0.0)


def _fading(cells: BinnedResiduals, reach: float) -> Tensor:
    """[C, C] from 1 towards 0 with distance on the fabric, of which what is felt has none, and with time."""
    where = torch.cdist(cells.rest_position, cells.rest_position).square() / (2 * reach**2)
    return torch.exp(-where - (cells.time[:, None] - cells.time).abs() / MEMORY)


def compute_noise_floor(evidence: Linearisation, noise: Noise) -> float:
    """RMS [m] of a position cell that a true model would leave, once an episode's nuisances are taken out."""
    total, count = 0.0, 0
    for cells in evidence.bins:
        own = cells.block < FORCE_BLOCK
        variance = noise.smooth_variance(cells)[own]
        total, count = total + float(variance.sum()), count + int(own.sum())
    if not count:
        raise _nothing_left()
    return (total / count) ** 0.5


def _nothing_left() -> InvalidInput:
    return InvalidInput(
        "episodes",
        got="no place on the cloth that finer and coarser meshes and neighbouring values find alike",
        expected="some",
        remedy="shorter or slower motions, with more of the cloth in view",
    )
