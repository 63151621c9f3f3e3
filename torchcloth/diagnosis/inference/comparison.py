"""Fitted models on motions that they were not fitted to.

Each group of motions is predicted by what the others determine: the solution of all data is moved by one linear step
to that of the others, and the prediction with it. How little the others may know of a number is part of the
prediction: its covariance is K + J C J', with C that of the model's numbers by the others. Nothing of a predicted
episode but its own nuisances, within their priors, and these numbers, within C, is used.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..data.binning import FORCE_BLOCK, align_rows
from .fitting import ModelFit, posterior_precision, gauss_newton_step
from .noise import WhitenedBins
from .robust_weights import t_log_density, remove_weights, t_weights

ALONE = 0.7  # share of the information, of a motion without which a cause cannot be sized
BLOCK = 2  # windows of cells that are resampled together
DRAWS = 2000
FEW = 8  # episodes, below which they show too little of their own spread: the share's interval is doubled


class HeldOutPrediction(NamedTuple):
    """Held-out residuals of one model; cells of all episodes."""

    residual: Tensor  # [C] as predicted from the other motions, without what nuisances and uncertain numbers explain
    whitened: Tensor  # [C] the same, whitened
    log_scale: Tensor  # [C] logarithms of what that divided by, beyond the noise
    key: Tensor  # [C]
    episode: Tensor  # [C]
    window: Tensor  # [C]
    time_block: Tensor  # [C] of time, whose cells err together
    block: Tensor  # [C] of data, by number
    smooth_fraction: Tensor  # [C] share of the noise's variance that is no roughness

    @property
    def bin_key(self) -> Tensor:
        """[C] the same for the same cell of the same episode by another model."""
        return self.episode * 10**9 + self.key

    @property
    def is_position(self) -> Tensor:
        """[C] bool, a position and not a force."""
        return self.block < FORCE_BLOCK


class Gain(NamedTuple):
    """Of one model over another, on motions held out."""

    rms_before: float  # m RMS, whole residual of positions; NaN where nothing was seen
    rms_after: float
    log_density: float  # log predictive density, second minus first
    log_density_ci95: tuple[float, float]  # of the density's difference
    explained_fraction: float  # share of before^2 - floor^2, from -1 to 1
    explained_fraction_ci95: tuple[float, float]
    robust_rms: tuple[float, float]  # m RMS before and after, where what neither describes, or ripples, counts for less
    rms_removed: tuple[float, float]  # m and N RMS, so weighed, that are gone from the episode where most is
    lower_bound_95: float  # that the density surely gains: more, in 95 of 100 cases
    small_sample_episodes: int = 0  # episodes, where they show too little of their own spread and the share's interval is doubled

    @property
    def mean_square_removed(self) -> float:
        """m^2, by which the mean square of what is ``calm`` falls."""
        return self.robust_rms[0] ** 2 - self.robust_rms[1] ** 2


def list_observed_motions(episode: Tensor, names: Sequence[str]) -> list[str]:
    """The motions of which there are cells, which are of the numbered ``episode`` [C]: others say nothing."""
    there = set(episode.tolist())
    return [name for k, name in enumerate(names) if k in there]


def predict_held_out(found: ModelFit, groups: Sequence[str], halved: Collection[str] = ()) -> HeldOutPrediction:
    """Residuals of every episode when its group of motions is left out of the fit.

    Of the groups ``halved`` every other stretch of time is left out instead, and then the others: where one kind of
    motion alone tells of a cause, no other can say how large it is.
    """
    return _told(found, *_held_out(found, groups, halved))


def held_out_log_density(found: ModelFit, groups: Sequence[str], halved: Collection[str] = ()) -> float:
    """Log density of all cells as ``predict`` has them, up to a constant that no model changes."""
    _, white, scale = _held_out(found, groups, halved)
    return float(t_log_density(white, found.whitened.time_block).sum() - scale.sum())


def _held_out(found: ModelFit, groups: Sequence[str], halved: Collection[str]) -> tuple[Tensor, Tensor, Tensor]:
    """Of all cells K^-1 r, whitened, and logarithms of the scale."""
    likely, white, scale = (torch.zeros_like(found.whitened.value) for _ in range(3))
    plain = remove_weights(found.whitened)
    for inside in _folds(found, groups, halved):
        likely[inside], white[inside], scale[inside] = _by_others(found, plain, inside)
    return likely, white, scale


def _by_others(found: ModelFit, plain: WhitenedBins, inside: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Of the ``plain`` cells inside, by a fit to those outside: (K^-1 r, whitened, logarithms of the scale)."""
    others = _outside(found, inside)
    step, covariance = gauss_newton_step(others, found.model)[0], torch.linalg.inv(posterior_precision(others, found.model))
    own = plain.jacobian[inside][:, : found.linearisation.n_coordinates]
    value = plain.value[inside] + own @ step
    root = torch.linalg.cholesky(torch.eye(len(value)).to(own) + own @ covariance @ own.mT)
    white = torch.linalg.solve_triangular(root, value[:, None], upper=False)
    likely = torch.linalg.solve_triangular(root.mT, white, upper=True)
    return likely[:, 0], white[:, 0], root.diagonal().log()


