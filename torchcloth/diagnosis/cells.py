"""Residuals as means over parts of the fabric and stretches of time.

Thousands of points tell a few hundred independent things: the mean misfit of a part of the cloth over a fifth of a
second. Means have little noise, so what is left in them is what the model gets wrong.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ..identification.blocks import BLOCKS
from ..identification.episodes import Episode
from ..identification.replays import Frames
from ..identification.rows import Rows, scene_of
from ..identification.sheet import Sheet

STRETCH = 0.2  # s
OUTLIER = 5.0  # robust standard deviations within a cell
FEWEST = 3  # rows, of a cell of many
NAMES = tuple(block.name for block in BLOCKS)


class Cells(NamedTuple):
    """Mean residuals of one episode, with derivatives along K directions."""

    value: Tensor  # [C] m, N or N m
    jacobian: Tensor  # [C, K], d residual / d direction
    count: Tensor  # [C] rows
    spread: Tensor  # [C] standard deviation of a row within the cell
    block: Tensor  # [C] int64, kind of data
    patch: Tensor  # [C] int64
    window: Tensor  # [C] int64
    place: Tensor  # [C, 3] m, where on the fabric at rest; zero where that makes no sense
    time: Tensor  # [C] s

    @property
    def key(self) -> Tensor:
        """[C] the same for the same cell of another model."""
        return (self.block * 1000 + self.patch) * 1000 + self.window


def cells_of(frames: Frames, moved: Frames | None, episode: Episode, sheet: Sheet, rest: Tensor) -> Cells:
    """Of one simulated episode; ``moved`` holds derivatives of the frames, ``rest`` [V, 3] m the pattern."""
    scene = scene_of(frames, moved, episode, sheet)
    parts = []
    for b, block in enumerate(BLOCKS):
        rows = block.rows(scene)
        if rows is not None and len(rows.value):
            parts.append(_averaged(rows, b, episode, _places(block.name, rows, sheet, rest)))
    return Cells(*(torch.cat(column) for column in zip(*parts, strict=True)))


def directions(base: Frames, shifted: Sequence[Frames], steps: Sequence[float]) -> Frames:
    """Finite differences of frames along K directions."""

    def slope(field):
        return torch.stack([(field(s) - field(base)) / h for s, h in zip(shifted, steps, strict=True)])

    wrench = {name: slope(lambda f, name=name: f.wrench[name]) for name in base.wrench}
    return Frames(slope(lambda f: f.x), slope(lambda f: f.v), wrench, slope(lambda f: f.edge))


def _averaged(rows: Rows, block: int, episode: Episode, place: Tensor) -> Cells:
    times = episode.times.to(rows.value)
    window = ((times - times[0]) / STRETCH).floor().long()[rows.frame]
    group, index = torch.unique(rows.patch * 1000 + window, return_inverse=True)
    size = len(group)
    add = lambda v: torch.zeros(size, *v.shape[1:], dtype=v.dtype).index_add(0, index, v)  # noqa: E731
    kept = _inliers(rows.value, index, size).to(rows.value)
    count = add(kept)
    share = kept / count.clamp(min=1.0)[index]
    mean = add(share * rows.value)
    spread = add(share * (rows.value - mean[index]) ** 2).sqrt()
    jacobian = torch.zeros(len(rows.value), 0).to(mean) if rows.jacobian is None else rows.jacobian
    found = Cells(
        mean,
        add(share[:, None] * jacobian),
        count,
        spread,
        torch.full((size,), block),
        group // 1000,
        group % 1000,
        add(share[:, None] * place),
        add(share * times[rows.frame]),
    )
    return Cells(*(column[count >= min(FEWEST, float(count.max()))] for column in found))


def _inliers(value: Tensor, index: Tensor, size: int) -> Tensor:
    """Rows near the median of their cell; a whole cell may be far off, a stray point may not."""
    order = torch.argsort(value)
    order = order[torch.argsort(index[order], stable=True)]
    counts = torch.bincount(index, minlength=size)
    first = counts.cumsum(0) - counts
    middle = lambda v: v[first + counts // 2]  # noqa: E731
    off = (value - middle(value[order])[index]).abs()
    again = torch.argsort(off)
    again = again[torch.argsort(index[again], stable=True)]
    usual = 1.4826 * middle(off[again]).clamp(min=1e-9)
    return off <= OUTLIER * usual[index]


def _places(name: str, rows: Rows, sheet: Sheet, rest: Tensor) -> Tensor:
    """[R, 3] m, the middle of each row's patch on the pattern."""
    if name == "points":
        total = torch.zeros(int(sheet.patches.max()) + 1, 3, dtype=rest.dtype).index_add(0, sheet.patches, rest)
        count = torch.bincount(sheet.patches, minlength=len(total)).clamp(min=1)
        return (total / count[:, None])[rows.patch]
    if name == "edges":
        middle = 0.5 * (rest[sheet.rim.edges[:, 0]] + rest[sheet.rim.edges[:, 1]])
        total = torch.zeros(sheet.rim.count, 3, dtype=rest.dtype).index_add(0, sheet.rim.piece, middle)
        count = torch.bincount(sheet.rim.piece, minlength=sheet.rim.count).clamp(min=1)
        return (total / count[:, None])[rows.patch]
    return torch.zeros(len(rows.value), 3, dtype=rest.dtype)
