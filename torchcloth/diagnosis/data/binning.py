"""Residuals as means over parts of the fabric and stretches of time.

Thousands of points tell a few hundred independent things: the mean misfit of a part of the cloth over a fifth of a
second. Means have little noise, so what is left in them is what the model gets wrong.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ...episodes.observed import Episode
from ...episodes.observed_surface import ACROSS, Sheet
from ...episodes.replay import Frames
from ...identification.residuals.blocks import BLOCKS
from ...identification.residuals.rows import Rows, scene_of

BIN_SECONDS = 0.2  # s
MAX_BINS = 1000  # of an episode, at most
OUTLIER_ROBUST_STDS = 5.0  # robust standard deviations within a cell
MIN_ROWS_PER_BIN = 3  # rows, of a cell of many
BLOCK_NAMES = tuple(block.name for block in BLOCKS)
FORCE_BLOCK = BLOCK_NAMES.index("force")  # kinds before it are positions


class BinnedResiduals(NamedTuple):
    """Mean residuals of one episode, with derivatives along K directions."""

    value: Tensor  # [C] m, N or N m
    jacobian: Tensor  # [C, K], d residual / d direction
    count: Tensor  # [C] rows
    row_std: Tensor  # [C] standard deviation of a row within the cell
    block: Tensor  # [C] int64, kind of data
    channel: Tensor  # [C] int64, three times the part of the fabric, piece of the rim or gripper, plus the axis
    window: Tensor  # [C] int64
    rest_position: Tensor  # [C, 3] m, where on the fabric at rest; zero where that makes no sense
    time: Tensor  # [C] s
    roughness: Tensor  # [C] in the value's unit, see ``evidence.gather``; zero where nobody asked
    depth_slope: Tensor  # [C] -, d residual / d depth of the one camera; zero of what it does not see

    @property
    def key(self) -> Tensor:
        """[C] the same for the same cell of another model."""
        return (self.block * 10_000 + self.channel) * MAX_BINS + self.window

    def select(self, index: Tensor | slice) -> BinnedResiduals:
        """Those cells alone, by a mask, numbers or a slice."""
        return BinnedResiduals(*(column[index] for column in self))


class EpisodeEvidence(NamedTuple):
    """What one episode says."""

    bins: BinnedResiduals  # columns: the model's own, the hypotheses that could be simulated, nuisances
    nuisance_stds: Tensor  # of the nuisances
    mesh_difference: Tensor  # [C]
    is_simulated: Tensor  # [hypotheses] bool, could be simulated


def time_blocks(cells: Sequence[BinnedResiduals]) -> Tensor:
    """[C] numbers that cells of one episode, kind of data and window share."""
    own = [torch.stack([torch.full_like(c.window, k), c.block, c.window], 1) for k, c in enumerate(cells)]
    return torch.cat(own).unique(dim=0, return_inverse=True)[1]


def align_rows(key: Tensor, other: Tensor, columns: Tensor) -> Tensor:
    """Rows of ``columns`` [O, ...] of the cells ``other`` in the order of the cells ``key`` [C]; zero where missing."""
    if not len(other):
        return columns.new_zeros(len(key), *columns.shape[1:])
    order = torch.argsort(other)
    place = order[torch.searchsorted(other[order], key).clamp(max=len(other) - 1)]
    found = columns[place].clone()
    found[other[place] != key] = 0.0
    return found


def average_groups(stretch: Tensor, values: Tensor) -> Tensor:
    """[C] of values [C], over each cell's stretch."""
    count = torch.bincount(stretch)
    return (values.new_zeros(len(count)).index_add(0, stretch, values) / count)[stretch]


def bin_residuals(frames: Frames, moved: Frames | None, episode: Episode, sheet: Sheet, rest: Tensor) -> BinnedResiduals:
    """Of one simulated episode; ``moved`` holds derivatives of the frames, ``rest`` [V, 3] m the pattern."""
    farther = _farther(frames, episode)
    scene = scene_of(frames, farther if moved is None else concatenate_directions(moved, farther), episode, sheet)
    parts = []
    for b, block in enumerate(BLOCKS):
        rows = block.rows(scene)
        rows = None if rows is None else _shown(block.name, rows)
        if rows is not None and len(rows.value):
            parts.append(_averaged(_grouped(block.name, rows, episode, sheet), b, episode, sheet, rest))
    return BinnedResiduals(*(torch.cat(column) for column in zip(*parts, strict=True)))


def finite_differences(base: Frames, shifted: Sequence[Frames], steps: Sequence[float]) -> Frames:
    """Finite differences of frames along K directions."""

    def slope(field):
        return torch.stack([(field(s) - field(base)) / h for s, h in zip(shifted, steps, strict=True)])

    wrench = {name: slope(lambda f, name=name: f.wrench[name]) for name in base.wrench}
    return Frames(slope(lambda f: f.x), slope(lambda f: f.v), wrench, slope(lambda f: f.edge))


