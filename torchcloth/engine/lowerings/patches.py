"""Patches of neighbouring triangles, so that the contact search need not look at all pairs.

Patches are small against the distance along the cloth beyond which layers may touch.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from torch import Tensor
from torch.utils.weak import WeakTensorKeyDictionary

from ...dynamics.contact import Grid
from ..enums import PATCH_TRIANGLES


class Patches(NamedTuple):
    """Patches of E triangles; see ``csrc/layer_search.h``.

    Attributes:
        order: [E] int32, triangles patch by patch.
        starts: [patches + 1] int32, where each patch begins in ``order``.
        may_meet: [patches, patches] uint8, whether two patches have triangles that are far apart along the cloth.
        non_adjacent: [E, patches] uint8, which triangles of a patch are far apart along the cloth: one bit for each.
    """

    order: np.ndarray
    starts: np.ndarray
    may_meet: np.ndarray
    non_adjacent: np.ndarray


_cache: WeakTensorKeyDictionary = WeakTensorKeyDictionary()  # by ``Grid.non_adjacent``, which belongs to one mesh


def patches_of(grid: Grid, corners: Tensor) -> Patches:
    """Return the patches of a mesh with corners [3, E]; no patches where all triangles are always active."""
    if grid.non_adjacent is None:
        return Patches(np.zeros(1, np.int32), np.zeros(1, np.int32), *[np.zeros((1, 1), np.uint8)] * 2)
    if grid.non_adjacent not in _cache:
        _cache[grid.non_adjacent] = _build(grid.non_adjacent.cpu().numpy(), corners.cpu().numpy())
    return _cache[grid.non_adjacent]


def _build(non_adjacent: np.ndarray, corners: np.ndarray) -> Patches:
    order, starts = _grow_patches(corners)
    bit = (1 << np.arange(len(order)) - np.repeat(starts[:-1], np.diff(starts))).astype(np.uint8)
    bits = np.add.reduceat(non_adjacent[np.ix_(order, order)] * bit, starts[:-1], axis=1, dtype=np.uint8)
    may_meet = np.logical_or.reduceat(bits != 0, starts[:-1], axis=0)
    return Patches(order, starts, (may_meet | may_meet.T).astype(np.uint8), bits)


def _grow_patches(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Order and starts: each patch grows from the first unassigned triangle over common vertices."""
    around: list[list[int]] = [[] for _ in range(corners.max() + 1)]
    for triangle, vertices in enumerate(corners.T):
        for vertex in vertices:
            around[vertex].append(triangle)
    unassigned, order, starts = set(range(corners.shape[1])), [], [0]
    for first in range(corners.shape[1]):
        if first not in unassigned:
            continue
        patch, k = [first], 0
        unassigned.discard(first)
        while k < len(patch):
            for other in (t for vertex in corners[:, patch[k]] for t in around[vertex]):
                if other in unassigned and len(patch) < PATCH_TRIANGLES:
                    patch.append(other)
                    unassigned.discard(other)
            k += 1
        order += patch
        starts.append(len(order))
    return np.array(order, np.int32), np.array(starts, np.int32)
