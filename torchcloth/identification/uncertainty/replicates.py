"""Groups of episodes that repeat each other, and the variance of an estimate between them (jackknife)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Sequence
from pathlib import Path

import torch
from torch import Tensor

from ..._utils.constants import Z_95
from ...recordings import Recording
from ..estimators import levenberg_marquardt
from ..estimators.levenberg_marquardt import Iterate, Problem, student_quantile

MIN_REPLICATES = 3  # episodes that show a scatter
MAX_REFIT_ITERATIONS = 8
REFIT_TOLERANCE_STD_ERRORS = 0.1  # of a step that ends a refit


def assign_strata(recordings: Sequence[Recording]) -> Tensor:
    """Return stratum numbers [E] int64, equal for episodes that repeat one motion.

    Episodes repeat each other by ``split.motion`` or ``split.replicate_of``. Those with fewer than two companions are
    stratum 0 together.
    """
    keys = motion_keys(recordings)
    replicated = [key for key, count in Counter(keys).items() if count >= MIN_REPLICATES]
    return torch.tensor([1 + replicated.index(key) if key in replicated else 0 for key in keys])


def motion_keys(recordings: Sequence[Recording]) -> list[Hashable]:
    """Return keys that are equal for episodes of one ``split.motion``, or that repeat one (``split.replicate_of``)."""
    by_path = {r.path.resolve(): r for r in recordings if r.path is not None}
    names = Counter(path.name for path in by_path)
    by_unique_name = {path.name: r for path, r in by_path.items() if names[path.name] == 1}
    return [_motion_key(r, by_path, by_unique_name) for r in recordings]


def _motion_key(recording: Recording, by_path: dict[Path, Recording], by_unique_name: dict[str, Recording]) -> Hashable:
    """Motion of the episode that was repeated first, or its name; its folder where several have that name."""
    visited = []
    while (original := _original(recording, by_path, by_unique_name)) is not None and original not in visited:
        recording, visited = original, [*visited, original]
    stated = recording.split.get("motion") or recording.split.get("replicate_of")
    if stated or recording.path is None:
        return stated or id(recording)
    return recording.path.name if recording.path.name in by_unique_name else str(recording.path.resolve())


def _original(
    recording: Recording, by_path: dict[Path, Recording], by_unique_name: dict[str, Recording]
) -> Recording | None:
    """The repeated episode: of that name in the same folder, else the only one anywhere; None where there is none."""
    name = recording.split.get("replicate_of")
    if name is None:
        return None
    sibling = None if recording.path is None else by_path.get(recording.path.resolve().parent / name)
    return by_unique_name.get(name) if sibling is None else sibling


def jackknife_variance(problem: Problem, at: Iterate, episode: Tensor, strata: Tensor) -> Tensor:
    """Compute variances [K] of an estimate from leaving out one episode after the other (Efron 1982).

    Each refit is of the residuals as they are linearised here, with new scales, weights and cutoffs. One step with the
    weights of all episodes would be about half too short: residuals that are outliers among all episodes are none
    without the episode that made the others small. New simulations would change the shifts by a few per cent more.
    The variance is widened as Student's distribution is, so that an interval of 1.96 standard deviations holds the
    truth with few episodes.

    Args:
        problem: of all episodes.
        at: its solution.
        episode: [R] index of every row's episode; rows with E or more are never left out.
        strata: [E] groups of replicates, within which the scatter counts.
    """
    rows = torch.bincount(episode, minlength=len(strata))[: len(strata)]
    removable = torch.nonzero((rows > 0) & (rows < len(episode)))[:, 0]  # without its only episode a fit has no data
    total, strata = torch.zeros_like(at.raw), strata[removable]
    if not len(removable):
        return total
    shifts = torch.stack([_shift_without(problem, at, episode == e) for e in removable])
    for stratum in strata.unique():
        group = shifts[strata == stratum]
        if len(group) < MIN_REPLICATES:  # no scatter: as far as each episode pulls
            total += group.square().sum(0)
            continue
        variance = (len(group) - 1) / len(group) * (group - group.mean(0)).square().sum(0)
        total += (student_quantile(len(group) - 1) / Z_95) ** 2 * variance
    return total


def _shift_without(problem: Problem, at: Iterate, is_left_out: Tensor) -> Tensor:
    """Shift [K] of the estimate without some rows."""
    linear = at.linear._replace(simulation_variance=None, slope_covariance=None)
    rows = ((name, getattr(linear, name)) for name in linear._fields)
    reduced = linear._replace(**{name: row[~is_left_out] for name, row in rows if row is not None})

    def residual(raw: Tensor) -> Tensor:
        return reduced.residual + reduced.jacobian @ (raw - at.raw)

    refit = problem._replace(
        linearise=lambda raw: reduced._replace(residual=residual(raw)),
        evaluate=lambda raw: (residual(raw), reduced.error_group),
    )
    end = levenberg_marquardt.minimise(refit, at.raw, MAX_REFIT_ITERATIONS, lambda _: False, REFIT_TOLERANCE_STD_ERRORS)
    return end.raw - at.raw