def jackknife(found: ModelFit, groups: Sequence[str], halved: Collection[str] = ()) -> tuple[Tensor, Tensor]:
    """([P + A] mean of the model's coordinates without one group after the other, standard errors by how these differ).

    The jackknife: motions that disagree about a number say by how much a law may differ from the model's, which the
    noise within a motion does not.
    """
    steps = torch.stack([gauss_newton_step(_outside(found, i), found.model)[0] for i in _folds(found, groups, halved)])
    std = ((len(steps) - 1) * (steps - steps.mean(0)).square().mean(0)).sqrt()
    return found.model.point + steps.mean(0), std


def _outside(found: ModelFit, inside: Tensor) -> WhitenedBins:
    """Of the cells outside: one linear step from the solution of all data leads to theirs."""
    return found.whitened._replace(value=found.whitened.value[~inside], jacobian=found.whitened.jacobian[~inside])


def predict_as_given(found: ModelFit) -> HeldOutPrediction:
    """Residuals of every episode by a model that was not fitted to any of them."""
    white = remove_weights(found.whitened).value
    return _told(found, white, white, torch.zeros_like(white))


def select_episodes(p: HeldOutPrediction, episodes: Sequence[int]) -> HeldOutPrediction:
    """Only these."""
    kept = torch.isin(p.episode, torch.as_tensor(episodes))
    return HeldOutPrediction(*(column[kept] for column in p))


def _told(found: ModelFit, likely: Tensor, white: Tensor, scale: Tensor) -> HeldOutPrediction:
    cells, episode = found.linearisation.bins, found.whitened.episode
    join = lambda name: torch.cat([getattr(c, name) for c in cells])  # noqa: E731
    value = torch.cat([_adjusted(found, k, likely[episode == k]) for k in range(len(cells))])
    smooth = torch.cat([found.noise.smooth_fraction(c) for c in cells])
    return HeldOutPrediction(
        value, white, scale, join("key"), episode, join("window"), found.whitened.time_block, join("block"), smooth
    )


def _folds(found: ModelFit, groups: Sequence[str], halved: Collection[str]) -> list[Tensor]:
    """[C] bool each: what is left out together, of groups that have cells."""
    member = _member(found, groups)
    odd = torch.cat([c.window for c in found.linearisation.bins]) // BLOCK % 2 == 1
    out = []
    for k, group in enumerate(sorted(set(groups))):
        inside = member == k
        out += [inside & odd, inside & ~odd] if group in halved else [inside]
    return [inside for inside in out if bool(inside.any())]


def _member(found: ModelFit, groups: Sequence[str]) -> Tensor:
    """[C] which of the sorted groups a cell belongs to."""
    order = {group: k for k, group in enumerate(sorted(set(groups)))}
    return torch.tensor([order[g] for g in groups])[found.whitened.episode]


def find_sole_informative_motion(found: ModelFit, groups: Sequence[str]) -> set[str]:
    """The group that alone tells of the last accepted cause, beside what is fitted anyway; none, as a rule."""
    left, member = _informed(found, found.linearisation.n_coordinates - 1), _member(found, groups)
    share = torch.stack([left[member == k].sum() for k in range(len(set(groups)))]) / left.sum().clamp(min=1e-30)
    return {sorted(set(groups))[int(share.argmax())]} if float(share.max()) > ALONE else set()


def count_effective_motions(found: ModelFit, place: int, groups: Sequence[str], halved: Collection[str] = ()) -> float:
    """How many of what ``predict`` leaves out together tell of a coordinate: as many as would say as much, all alike.

    Of Satterthwaite's degrees of freedom, for means that weigh what differs alike unequally, one more.
    """
    left = _informed(found, place)
    share = torch.stack([left[inside].sum() for inside in _folds(found, groups, halved)])
    return float(share.sum() ** 2 / share.square().sum().clamp(min=1e-60))


def _informed(found: ModelFit, place: int) -> Tensor:
    """[C] information on a coordinate beside the others, within their priors.

    What its slopes have that the others' have not, by a column of the covariance. Least squares on the rows say the
    same but for their last bits, which LAPACK rounds as memory happens to lie: a resumed answer would be another.
    """
    column = torch.linalg.inv(posterior_precision(found.whitened, found.model))[:, place]
    return (found.whitened.jacobian[:, : len(column)] @ (column / column[place])).square()


def _adjusted(found: ModelFit, k: int, likely: Tensor) -> Tensor:
    """[C_k] residuals less the likeliest nuisances: S K^-1 r, with S the covariance without them."""
    cells, none = found.linearisation.bins[k], torch.zeros(0, dtype=likely.dtype)
    slow = found.noise.covariance(cells, cells.jacobian[:, :0], none)
    return slow @ torch.linalg.solve_triangular(found.whitened.cholesky_factors[k].mT, likely[:, None], upper=True)[:, 0]


