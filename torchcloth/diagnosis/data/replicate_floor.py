"""What repetitions of a command differ by: no model can be better than that.

The error of a model is the same in both; what is left of the difference is regrasping, several equilibria and the
sensor. Its RMS over the square root of two is the floor of a cell (pure error).
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import torch
from torch import Tensor

from ...boundaries.motion import interpolate_poses
from ...episodes.observed import Episode
from ...identification.uncertainty.replicates import keys_of
from ...recordings import Recording
from ..inference.comparison import HeldOutPrediction
from .binning import align_rows

SAME, TURNED = 0.01, 0.1  # m and rad, within which two grippers follow one command


class ReplicateFloor(NamedTuple):
    """The floor that repetitions show."""

    pairs: int  # of episodes
    rms: float  # m, of a position cell of one episode


def find_replicate_pairs(recordings: Sequence[Recording], episodes: Sequence[Episode]) -> list[tuple[int, int]]:
    """Episodes that repeat each other: they say so or have one motion, and grippers go the same way, if any do."""
    keys = keys_of(recordings)
    every = combinations(range(len(keys)), 2)
    return [(i, k) for i, k in every if keys[i] == keys[k] and _alike(episodes[i], episodes[k])]


def _alike(a: Episode, b: Episode) -> bool:
    """Whether the grippers go the same way from the first frame on, wherever that is, and face the same way."""
    if not a.motion or a.motion.keys() != b.motion.keys():
        return a.motion.keys() == b.motion.keys()
    span = min(float(e.times[-1] - e.times[0]) for e in (a, b))
    since = torch.linspace(0.0, span, 50, dtype=a.times.dtype)

    def poses(e: Episode) -> Tensor:
        return torch.stack([interpolate_poses(e.motion[name], float(e.times[0]) + since) for name in a.motion])

    one, two = poses(a), poses(b)
    apart = (one[..., :3, 3] - one[:1, :1, :3, 3]) - (two[..., :3, 3] - two[:1, :1, :3, 3])
    turned = (one[..., :3, :3] - two[..., :3, :3]).flatten(-2).norm(dim=-1) / 2**0.5  # rad, while it is small
    return float(apart.norm(dim=-1).max()) < SAME and float(turned.max()) < TURNED


def estimate_replicate_floor(predicted: HeldOutPrediction, pairs: Sequence[tuple[int, int]]) -> ReplicateFloor | None:
    """The floor from residuals of one model; None without pairs that share cells."""
    squares = []
    for i, k in pairs:
        one, two = predicted.episode == i, predicted.episode == k
        both = torch.isin(predicted.key[one], predicted.key[two]) & predicted.is_position[one]
        key, value = predicted.key[one][both], predicted.residual[one][both]
        squares.append((value - align_rows(key, predicted.key[two], predicted.residual[two])).square() / 2)
    square = torch.cat(squares) if squares else predicted.residual[:0]
    return ReplicateFloor(sum(len(own) > 0 for own in squares), float(square.mean().sqrt())) if len(square) else None