def concatenate_directions(a: Frames, b: Frames) -> Frames:
    """Directions of both."""
    wrench = {name: torch.cat([a.wrench[name], b.wrench[name]]) for name in a.wrench}
    return Frames(torch.cat([a.x, b.x]), torch.cat([a.v, b.v]), wrench, torch.cat([a.edge, b.edge]))


def _farther(frames: Frames, episode: Episode) -> Frames:
    """The direction [1, ...] away from the one camera that an episode has."""
    x = torch.zeros_like(frames.x)
    if episode.camera_position is not None:
        x = torch.nn.functional.normalize(frames.x - episode.camera_position, dim=-1)
    still = {name: torch.zeros_like(w)[None] for name, w in frames.wrench.items()}
    return Frames(x[None], torch.zeros_like(frames.v)[None], still, torch.zeros_like(frames.edge)[None])


def _shown(name: str, rows: Rows) -> Rows:
    """Without pieces of the rim that do not show: their zeros are no measurements."""
    if name != "edges":
        return rows
    shown = rows.value != 0
    jacobian = None if rows.jacobian is None else rows.jacobian[shown]
    return Rows(rows.value[shown], jacobian, rows.frame[shown], rows.patch[shown])


def _grouped(name: str, rows: Rows, episode: Episode, sheet: Sheet) -> Rows:
    """Rows whose patches tell axes apart; single markers join the part of the fabric that they are on."""
    patch = rows.patch
    if name == "markers" and episode.marker_places is not None:
        own = sheet.patches_on(episode.marker_places.corners, episode.marker_places.weights)
        patch = 3 * own[rows.patch // 3] + rows.patch % 3
    elif name in ("points", "edges"):
        patch = 3 * rows.patch
    return rows._replace(patch=patch)


def _averaged(rows: Rows, block: int, episode: Episode, sheet: Sheet, rest: Tensor) -> BinnedResiduals:
    place = _places(BLOCK_NAMES[block], sheet, rest)[rows.patch // 3]
    times = episode.times.to(rows.value)
    window = ((times - times[0]) / BIN_SECONDS + 1e-6).floor().long()[rows.frame]  # stamps are rounded
    group, index = torch.unique(rows.patch * MAX_BINS + window, return_inverse=True)
    size = len(group)
    add = lambda v: torch.zeros(size, *v.shape[1:], dtype=v.dtype).index_add(0, index, v)  # noqa: E731
    kept = _inliers(rows.value, index, size).to(rows.value)
    count = add(kept)
    usual = int(add(torch.ones_like(kept)).median())  # slow streams have few rows in a window, and no strays to spot
    least = MIN_ROWS_PER_BIN if usual > MIN_ROWS_PER_BIN else max(1, min(usual, MIN_ROWS_PER_BIN - 1))
    share = kept / count.clamp(min=1.0)[index]
    mean = add(share * rows.value)
    spread = add(share * (rows.value - mean[index]) ** 2).sqrt()
    slopes = add(share[:, None] * rows.jacobian)  # type: ignore[operator]
    ray = torch.zeros_like(mean) if BLOCK_NAMES[block] == "markers" else slopes[:, -1]  # these may have cameras of their own
    found = BinnedResiduals(
        mean,
        slopes[:, :-1],
        count,
        spread,
        torch.full((size,), block),
        group // MAX_BINS,
        group % MAX_BINS,
        add(share[:, None] * place),
        add(share * times[rows.frame]),
        torch.zeros_like(mean),
        ray,
    )
    return found.select(count >= least)


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
    return off <= OUTLIER_ROBUST_STDS * usual[index]


def _places(name: str, sheet: Sheet, rest: Tensor) -> Tensor:
    """[patches, 3] m, the middle of each on the pattern; zero for what is felt."""
    if name in ("points", "markers"):
        found = _middles(sheet.patches, rest, ACROSS**2)
        ahead = (torch.arange(ACROSS).to(rest) + 0.5) / ACROSS
        centres = torch.cartesian_prod(ahead, ahead)  # of parts without a vertex
        nearest = rest[torch.cdist(centres, sheet.share.to(rest)).argmin(1)]
        return torch.where(torch.isin(torch.arange(ACROSS**2), sheet.patches)[:, None], found, nearest)
    if name == "edges":
        rim = sheet.rim
        middle = 0.5 * (rest[rim.edges[:, 0]] + rest[rim.edges[:, 1]])
        return _middles(rim.label[rim.piece], middle, int(rim.label.max()) + 1)
    return torch.zeros(1000, 3, dtype=rest.dtype)


def _middles(index: Tensor, place: Tensor, count: int) -> Tensor:
    total = torch.zeros(count, 3, dtype=place.dtype).index_add(0, index, place)
    return total / torch.bincount(index, minlength=count).clamp(min=1)[:, None]
