"""Patches of neighbouring triangles, so that the search for layers need not look at all pairs.

They are small against the way along the cloth from which on layers are seen.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from torch import Tensor
from torch.utils.weak import WeakTensorKeyDictionary

from ...dynamics.contact import Grid
from ..stages import PATCH


class Patches(NamedTuple):
    """See csrc/search.h."""

    order: np.ndarray  # [E] int32, patch by patch
    starts: np.ndarray  # [patches + 1] int32
    meet: np.ndarray  # [patches, patches] uint8: have triangles that are far from each other along the cloth
    apart: np.ndarray  # [E, patches] uint8, ``Grid.apart`` in this order with a bit for each triangle of a patch


_KNOWN: WeakTensorKeyDictionary = WeakTensorKeyDictionary()  # by ``Grid.apart``, which belongs to one mesh


def patches(grid: Grid, corners: Tensor) -> Patches:
    """Of a mesh with these corners [3, E]; no patches where all triangles always take part."""
    if grid.apart is None:
        return Patches(np.zeros(1, np.int32), np.zeros(1, np.int32), *[np.zeros((1, 1), np.uint8)] * 2)
    if grid.apart not in _KNOWN:
        _KNOWN[grid.apart] = _found(grid.apart.cpu().numpy(), corners.cpu().numpy())
    return _KNOWN[grid.apart]


def _found(apart: np.ndarray, corners: np.ndarray) -> Patches:
    order, starts = _grown(corners)
    bit = (1 << np.arange(len(order)) - np.repeat(starts[:-1], np.diff(starts))).astype(np.uint8)
    bits = np.add.reduceat(apart[np.ix_(order, order)] * bit, starts[:-1], axis=1, dtype=np.uint8)
    meet = np.logical_or.reduceat(bits != 0, starts[:-1], axis=0)
    return Patches(order, starts, (meet | meet.T).astype(np.uint8), bits)


def _grown(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Each patch grows from the first triangle that is left, over common vertices."""
    around: list[list[int]] = [[] for _ in range(corners.max() + 1)]
    for triangle, vertices in enumerate(corners.T):
        for vertex in vertices:
            around[vertex].append(triangle)
    left, order, starts = set(range(corners.shape[1])), [], [0]
    for first in range(corners.shape[1]):
        if first not in left:
            continue
        patch, k = [first], 0
        left.discard(first)
        while k < len(patch):
            for other in (t for vertex in corners[:, patch[k]] for t in around[vertex]):
                if other in left and len(patch) < PATCH:
                    patch.append(other)
                    left.discard(other)
            k += 1
        order += patch
        starts.append(len(order))
    return np.array(order, np.int32), np.array(starts, np.int32)
