"""Fitted models on motions that they were not fitted to.

Each group of motions is predicted by what the others determine: the solution of all data is moved by one linear step
to that of the others, and the prediction with it. Nothing of a predicted episode but its own nuisances, within their
priors, is used.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from .cells import SEEN
from .evidence import aligned
from .fitting import Fitted, prior_precision, step_of

ALONE = 0.7  # share of the information, of a motion without which a cause cannot be sized
BLOCK = 2  # windows of cells that are resampled together
DRAWS = 2000
FEW = 8  # episodes, below which they show too little of their own spread: the share's interval is doubled
FREEDOM = 5  # degrees of the t-distribution by which single cells are judged


class Predicted(NamedTuple):
    """Held-out residuals of one model; cells of all episodes."""

    value: Tensor  # [C] as predicted from the other motions, without what the episode's nuisances explain
    white: Tensor  # [C] the same, whitened
    key: Tensor  # [C]
    episode: Tensor  # [C]
    window: Tensor  # [C]
    seen: Tensor  # [C] bool, a position and not a force


class Gain(NamedTuple):
    """Of one model over another, on motions held out."""

    before: float  # m RMS, whole residual of positions
    after: float
    density: float  # log predictive density, second minus first
    ci95: tuple[float, float]  # of the density's difference
    explained: float  # share of before^2 - floor^2
    explained_ci95: tuple[float, float]


def predict(found: Fitted, groups: Sequence[str], halved: Collection[str] = ()) -> Predicted:
    """Residuals of every episode when its group of motions is left out of the fit.

    Of the groups ``halved`` every other stretch of time is left out instead, and then the others: where one kind of
    motion alone tells of a cause, no other can say how large it is.
    """
    own, whitened = found.white.jacobian[:, : found.evidence.own], found.white.value.clone()
    for inside in _folds(found, groups, halved):
        whitened[inside] += own[inside] @ _step_of_others(found, inside)
    return _told(found, whitened)


def spread(found: Fitted, groups: Sequence[str], halved: Collection[str] = ()) -> Tensor:
    """[P + A] standard errors of the model's coordinates by what they become without one group after the other.

    The jackknife: motions that disagree about a number say by how much a law may differ from the model's, which the
    noise within a motion does not.
    """
    steps = torch.stack([_step_of_others(found, inside) for inside in _folds(found, groups, halved)])
    return ((len(steps) - 1) * (steps - steps.mean(0)).square().mean(0)).sqrt()


def _step_of_others(found: Fitted, inside: Tensor) -> Tensor:
    """[P + A] from the solution of all data to that of the cells outside, by one linear step."""
    others = found.white._replace(value=found.white.value[~inside], jacobian=found.white.jacobian[~inside])
    return step_of(others, found.model)[0]


def as_it_is(found: Fitted) -> Predicted:
    """Residuals of every episode by a model that was not fitted to any of them."""
    return _told(found, found.white.value)


def of_episodes(p: Predicted, episodes: Sequence[int]) -> Predicted:
    """Only these."""
    kept = torch.isin(p.episode, torch.as_tensor(episodes))
    return Predicted(*(column[kept] for column in p))


def _told(found: Fitted, whitened: Tensor) -> Predicted:
    cells, white = found.evidence.cells, found.white
    join = lambda name: torch.cat([getattr(c, name) for c in cells])  # noqa: E731
    value = torch.cat([_adjusted(found, k, whitened[white.episode == k]) for k in range(len(cells))])
    return Predicted(value, whitened, join("key"), white.episode, join("window"), join("block") < SEEN)


def _folds(found: Fitted, groups: Sequence[str], halved: Collection[str]) -> list[Tensor]:
    """[C] bool each: what is left out together."""
    member = _member(found, groups)
    odd = torch.cat([c.window for c in found.evidence.cells]) // BLOCK % 2 == 1
    out = []
    for k, group in enumerate(sorted(set(groups))):
        inside = member == k
        out += [inside & odd, inside & ~odd] if group in halved else [inside]
    return out


def _member(found: Fitted, groups: Sequence[str]) -> Tensor:
    """[C] which of the sorted groups a cell belongs to."""
    order = {group: k for k, group in enumerate(sorted(set(groups)))}
    return torch.tensor([order[g] for g in groups])[found.white.episode]


def telling(found: Fitted, groups: Sequence[str]) -> set[str]:
    """The group that alone tells of the last accepted cause, beside what is fitted anyway; none, as a rule."""
    count, member = found.evidence.own, _member(found, groups)
    own, prior = found.white.jacobian[:, :count], prior_precision(found.model)
    others = torch.cat([own[:, :-1], torch.diag(prior[:-1].sqrt())])
    asked = torch.cat([own[:, -1], own.new_zeros(count - 1)])
    left = (asked - others @ torch.linalg.lstsq(others, asked[:, None]).solution[:, 0])[: len(own)].square()
    share = torch.stack([left[member == k].sum() for k in range(len(set(groups)))]) / left.sum().clamp(min=1e-30)
    return {sorted(set(groups))[int(share.argmax())]} if float(share.max()) > ALONE else set()


def _adjusted(found: Fitted, k: int, white: Tensor) -> Tensor:
    """[C_k] residuals less the likeliest nuisances: S K^-1 r, with S the covariance without them."""
    cells, none = found.evidence.cells[k], torch.zeros(0, dtype=white.dtype)
    slow = found.noise.covariance(cells, cells.jacobian[:, :0], none)
    return slow @ torch.linalg.solve_triangular(found.white.roots[k].mT, white[:, None], upper=True)[:, 0]


def compare(first: Predicted, second: Predicted, floor: float, seed: int = 0) -> Gain:
    """How much better the second predicts; intervals by resampling stretches of time."""
    blocks = _blocks(first, second)
    density = np.array([b[:, 0].sum() for b in blocks])
    squares = np.array([b[:, 1:].sum(0) for b in blocks])  # before^2, after^2, count
    owner = np.array(_owners(first))
    rng = np.random.default_rng(seed)
    drawn = [_draw(owner, rng) for _ in range(DRAWS)]
    sums = np.array([density[d].sum() for d in drawn])
    shares = np.array([_share(squares[d].sum(0), floor) for d in drawn])
    before, after, n = squares.sum(0)
    low, high = (float(np.quantile(sums, q)) for q in (0.025, 0.975))
    total, share = float(density.sum()), _share(squares.sum(0), floor)
    few = 2.0 if len(set(owner.tolist())) < FEW else 1.0
    left, right = (share + few * (float(np.quantile(shares, q)) - share) for q in (0.025, 0.975))
    return Gain((before / n) ** 0.5, (after / n) ** 0.5, total, (low, high), share, (left, right))


def _share(squares: np.ndarray, floor: float) -> float:
    before, after, n = squares
    return float((before - after) / max(before - n * floor**2, 1e-12))


def _log_t(white: Tensor) -> Tensor:
    """Of a t-distribution scaled to the Gaussian's curvature, up to a constant: one wild cell decides nothing."""
    return -0.5 * (FREEDOM + 1) * torch.log1p(white**2 / FREEDOM)


