"""Predictions of held-out motions, and the comparison of two models by them.

Each group of motions is predicted by what the others determine: the solution of all data moves by one linear step to
the solution of the others, and the prediction moves with it. The uncertainty of the others is part of the prediction:
its covariance is K + J C J', with the covariance C of the model's coordinates by the others. Of a predicted episode
only its nuisances, within their priors, and the coordinates, within C, are adjusted.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..data.binning import FORCE_BLOCK, align_rows
from ..decide.criteria import CRITERIA
from .fitting import ModelFit, gauss_newton_step, posterior_precision
from .noise import WhitenedBins
from .robust_weights import remove_weights, t_log_density, t_weights

EPISODE_KEY_SPACING = 10**9  # between the bin keys of two episodes
EPISODE_BLOCK_SPACING = 1000  # between the resampled blocks of two episodes
FORCE_NORM_FACTOR = 3**0.5  # from the RMS of one component to that of a force: a force has three bins


class HeldOutPrediction(NamedTuple):
    """Held-out residuals of one model, in B bins of all episodes.

    Attributes:
        residual: [B] predicted from the other motions, less what nuisances and uncertain coordinates explain [m, N, N
            m].
        whitened: [B] the same, whitened.
        log_scale: [B] logarithm of the divisor of ``whitened`` beyond the noise.
        key: [B] key of the bin within its episode.
        episode: [B] index of the episode.
        window: [B] time window.
        time_block: [B] time block.
        block: [B] kind of data, as an index of ``BLOCK_NAMES``.
        smooth_fraction: [B] fraction of the noise's variance that is not roughness.
    """

    residual: Tensor
    whitened: Tensor
    log_scale: Tensor
    key: Tensor
    episode: Tensor
    window: Tensor
    time_block: Tensor
    block: Tensor
    smooth_fraction: Tensor

    @property
    def bin_key(self) -> Tensor:
        """[B] identifier of a bin among all episodes, the same in all models."""
        return self.episode * EPISODE_KEY_SPACING + self.key

    @property
    def is_position(self) -> Tensor:
        """[B] bool, a position and not a force or torque."""
        return self.block < FORCE_BLOCK


class Gain(NamedTuple):
    """Gain of a second model over a first one on held-out motions.

    Attributes:
        rms_before: RMS of the position residuals of the first model [m]; NaN if no positions were observed.
        rms_after: the same of the second model [m].
        log_density: log predictive density, second minus first.
        log_density_ci95: 95 % interval of that difference.
        explained_fraction: fraction of rms_before^2 - floor^2 that is removed, from -1 to 1.
        explained_fraction_ci95: 95 % interval of that fraction.
        robust_rms: RMS of positions before and after [m], with small weights where neither model describes the data and
            where cloth ripples.
        rms_removed: RMS of positions [m] and of forces [N] that is removed in the episode where most is, with the same
            weights.
        lower_bound_95: one-sided 95 % bound of the gain in log density.
        small_sample_episodes: number of episodes if it is so small that the interval of the fraction was doubled; else
            0.
    """

    rms_before: float
    rms_after: float
    log_density: float
    log_density_ci95: tuple[float, float]
    explained_fraction: float
    explained_fraction_ci95: tuple[float, float]
    robust_rms: tuple[float, float]
    rms_removed: tuple[float, float]
    lower_bound_95: float
    small_sample_episodes: int = 0

    @property
    def mean_square_removed(self) -> float:
        """Decrease of the square of ``robust_rms`` [m^2]."""
        return self.robust_rms[0] ** 2 - self.robust_rms[1] ** 2


def list_observed_motions(episode: Tensor, motions: Sequence[str]) -> list[str]:
    """Return the motions of the episodes that have bins.

    Args:
        episode: [B] index of each bin's episode.
        motions: label of each episode.
    """
    observed = set(episode.tolist())
    return [motion for k, motion in enumerate(motions) if k in observed]


def has_held_out_motions(episode: Tensor, motions: Sequence[str]) -> bool:
    """Check whether one motion can be held out while another one is fitted; arguments as ``list_observed_motions``."""
    return len(set(list_observed_motions(episode, motions))) > 1


def predict_held_out(fitted: ModelFit, motions: Sequence[str], halved: Collection[str] = ()) -> HeldOutPrediction:
    """Predict every episode while its motion is left out of the fit.

    Args:
        fitted: a model at its solution.
        motions: label of each episode; episodes with one label are left out together.
        halved: motions of which every other block of time windows is left out instead, and then the others. If one
            motion alone informs about a cause, no other one can say how large it is.
    """
    return _assemble_prediction(fitted, *_predict_all(fitted, motions, halved))


def held_out_log_density(fitted: ModelFit, motions: Sequence[str], halved: Collection[str] = ()) -> float:
    """Compute the log density of ``predict_held_out``, up to a constant that is the same for all models."""
    _, whitened, log_scale = _predict_all(fitted, motions, halved)
    return float(t_log_density(whitened, fitted.whitened.time_block).sum() - log_scale.sum())


def _predict_all(fitted: ModelFit, motions: Sequence[str], halved: Collection[str]) -> tuple[Tensor, Tensor, Tensor]:
    """Return K^-1 r of all bins, the whitened residuals, and the logarithms of their scale."""
    solved, whitened, log_scale = (torch.zeros_like(fitted.whitened.value) for _ in range(3))
    plain = remove_weights(fitted.whitened)
    for inside in _list_folds(fitted, motions, halved):
        solved[inside], whitened[inside], log_scale[inside] = _predict_fold(fitted, plain, inside)
    return solved, whitened, log_scale


def _predict_fold(fitted: ModelFit, plain: WhitenedBins, inside: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Predict bins ``inside`` by a fit to the others."""
    others = _select_outside(fitted, inside)
    step = gauss_newton_step(others, fitted.model)[0]
    covariance = torch.linalg.inv(posterior_precision(others, fitted.model))
    slopes = plain.jacobian[inside][:, : fitted.linearisation.n_coordinates]
    value = plain.value[inside] + slopes @ step
    factor = torch.linalg.cholesky(torch.eye(len(value)).to(slopes) + slopes @ covariance @ slopes.mT)
    whitened = torch.linalg.solve_triangular(factor, value[:, None], upper=False)
    solved = torch.linalg.solve_triangular(factor.mT, whitened, upper=True)
    return solved[:, 0], whitened[:, 0], factor.diagonal().log()


