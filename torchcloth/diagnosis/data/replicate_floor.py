"""Noise floor from episodes that repeat one command: no model can predict better than they agree.

The error of a model is the same in both repetitions. Their difference is due to regrasping, several equilibria of the
cloth, and the sensor. Its RMS divided by the square root of two is the noise floor of a bin (pure error).
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import torch
from torch import Tensor

from ...boundaries.motion import interpolate_poses
from ...episodes.observed import Episode
from ...identification.uncertainty.replicates import motion_keys
from ...recordings import Recording
from ..inference.comparison import HeldOutPrediction
from .binning import align_rows

SAME_PATH_TOLERANCE_M = 0.01  # distance between two grippers that follow one command
SAME_ROTATION_TOLERANCE_RAD = 0.1  # angle between them
PATH_SAMPLES = 50  # times at which two paths are compared


class ReplicateFloor(NamedTuple):
    """Noise floor that repetitions show.

    Attributes:
        pairs: pairs of episodes that repeat each other.
        rms: of the residual of a position bin of one episode [m].
    """

    pairs: int
    rms: float


def find_replicate_pairs(recordings: Sequence[Recording], episodes: Sequence[Episode]) -> list[tuple[int, int]]:
    """Return pairs of episodes that state the same motion and whose grippers, if any, follow the same path."""
    keys = motion_keys(recordings)
    every = combinations(range(len(keys)), 2)
    return [(i, k) for i, k in every if keys[i] == keys[k] and _is_same_command(episodes[i], episodes[k])]


def _is_same_command(a: Episode, b: Episode) -> bool:
    """Whether the grippers follow the same path relative to the first frame, with the same orientations."""
    if not a.motion or a.motion.keys() != b.motion.keys():
        return a.motion.keys() == b.motion.keys()
    duration = min(float(e.times[-1] - e.times[0]) for e in (a, b))
    times = torch.linspace(0.0, duration, PATH_SAMPLES, dtype=a.times.dtype)

    def poses(e: Episode) -> Tensor:
        return torch.stack([interpolate_poses(e.motion[name], float(e.times[0]) + times) for name in a.motion])

    one, two = poses(a), poses(b)
    distance = (one[..., :3, 3] - one[:1, :1, :3, 3]) - (two[..., :3, 3] - two[:1, :1, :3, 3])
    angle = (one[..., :3, :3] - two[..., :3, :3]).flatten(-2).norm(dim=-1) / 2**0.5  # rad, for small angles
    return (
        float(distance.norm(dim=-1).max()) < SAME_PATH_TOLERANCE_M and float(angle.max()) < SAME_ROTATION_TOLERANCE_RAD
    )


def estimate_replicate_floor(prediction: HeldOutPrediction, pairs: Sequence[tuple[int, int]]) -> ReplicateFloor | None:
    """Compute the noise floor from the residuals of one model; None without pairs that share bins."""
    squares = []
    for i, k in pairs:
        one, two = prediction.episode == i, prediction.episode == k
        common = torch.isin(prediction.key[one], prediction.key[two]) & prediction.is_position[one]
        key, value = prediction.key[one][common], prediction.residual[one][common]
        squares.append((value - align_rows(key, prediction.key[two], prediction.residual[two])).square() / 2)
    square = torch.cat(squares) if squares else prediction.residual[:0]
    if not len(square):
        return None
    return ReplicateFloor(sum(len(pair) > 0 for pair in squares), float(square.mean().sqrt()))
