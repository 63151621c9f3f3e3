"""Where on the fabric and when measured points are off a simulation, as pictures of its parts."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...episodes.observed_surface import ACROSS
from ..data.binning import BLOCK_NAMES, BIN_SECONDS
from ..data.dataset import DiagnosisData
from ..inference.linearise import Linearisation

POINTS = BLOCK_NAMES.index("points")
SHOWN = 0.98  # quantile of the misfit at the end of the colour bar
PIXELS = 49  # along each side of a tile
LEAST = 1.0  # mm, that the colour bar spans at least: less would dramatise noise


def draw_misfit_maps(evidence: Linearisation, setting: DiagnosisData, title: str = "", limit: float | None = None) -> Any:
    """Mean offset of the points from the surface along its normal, one row a motion, one column each 0.2 s.

    Each tile is the pattern as it lies, v upwards; grey parts were not seen. Red points lie on the side of the
    surface from which its triangles run counterclockwise.

    Args:
        evidence: of any model, as ``gather`` returns it.
        setting: what it was gathered with.
        title: over the picture.
        limit: mm at the ends of the colour bar, to compare pictures; None: what fits.

    Returns:
        a matplotlib figure.
    """
    from matplotlib.figure import Figure

    parts = ACROSS**2
    tiles = [_by_window(evidence, k, parts) for k in range(len(setting.episodes))]
    limit = limit or choose_misfit_limit(evidence)
    rows, columns = len(tiles), 1 + max(max(t, default=0) for t in tiles)
    figure = Figure(figsize=(1.0 * columns + 1.4, 1.05 * rows + 0.5), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False)
    part, inside, extent = _raster(setting)
    for k, (name, tile) in enumerate(zip(setting.motions, tiles, strict=True)):
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
        axes[k, 0].set_ylabel(name, fontsize=9, parse_math=False)
    figure.suptitle(title, fontsize=10)
    figure.colorbar(image, ax=axes, label="points off the surface, mm")  # pyright: ignore[reportPossiblyUnbound]
    return figure


def choose_misfit_limit(*evidence: Linearisation) -> float:
    """mm, an end of the colour bar that fits all."""
    size = np.concatenate([c.value[c.block == POINTS].abs().numpy() for e in evidence for c in e.bins])
    return max(1e3 * float(np.quantile(size, SHOWN)), LEAST) if len(size) else LEAST


def _by_window(evidence: Linearisation, episode: int, parts: int) -> dict[int, np.ndarray]:
    """Window -> [parts] mm, NaN where nothing was seen."""
    cells, out = evidence.bins[episode], {}
    own = (cells.block == POINTS).numpy()
    part, window, value = (c.numpy()[own] for c in (cells.channel // 3, cells.window, cells.value))
    for w in np.unique(window):
        out[int(w)] = np.full(parts, np.nan)
        out[int(w)][part[window == w]] = 1e3 * value[window == w]
    return out


def _raster(setting: DiagnosisData) -> tuple[np.ndarray, np.ndarray, tuple[float, float, float, float]]:
    """([N, N] part of the fabric that is nearest, [N, N] whether there is fabric, extent m) over the pattern."""
    from matplotlib.tri import Triangulation

    place, faces = setting.rest_positions.numpy()[:, :2], setting.sheet.faces.numpy()
    low, high = place.min(0), place.max(0)
    u, v = np.meshgrid(*(np.linspace(a, b, PIXELS) for a, b in zip(low, high, strict=True)))
    pixels = np.stack([u, v], -1)
    nearest = np.linalg.norm(pixels[..., None, :] - place, axis=-1).argmin(-1)
    triangle: Any = Triangulation(place[:, 0], place[:, 1], faces).get_trifinder()(u, v)
    return setting.sheet.patches.numpy()[nearest], triangle >= 0, (low[0], high[0], low[1], high[1])