def jackknife(fitted: ModelFit, motions: Sequence[str], halved: Collection[str] = ()) -> tuple[Tensor, Tensor]:
    """Compute the jackknife over motions of the model's coordinates.

    Motions that disagree about a number show by how much a law differs from the model's. Noise within a motion does
    not.

    Args:
        fitted: a model at its solution.
        motions: label of each episode.
        halved: as in ``predict_held_out``.

    Returns:
        [P + A] the mean of the coordinates without one motion after the other, and [P + A] their standard errors.
    """
    folds = _list_folds(fitted, motions, halved)
    steps = torch.stack([gauss_newton_step(_select_outside(fitted, inside), fitted.model)[0] for inside in folds])
    std = ((len(steps) - 1) * (steps - steps.mean(0)).square().mean(0)).sqrt()
    return fitted.model.point + steps.mean(0), std


def _select_outside(fitted: ModelFit, inside: Tensor) -> WhitenedBins:
    whitened = fitted.whitened
    return whitened._replace(value=whitened.value[~inside], jacobian=whitened.jacobian[~inside])


def predict_as_given(fitted: ModelFit) -> HeldOutPrediction:
    """Predict every episode by a model that was not fitted to any of them."""
    whitened = remove_weights(fitted.whitened).value
    return _assemble_prediction(fitted, whitened, whitened, torch.zeros_like(whitened))


def select_episodes(prediction: HeldOutPrediction, episodes: Sequence[int]) -> HeldOutPrediction:
    """Return the prediction of these episodes alone."""
    selected = torch.isin(prediction.episode, torch.as_tensor(episodes))
    return HeldOutPrediction(*(column[selected] for column in prediction))


def _assemble_prediction(fitted: ModelFit, solved: Tensor, whitened: Tensor, log_scale: Tensor) -> HeldOutPrediction:
    episodes, episode = fitted.linearisation.bins, fitted.whitened.episode
    return HeldOutPrediction(
        residual=torch.cat([_remove_nuisances(fitted, k, solved[episode == k]) for k in range(len(episodes))]),
        whitened=whitened,
        log_scale=log_scale,
        key=torch.cat([bins.key for bins in episodes]),
        episode=episode,
        window=torch.cat([bins.window for bins in episodes]),
        time_block=fitted.whitened.time_block,
        block=torch.cat([bins.block for bins in episodes]),
        smooth_fraction=torch.cat([fitted.noise.smooth_fraction(bins) for bins in episodes]),
    )


def _list_folds(fitted: ModelFit, motions: Sequence[str], halved: Collection[str]) -> list[Tensor]:
    """Return [B] bool for each group of bins that is left out together; empty groups are dropped."""
    motion_index = _index_motions(fitted, motions)
    window = torch.cat([bins.window for bins in fitted.linearisation.bins])
    is_odd = window // CRITERIA.held_out.bins_per_block % 2 == 1
    folds = []
    for k, motion in enumerate(sorted(set(motions))):
        inside = motion_index == k
        folds += [inside & is_odd, inside & ~is_odd] if motion in halved else [inside]
    return [inside for inside in folds if bool(inside.any())]