def compare(first: HeldOutPrediction, second: HeldOutPrediction, floor: float, seed: int = 0) -> Gain:
    """How much better the second predicts; intervals by resampling stretches of time. Not, where they share no cell."""
    one, two = _both(first, second)
    if not len(one.residual):
        return Gain(np.nan, np.nan, 0.0, (0.0, 0.0), 0.0, (0.0, 0.0), (0.0, 0.0), (0.0, 0.0), -np.inf)
    owner, density, squares = _blocks(one, two)
    rng = np.random.default_rng(seed)
    drawn = _resampled(owner, rng)
    sums = drawn @ density
    shares = np.array([_share(row, floor) for row in drawn @ squares])
    before, after, n = squares.sum(0)
    low, high = (float(np.quantile(sums, q)) for q in (0.025, 0.975))
    total, share = float(density.sum()), _share(squares.sum(0), floor)
    episodes = len(set(owner.tolist()))
    few = episodes if episodes < FEW else 0
    ends = (share + (2.0 if few else 1.0) * (float(np.quantile(shares, q)) - share) for q in (0.025, 0.975))
    left, right = (min(max(end, -1.0), 1.0) for end in ends)
    counts = one.smooth_fraction * torch.maximum(*(t_weights(p.whitened, p.time_block) for p in (one, two)))
    seen, felt = counts * one.is_position, counts * (one.block == FORCE_BLOCK)
    calm = _calm(one, two, seen)
    least = float(np.quantile(sums, 0.05)) if (drawn != 1).any() else -np.inf  # single stretches have no spread
    mended = (_mended(one, two, seen), 3**0.5 * _mended(one, two, felt))  # a force has three cells
    rms = [(square / n) ** 0.5 if n else np.nan for square in (before, after)]  # nothing was seen, only felt
    return Gain(rms[0], rms[1], total, (low, high), share, (left, right), calm, mended, least, few)


def compare_by_motion(first: HeldOutPrediction, second: HeldOutPrediction, floor: float, names: Sequence[str]) -> dict[str, Gain]:
    """``compare`` for each motion; ``names`` are those of the episodes."""
    motions = {name: [k for k, own in enumerate(names) if own == name] for name in dict.fromkeys(names)}
    both = lambda own: (select_episodes(first, own), select_episodes(second, own))  # noqa: E731
    return {name: compare(*both(own), floor) for name, own in motions.items()}


def _share(squares: np.ndarray, floor: float) -> float:
    before, after, n = squares
    gone = before - after
    return float(gone / max(before - n * floor**2, abs(gone), 1e-30))  # near the floor there is hardly anything to gain


def _both(first: HeldOutPrediction, second: HeldOutPrediction) -> tuple[HeldOutPrediction, HeldOutPrediction]:
    """Cells that both have, in one order, their stretches numbered alike."""
    shared = torch.isin(first.bin_key, second.bin_key)
    one = HeldOutPrediction(*(column[shared] for column in first))
    one = one._replace(stretch=one.time_block.unique(return_inverse=True)[1])
    other = align_rows(one.bin_key, second.bin_key, torch.stack([second.residual, second.whitened, second.log_scale], 1)).unbind(1)
    return one, one._replace(value=other[0], white=other[1], scale=other[2])


def _blocks(one: HeldOutPrediction, two: HeldOutPrediction) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of blocks: episode [B], difference of density [B]; squares before, after and count of positions [B, 3]."""
    density = t_log_density(two.whitened, one.time_block) - t_log_density(one.whitened, one.time_block)
    density = density[one.time_block] / torch.bincount(one.time_block)[one.time_block] + one.log_scale - two.log_scale
    seen = one.is_position.double()
    squares = torch.stack([seen * one.residual**2, seen * two.residual**2, seen], 1)
    block, index = (one.episode * 1000 + one.window // BLOCK).unique(return_inverse=True)
    sums = lambda rows: torch.zeros(len(block), *rows.shape[1:]).to(rows).index_add(0, index, rows).numpy()  # noqa: E731
    return (block // 1000).numpy(), sums(density), sums(squares)


def _calm(one: HeldOutPrediction, two: HeldOutPrediction, share: Tensor) -> tuple[float, float]:
    """RMS before and after of cells that count by a share [C]."""
    rms = lambda p: float((share * p.value**2).sum() / share.sum().clamp(min=1e-12)) ** 0.5  # noqa: E731
    return rms(one), rms(two)


def _mended(one: HeldOutPrediction, two: HeldOutPrediction, share: Tensor) -> float:
    """RMS of what is gone from such cells in the episode where that is most: others need not tell."""
    both = (_calm(one, two, share * (one.episode == e)) for e in one.episode.unique())
    return max(0.0, *(before**2 - after**2 for before, after in both)) ** 0.5


def _resampled(owner: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """[DRAWS, B] how often each block counts: each episode's own are drawn with replacement.

    Sums of m stretches drawn of m vary by (m - 1) / m of what they do, which is made up for; of one nothing is known.
    Episodes themselves are not resampled: they are different motions, of which one may be the only one that tells.
    """
    out = np.ones((DRAWS, len(owner)))
    for e in np.unique(owner):
        m = int((owner == e).sum())
        if m > 1:
            times = rng.multinomial(m, np.full(m, 1 / m), DRAWS)
            out[:, owner == e] += (m / (m - 1)) ** 0.5 * (times - 1)
    return out
