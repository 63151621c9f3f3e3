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

from ..data.binning import SEEN, aligned
from .fitting import Fitted, curvature, step_of
from .noise import Whitened
from .robust_weights import densities, unweighted, weights

ALONE = 0.7  # share of the information, of a motion without which a cause cannot be sized
BLOCK = 2  # windows of cells that are resampled together
DRAWS = 2000
FEW = 8  # episodes, below which they show too little of their own spread: the share's interval is doubled


class Predicted(NamedTuple):
    """Held-out residuals of one model; cells of all episodes."""

    value: Tensor  # [C] as predicted from the other motions, without what nuisances and uncertain numbers explain
    white: Tensor  # [C] the same, whitened
    scale: Tensor  # [C] logarithms of what that divided by, beyond the noise
    key: Tensor  # [C]
    episode: Tensor  # [C]
    window: Tensor  # [C]
    stretch: Tensor  # [C] of time, whose cells err together
    kind: Tensor  # [C] of data, by number
    smooth: Tensor  # [C] share of the noise's variance that is no roughness

    @property
    def place(self) -> Tensor:
        """[C] the same for the same cell of the same episode by another model."""
        return self.episode * 10**9 + self.key

    @property
    def seen(self) -> Tensor:
        """[C] bool, a position and not a force."""
        return self.kind < SEEN


class Gain(NamedTuple):
    """Of one model over another, on motions held out."""

    before: float  # m RMS, whole residual of positions; NaN where nothing was seen
    after: float
    density: float  # log predictive density, second minus first
    ci95: tuple[float, float]  # of the density's difference
    explained: float  # share of before^2 - floor^2, from -1 to 1
    explained_ci95: tuple[float, float]
    calm: tuple[float, float]  # m RMS before and after, where what neither describes, or ripples, counts for less
    mended: tuple[float, float]  # m and N RMS, so weighed, that are gone from the episode where most is
    least: float  # that the density surely gains: more, in 95 of 100 cases
    few: int = 0  # episodes, where they show too little of their own spread and the share's interval is doubled

    @property
    def fallen(self) -> float:
        """m^2, by which the mean square of what is ``calm`` falls."""
        return self.calm[0] ** 2 - self.calm[1] ** 2


def heard(episode: Tensor, names: Sequence[str]) -> list[str]:
    """The motions of which there are cells, which are of the numbered ``episode`` [C]: others say nothing."""
    there = set(episode.tolist())
    return [name for k, name in enumerate(names) if k in there]


def predict(found: Fitted, groups: Sequence[str], halved: Collection[str] = ()) -> Predicted:
    """Residuals of every episode when its group of motions is left out of the fit.

    Of the groups ``halved`` every other stretch of time is left out instead, and then the others: where one kind of
    motion alone tells of a cause, no other can say how large it is.
    """
    return _told(found, *_held_out(found, groups, halved))


def likelihood(found: Fitted, groups: Sequence[str], halved: Collection[str] = ()) -> float:
    """Log density of all cells as ``predict`` has them, up to a constant that no model changes."""
    _, white, scale = _held_out(found, groups, halved)
    return float(densities(white, found.white.stretch).sum() - scale.sum())


def _held_out(found: Fitted, groups: Sequence[str], halved: Collection[str]) -> tuple[Tensor, Tensor, Tensor]:
    """Of all cells K^-1 r, whitened, and logarithms of the scale."""
    likely, white, scale = (torch.zeros_like(found.white.value) for _ in range(3))
    plain = unweighted(found.white)
    for inside in _folds(found, groups, halved):
        likely[inside], white[inside], scale[inside] = _by_others(found, plain, inside)
    return likely, white, scale