def _index_motions(fitted: ModelFit, motions: Sequence[str]) -> Tensor:
    """Return [B] the index of each bin's motion among the sorted ones."""
    order = {motion: k for k, motion in enumerate(sorted(set(motions)))}
    return torch.tensor([order[motion] for motion in motions])[fitted.whitened.episode]


def find_sole_informative_motion(fitted: ModelFit, motions: Sequence[str]) -> set[str]:
    """Return the motion that alone informs about the last accepted cause; empty in most cases.

    Args:
        fitted: a model with the cause.
        motions: label of each episode.
    """
    information = _information_by_bin(fitted, fitted.linearisation.n_coordinates - 1)
    motion_index = _index_motions(fitted, motions)
    by_motion = torch.stack([information[motion_index == k].sum() for k in range(len(set(motions)))])
    fraction = by_motion / information.sum().clamp(min=1e-30)
    if float(fraction.max()) <= CRITERIA.held_out.sole_motion_information:
        return set()
    return {sorted(set(motions))[int(fraction.argmax())]}


def count_effective_motions(
    fitted: ModelFit, coordinate: int, motions: Sequence[str], halved: Collection[str] = ()
) -> float:
    """Compute the effective number of motions that inform about a coordinate.

    It is the number of equally informative motions with the same information. It is one more than Satterthwaite's
    degrees of freedom of a mean with unequal weights.

    Args:
        fitted: a model at its solution.
        coordinate: index of the coordinate.
        motions: label of each episode.
        halved: as in ``predict_held_out``.
    """
    information = _information_by_bin(fitted, coordinate)
    by_fold = torch.stack([information[inside].sum() for inside in _list_folds(fitted, motions, halved)])
    return float(by_fold.sum() ** 2 / by_fold.square().sum().clamp(min=1e-60))


def _information_by_bin(fitted: ModelFit, coordinate: int) -> Tensor:
    """Return [B] the information on a coordinate beyond the others, within their priors.

    It is the part of its slopes that the others do not have, computed from a column of the covariance. Least squares on
    the rows would give the same up to the last bits, which depend on memory alignment, and a resumed diagnosis would
    differ.
    """
    column = torch.linalg.inv(posterior_precision(fitted.whitened, fitted.model))[:, coordinate]
    return (fitted.whitened.jacobian[:, : len(column)] @ (column / column[coordinate])).square()


def _remove_nuisances(fitted: ModelFit, k: int, solved: Tensor) -> Tensor:
    """Return [B_k] residuals less the most likely nuisances: S K^-1 r, with the covariance S without nuisances."""
    bins, none = fitted.linearisation.bins[k], torch.zeros(0, dtype=solved.dtype)
    covariance = fitted.noise.covariance(bins, bins.jacobian[:, :0], none)
    factor = fitted.whitened.cholesky_factors[k]
    return covariance @ torch.linalg.solve_triangular(factor.mT, solved[:, None], upper=True)[:, 0]


def compare(first: HeldOutPrediction, second: HeldOutPrediction, floor: float, seed: int = 0) -> Gain:
    """Compare the predictions of two models on their common bins.

    Intervals come from a bootstrap over blocks of time. Without common bins there is no gain.

    Args:
        first: prediction of the model without a change.
        second: prediction of the model with it.
        floor: noise floor of a position bin [m].
        seed: of the bootstrap.
    """
    criteria = CRITERIA.held_out
    one, two = _select_common_bins(first, second)
    if not len(one.residual):
        return Gain(np.nan, np.nan, 0.0, (0.0, 0.0), 0.0, (0.0, 0.0), (0.0, 0.0), (0.0, 0.0), -np.inf)

    # log density and squares by block of time, and their bootstrap
    owner, density, squares = _sum_by_block(one, two)
    draws = _resample_blocks(owner, np.random.default_rng(seed))
    densities = draws @ density
    fractions = np.array([_explained_fraction(row, floor) for row in draws @ squares])
    before, after, n = squares.sum(0)
    density_low, density_high = (float(np.quantile(densities, q)) for q in (0.025, 0.975))
    total, fraction = float(density.sum()), _explained_fraction(squares.sum(0), floor)

    # few episodes hardly show their own scatter
    episodes = len(set(owner.tolist()))
    small_sample = episodes if episodes < criteria.min_episodes else 0
    factor = criteria.small_sample_factor if small_sample else 1.0
    ends = (fraction + factor * (float(np.quantile(fractions, q)) - fraction) for q in (0.025, 0.975))
    fraction_low, fraction_high = (min(max(end, -1.0), 1.0) for end in ends)

    # what is removed where a model describes the data
    weight = one.smooth_fraction * torch.maximum(*(t_weights(p.whitened, p.time_block) for p in (one, two)))
    position_weight, force_weight = weight * one.is_position, weight * (one.block == FORCE_BLOCK)
    lower_bound = float(np.quantile(densities, 0.05)) if (draws != 1).any() else -np.inf  # single blocks do not scatter
    return Gain(
        rms_before=(before / n) ** 0.5 if n else np.nan,
        rms_after=(after / n) ** 0.5 if n else np.nan,
        log_density=total,
        log_density_ci95=(density_low, density_high),
        explained_fraction=fraction,
        explained_fraction_ci95=(fraction_low, fraction_high),
        robust_rms=_weighted_rms(one, two, position_weight),
        rms_removed=(
            _max_rms_removed(one, two, position_weight),
            FORCE_NORM_FACTOR * _max_rms_removed(one, two, force_weight),
        ),
        lower_bound_95=lower_bound,
        small_sample_episodes=small_sample,
    )


