"""Which episodes repeat each other: their scatter shows what differs between them and was not fitted."""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Sequence

import torch
from torch import Tensor

from ..recordings import Recording
from .gauss_newton import FEWEST


def strata_of(recordings: Sequence[Recording]) -> Tensor:
    """[E] int64: equal numbers for episodes of one ``split.motion``, or that repeat one (``split.replicate_of``).

    Those with fewer than two companions are taken together as number 0.
    """
    named = {r.path.name: r for r in recordings if r.path is not None}
    keys = [_key(r, named) for r in recordings]
    many = [key for key, count in Counter(keys).items() if count >= FEWEST]
    return torch.tensor([1 + many.index(key) if key in many else 0 for key in keys])


def _key(recording: Recording, named: dict[str, Recording]) -> Hashable:
    """The motion of the episode that was repeated first, or its name."""
    passed = []
    while (of := recording.split.get("replicate_of")) in named and of not in passed:
        recording, passed = named[of], [*passed, of]
    own = id(recording) if recording.path is None else recording.path.name
    return recording.split.get("motion") or of or own
