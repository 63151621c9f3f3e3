"""Which episodes repeat each other: their scatter shows what differs between them and was not fitted."""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Sequence
from pathlib import Path

import torch
from torch import Tensor

from ...recordings import Recording
from ..estimators import levenberg_marquardt
from ..estimators.levenberg_marquardt import NORMAL, Iterate, Problem, student

FEWEST = 3  # episodes that show a scatter
REFITS = 8  # steps of a refit, at most
TOLERANCE = 0.1  # standard errors at which it ends


def strata_of(recordings: Sequence[Recording]) -> Tensor:
    """[E] int64: equal numbers for episodes of one ``split.motion``, or that repeat one (``split.replicate_of``).

    Those with fewer than two companions are taken together as number 0.
    """
    keys = keys_of(recordings)
    many = [key for key, count in Counter(keys).items() if count >= FEWEST]
    return torch.tensor([1 + many.index(key) if key in many else 0 for key in keys])


def keys_of(recordings: Sequence[Recording]) -> list[Hashable]:
    """Equal for episodes of one ``split.motion``, or that repeat one (``split.replicate_of``)."""
    placed = {r.path.resolve(): r for r in recordings if r.path is not None}
    names = Counter(path.name for path in placed)
    alone = {path.name: r for path, r in placed.items() if names[path.name] == 1}
    return [_key(r, placed, alone) for r in recordings]


def _key(recording: Recording, placed: dict[Path, Recording], alone: dict[str, Recording]) -> Hashable:
    """The motion of the episode that was repeated first, or its name; its folder where several have that name."""
    passed = []
    while (first := _original(recording, placed, alone)) is not None and first not in passed:
        recording, passed = first, [*passed, first]
    said = recording.split.get("motion") or recording.split.get("replicate_of")
    if said or recording.path is None:
        return said or id(recording)
    return recording.path.name if recording.path.name in alone else str(recording.path.resolve())


def _original(recording: Recording, placed: dict[Path, Recording], alone: dict[str, Recording]) -> Recording | None:
    """What it repeats: the episode beside it of that name, or the only one anywhere; None where there is none."""
    of = recording.split.get("replicate_of")
    if of is None:
        return None
    beside = None if recording.path is None else placed.get(recording.path.resolve().parent / of)
    return alone.get(of) if beside is None else beside


def scatter(problem: Problem, at: Iterate, episode: Tensor, strata: Tensor) -> Tensor:
    """Variances [K] of an estimate from leaving out one episode after the other (Efron 1982).

    Each refit is one of the residuals as they are linearised here, with scales, weights and gates anew: one step with
    the weights of the whole is about half too short, because residuals that were outliers among all episodes are none
    without the episode that made the others small. Simulating anew changes the shifts by a few per cent more.
    Widened as Student's distribution is, so that the interval of 1.96 deviations holds the truth with few episodes.

    Args:
        problem: of all episodes.
        at: its solution.
        episode: [R] of every row; E and more: of one that stays.
        strata: [E] numbers of groups of replicates, within which the scatter counts.
    """
    rows = torch.bincount(episode, minlength=len(strata))[: len(strata)]
    told = torch.nonzero((rows > 0) & (rows < len(episode)))[:, 0]  # without its only one a fit has no data
    total, strata = torch.zeros_like(at.raw), strata[told]
    if not len(told):
        return total
    shifts = torch.stack([_without(problem, at, episode == e) for e in told])
    for stratum in strata.unique():
        own = shifts[strata == stratum]
        if len(own) < FEWEST:  # no scatter of their own: as far as each one pulls
            total += own.square().sum(0)
            continue
        spread = (len(own) - 1) / len(own) * (own - own.mean(0)).square().sum(0)
        total += (student(len(own) - 1) / NORMAL) ** 2 * spread
    return total


def _without(problem: Problem, at: Iterate, left_out: Tensor) -> Tensor:
    """[K], by how much the estimate moves without some rows."""
    linear, kept = at.linear._replace(wobble=None, blur=None), ~left_out
    parts = ((name, getattr(linear, name)) for name in linear._fields)
    less = linear._replace(**{name: part[kept] for name, part in parts if part is not None})

    def value(raw: Tensor) -> Tensor:
        return less.value + less.jacobian @ (raw - at.raw)

    refit = problem._replace(
        linearise=lambda raw: less._replace(value=value(raw)), evaluate=lambda raw: (value(raw), less.patch)
    )
    return levenberg_marquardt.minimise(refit, at.raw, REFITS, lambda _: False, TOLERANCE).raw - at.raw