def compare_by_motion(
    first: HeldOutPrediction, second: HeldOutPrediction, floor: float, motions: Sequence[str]
) -> dict[str, Gain]:
    """Compare the predictions of two models for each motion; ``motions`` labels the episodes."""
    episodes = {motion: [k for k, other in enumerate(motions) if other == motion] for motion in dict.fromkeys(motions)}
    return {
        motion: compare(select_episodes(first, index), select_episodes(second, index), floor)
        for motion, index in episodes.items()
    }


def _explained_fraction(squares: np.ndarray, floor: float) -> float:
    before, after, n = squares
    removed = before - after
    return float(removed / max(before - n * floor**2, abs(removed), 1e-30))  # near the floor little can be gained


def _select_common_bins(
    first: HeldOutPrediction, second: HeldOutPrediction
) -> tuple[HeldOutPrediction, HeldOutPrediction]:
    """Return both on common bins, in one order and with the same time blocks."""
    is_common = torch.isin(first.bin_key, second.bin_key)
    one = HeldOutPrediction(*(column[is_common] for column in first))
    one = one._replace(time_block=one.time_block.unique(return_inverse=True)[1])
    columns = torch.stack([second.residual, second.whitened, second.log_scale], 1)
    residual, whitened, log_scale = align_rows(one.bin_key, second.bin_key, columns).unbind(1)
    return one, one._replace(residual=residual, whitened=whitened, log_scale=log_scale)


def _sum_by_block(one: HeldOutPrediction, two: HeldOutPrediction) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return episode [K], difference of log density [K], and squares before, after and count of positions [K, 3]."""
    density = t_log_density(two.whitened, one.time_block) - t_log_density(one.whitened, one.time_block)
    density = density[one.time_block] / torch.bincount(one.time_block)[one.time_block] + one.log_scale - two.log_scale
    is_position = one.is_position.double()
    squares = torch.stack([is_position * one.residual**2, is_position * two.residual**2, is_position], 1)
    label = one.episode * EPISODE_BLOCK_SPACING + one.window // CRITERIA.held_out.bins_per_block
    block, index = label.unique(return_inverse=True)

    def add(rows: Tensor) -> np.ndarray:
        return torch.zeros(len(block), *rows.shape[1:]).to(rows).index_add(0, index, rows).numpy()

    return (block // EPISODE_BLOCK_SPACING).numpy(), add(density), add(squares)


def _weighted_rms(one: HeldOutPrediction, two: HeldOutPrediction, weight: Tensor) -> tuple[float, float]:
    def rms(prediction: HeldOutPrediction) -> float:
        return float((weight * prediction.residual**2).sum() / weight.sum().clamp(min=1e-12)) ** 0.5

    return rms(one), rms(two)


def _max_rms_removed(one: HeldOutPrediction, two: HeldOutPrediction, weight: Tensor) -> float:
    """Return the RMS that is removed in the episode where most is: others need not show the cause."""
    by_episode = (_weighted_rms(one, two, weight * (one.episode == e)) for e in one.episode.unique())
    return max(0.0, *(before**2 - after**2 for before, after in by_episode)) ** 0.5


def _resample_blocks(owner: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return [draws, K] the weight of each block; an episode's blocks are drawn with replacement.

    Sums of m blocks drawn from m vary by (m - 1) / m of the true variance, for which the weights make up. A single
    block has weight 1. Episodes are not resampled: they are different motions, of which one may be the only informative
    one.
    """
    draws = CRITERIA.held_out.bootstrap_draws
    out = np.ones((draws, len(owner)))
    for e in np.unique(owner):
        m = int((owner == e).sum())
        if m > 1:
            counts = rng.multinomial(m, np.full(m, 1 / m), draws)
            out[:, owner == e] += (m / (m - 1)) ** 0.5 * (counts - 1)
    return out