def _by_others(found: Fitted, plain: Whitened, inside: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Of the ``plain`` cells inside, by a fit to those outside: (K^-1 r, whitened, logarithms of the scale)."""
    others = _outside(found, inside)
    step, covariance = step_of(others, found.model)[0], torch.linalg.inv(curvature(others, found.model))
    own = plain.jacobian[inside][:, : found.evidence.own]
    value = plain.value[inside] + own @ step
    root = torch.linalg.cholesky(torch.eye(len(value)).to(own) + own @ covariance @ own.mT)
    white = torch.linalg.solve_triangular(root, value[:, None], upper=False)
    likely = torch.linalg.solve_triangular(root.mT, white, upper=True)
    return likely[:, 0], white[:, 0], root.diagonal().log()


def spread(found: Fitted, groups: Sequence[str], halved: Collection[str] = ()) -> tuple[Tensor, Tensor]:
    """([P + A] mean of the model's coordinates without one group after the other, standard errors by how these differ).

    The jackknife: motions that disagree about a number say by how much a law may differ from the model's, which the
    noise within a motion does not.
    """
    steps = torch.stack([step_of(_outside(found, i), found.model)[0] for i in _folds(found, groups, halved)])
    std = ((len(steps) - 1) * (steps - steps.mean(0)).square().mean(0)).sqrt()
    return found.model.point + steps.mean(0), std


def _outside(found: Fitted, inside: Tensor) -> Whitened:
    """Of the cells outside: one linear step from the solution of all data leads to theirs."""
    return found.white._replace(value=found.white.value[~inside], jacobian=found.white.jacobian[~inside])


def as_it_is(found: Fitted) -> Predicted:
    """Residuals of every episode by a model that was not fitted to any of them."""
    white = unweighted(found.white).value
    return _told(found, white, white, torch.zeros_like(white))


def of_episodes(p: Predicted, episodes: Sequence[int]) -> Predicted:
    """Only these."""
    kept = torch.isin(p.episode, torch.as_tensor(episodes))
    return Predicted(*(column[kept] for column in p))


def _told(found: Fitted, likely: Tensor, white: Tensor, scale: Tensor) -> Predicted:
    cells, episode = found.evidence.cells, found.white.episode
    join = lambda name: torch.cat([getattr(c, name) for c in cells])  # noqa: E731
    value = torch.cat([_adjusted(found, k, likely[episode == k]) for k in range(len(cells))])
    smooth = torch.cat([found.noise.smooth(c) for c in cells])
    return Predicted(
        value, white, scale, join("key"), episode, join("window"), found.white.stretch, join("block"), smooth
    )


def _folds(found: Fitted, groups: Sequence[str], halved: Collection[str]) -> list[Tensor]:
    """[C] bool each: what is left out together, of groups that have cells."""
    member = _member(found, groups)
    odd = torch.cat([c.window for c in found.evidence.cells]) // BLOCK % 2 == 1
    out = []
    for k, group in enumerate(sorted(set(groups))):
        inside = member == k
        out += [inside & odd, inside & ~odd] if group in halved else [inside]
    return [inside for inside in out if bool(inside.any())]


def _member(found: Fitted, groups: Sequence[str]) -> Tensor:
    """[C] which of the sorted groups a cell belongs to."""
    order = {group: k for k, group in enumerate(sorted(set(groups)))}
    return torch.tensor([order[g] for g in groups])[found.white.episode]


def telling(found: Fitted, groups: Sequence[str]) -> set[str]:
    """The group that alone tells of the last accepted cause, beside what is fitted anyway; none, as a rule."""
    left, member = _informed(found, found.evidence.own - 1), _member(found, groups)
    share = torch.stack([left[member == k].sum() for k in range(len(set(groups)))]) / left.sum().clamp(min=1e-30)
    return {sorted(set(groups))[int(share.argmax())]} if float(share.max()) > ALONE else set()


def told_by(found: Fitted, place: int, groups: Sequence[str], halved: Collection[str] = ()) -> float:
    """How many of what ``predict`` leaves out together tell of a coordinate: as many as would say as much, all alike.

    Of Satterthwaite's degrees of freedom, for means that weigh what differs alike unequally, one more.
    """
    left = _informed(found, place)
    share = torch.stack([left[inside].sum() for inside in _folds(found, groups, halved)])
    return float(share.sum() ** 2 / share.square().sum().clamp(min=1e-60))


def _informed(found: Fitted, place: int) -> Tensor:
    """[C] information on a coordinate beside the others, within their priors.

    What its slopes have that the others' have not, by a column of the covariance. Least squares on the rows say the
    same but for their last bits, which LAPACK rounds as memory happens to lie: a resumed answer would be another.
    """
    column = torch.linalg.inv(curvature(found.white, found.model))[:, place]
    return (found.white.jacobian[:, : len(column)] @ (column / column[place])).square()


def _adjusted(found: Fitted, k: int, likely: Tensor) -> Tensor:
    """[C_k] residuals less the likeliest nuisances: S K^-1 r, with S the covariance without them."""
    cells, none = found.evidence.cells[k], torch.zeros(0, dtype=likely.dtype)
    slow = found.noise.covariance(cells, cells.jacobian[:, :0], none)
    return slow @ torch.linalg.solve_triangular(found.white.roots[k].mT, likely[:, None], upper=True)[:, 0]


def compare(first: Predicted, second: Predicted, floor: float, seed: int = 0) -> Gain:
    """How much better the second predicts; intervals by resampling stretches of time. Not, where they share no cell."""
    one, two = _both(first, second)
    if not len(one.value):
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
    counts = one.smooth * torch.maximum(*(weights(p.white, p.stretch) for p in (one, two)))
    seen, felt = counts * one.seen, counts * (one.kind == SEEN)
    calm = _calm(one, two, seen)
    least = float(np.quantile(sums, 0.05)) if (drawn != 1).any() else -np.inf  # single stretches have no spread
    mended = (_mended(one, two, seen), 3**0.5 * _mended(one, two, felt))  # a force has three cells
    rms = [(square / n) ** 0.5 if n else np.nan for square in (before, after)]  # nothing was seen, only felt
    return Gain(rms[0], rms[1], total, (low, high), share, (left, right), calm, mended, least, few)


def by_motion(first: Predicted, second: Predicted, floor: float, names: Sequence[str]) -> dict[str, Gain]:
    """``compare`` for each motion; ``names`` are those of the episodes."""
    motions = {name: [k for k, own in enumerate(names) if own == name] for name in dict.fromkeys(names)}
    both = lambda own: (of_episodes(first, own), of_episodes(second, own))  # noqa: E731
    return {name: compare(*both(own), floor) for name, own in motions.items()}


def _share(squares: np.ndarray, floor: float) -> float:
    before, after, n = squares
    gone = before - after
    return float(gone / max(before - n * floor**2, abs(gone), 1e-30))  # near the floor there is hardly anything to gain


def _both(first: Predicted, second: Predicted) -> tuple[Predicted, Predicted]:
    """Cells that both have, in one order, their stretches numbered alike."""
    shared = torch.isin(first.place, second.place)
    one = Predicted(*(column[shared] for column in first))
    one = one._replace(stretch=one.stretch.unique(return_inverse=True)[1])
    other = aligned(one.place, second.place, torch.stack([second.value, second.white, second.scale], 1)).unbind(1)
    return one, one._replace(value=other[0], white=other[1], scale=other[2])


def _blocks(one: Predicted, two: Predicted) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of blocks: episode [B], difference of density [B]; squares before, after and count of positions [B, 3]."""
    density = densities(two.white, one.stretch) - densities(one.white, one.stretch)
    density = density[one.stretch] / torch.bincount(one.stretch)[one.stretch] + one.scale - two.scale
    seen = one.seen.double()
    squares = torch.stack([seen * one.value**2, seen * two.value**2, seen], 1)
    block, index = (one.episode * 1000 + one.window // BLOCK).unique(return_inverse=True)
    sums = lambda rows: torch.zeros(len(block), *rows.shape[1:]).to(rows).index_add(0, index, rows).numpy()  # noqa: E731
    return (block // 1000).numpy(), sums(density), sums(squares)


def _calm(one: Predicted, two: Predicted, share: Tensor) -> tuple[float, float]:
    """RMS before and after of cells that count by a share [C]."""
    rms = lambda p: float((share * p.value**2).sum() / share.sum().clamp(min=1e-12)) ** 0.5  # noqa: E731
    return rms(one), rms(two)


def _mended(one: Predicted, two: Predicted, share: Tensor) -> float:
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