def _groups(p: Predicted) -> Tensor:
    return p.episode * 1000 + p.window // BLOCK


def _owners(p: Predicted) -> list[int]:
    return [int(g) // 1000 for g in _groups(p).unique()]


def _blocks(first: Predicted, second: Predicted) -> list[np.ndarray]:
    """Per stretch [cells, 4]: difference of density, squares before and after (positions only), count."""
    key = lambda p: p.episode * 10**9 + p.key  # noqa: E731
    other = aligned(
        key(first), key(second), torch.stack([second.value, second.white, torch.ones_like(second.value)], 1)
    )
    both = other[:, 2] > 0
    gain = torch.where(both, _log_t(other[:, 1]) - _log_t(first.white), 0.0)
    counted = (both & first.seen).double()
    rows = torch.stack([gain, counted * first.value**2, counted * other[:, 0] ** 2, counted], 1)
    group = _groups(first)
    return [rows[group == g].numpy() for g in group.unique()]


def _draw(owner: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Indices of blocks: each episode's own, with replacement.

    Episodes themselves are not resampled: they are different motions, of which one may be the only one that tells.
    """
    own = (np.flatnonzero(owner == e) for e in np.unique(owner))
    return np.concatenate([rng.choice(blocks, len(blocks)) for blocks in own])
