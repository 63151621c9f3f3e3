"""Figures of the pattern: where and when measured points are off a simulation."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...episodes.observed_surface import ERROR_GROUPS_PER_AXIS
from ..data.binning import BIN_SECONDS, BLOCK_NAMES
from ..data.dataset import DiagnosisData
from ..inference.linearise import Linearisation

POINTS_BLOCK = BLOCK_NAMES.index("points")
SHOWN_QUANTILE = 0.98  # of the misfit at the end of the colour bar
TILE_PIXELS = 49  # along each side of a tile
MIN_MAP_COLOUR_LIMIT_MM = 1.0  # a shorter colour bar would dramatise noise


def draw_misfit_maps(
    linearisation: Linearisation, data: DiagnosisData, title: str = "", limit: float | None = None
) -> Any:
    """Draw the mean offset of points from the surface along its normal: one row a motion, one column each 0.2 s.

    Each tile is the pattern, with v upwards; grey parts were not seen. Red points lie on the side of the surface from
    which its triangles run counterclockwise.

    Args:
        linearisation: of any model.
        data: the episodes that were linearised.
        title: over the figure.
        limit: ends of the colour bar [mm], to compare figures; None: fitted to the data.

    Returns:
        A matplotlib figure.
    """
    from matplotlib.figure import Figure

    parts = ERROR_GROUPS_PER_AXIS**2
    tiles = [_split_by_window(linearisation, k, parts) for k in range(len(data.episodes))]
    limit = limit or choose_misfit_limit(linearisation)
    rows, columns = len(tiles), 1 + max(max(t, default=0) for t in tiles)
    figure = Figure(figsize=(1.0 * columns + 1.4, 1.05 * rows + 0.5), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False)
    part, inside, extent = _rasterise_pattern(data)
    for k, (motion, tile) in enumerate(zip(data.motions, tiles, strict=True)):
        for j, axis in enumerate(axes[k]):
            axis.set(xticks=[], yticks=[], frame_on=False)
            if k == 0:
                axis.set_title(f"{j * BIN_SECONDS:.1f} s", fontsize=8)
            if j in tile:
                field = np.where(inside, tile[j][part], 0.0)
                grey = np.full((*part.shape, 4), 0.82)
                grey[..., 3] = np.isnan(field)
                image = axis.imshow(
                    np.ma.masked_array(field, ~inside), "RdBu_r", vmin=-limit, vmax=limit, extent=extent, origin="lower"
                )
                axis.imshow(grey, extent=extent, origin="lower")
        axes[k, 0].set_ylabel(motion, fontsize=9, parse_math=False)
    figure.suptitle(title, fontsize=10)
    figure.colorbar(image, ax=axes, label="points off the surface, mm")  # pyright: ignore[reportPossiblyUnbound]
    return figure


def choose_misfit_limit(*linearisations: Linearisation) -> float:
    """Return an end of the colour bar [mm] that fits all linearisations."""
    sizes = [b.value[b.block == POINTS_BLOCK].abs().numpy() for result in linearisations for b in result.bins]
    size = np.concatenate(sizes)
    shown_mm = 1e3 * float(np.quantile(size, SHOWN_QUANTILE)) if len(size) else 0.0
    return max(shown_mm, MIN_MAP_COLOUR_LIMIT_MM)


def _split_by_window(linearisation: Linearisation, episode: int, parts: int) -> dict[int, np.ndarray]:
    """Return window -> [parts] mm, NaN where nothing was seen."""
    bins, out = linearisation.bins[episode], {}
    is_points = (bins.block == POINTS_BLOCK).numpy()
    part, window, value = (column.numpy()[is_points] for column in (bins.channel // 3, bins.window, bins.value))
    for w in np.unique(window):
        out[int(w)] = np.full(parts, np.nan)
        out[int(w)][part[window == w]] = 1e3 * value[window == w]
    return out


def _rasterise_pattern(data: DiagnosisData) -> tuple[np.ndarray, np.ndarray, tuple[float, float, float, float]]:
    """Return ([N, N] nearest part of the fabric, [N, N] whether there is fabric, extent [m]) over the pattern."""
    from matplotlib.tri import Triangulation

    pattern, faces = data.rest_positions.numpy()[:, :2], data.surface.faces.numpy()
    low, high = pattern.min(0), pattern.max(0)
    u, v = np.meshgrid(*(np.linspace(a, b, TILE_PIXELS) for a, b in zip(low, high, strict=True)))
    pixels = np.stack([u, v], -1)
    nearest = np.linalg.norm(pixels[..., None, :] - pattern, axis=-1).argmin(-1)
    triangle: Any = Triangulation(pattern[:, 0], pattern[:, 1], faces).get_trifinder()(u, v)
    return data.surface.error_groups.numpy()[nearest], triangle >= 0, (low[0], high[0], low[1], high[1])
