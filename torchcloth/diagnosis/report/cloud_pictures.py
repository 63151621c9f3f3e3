"""Figures of measured points over the simulated cloth, before and after."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import Any

import numpy as np

from .cloud_overlays import CloudOverlay
from .figure_layout import grid_shape, hide_unused_axes

SHOWN_QUANTILE = 0.98  # of the distances at the end of the colour bar
MIN_OVERLAY_COLOUR_LIMIT_MM = 1.0  # a shorter colour bar would dramatise noise
MAX_DRAWN_POINTS = 2000  # of one panel
VIEW_AZIMUTH_DEG = 50.0  # of the eye from the cloth's normal
VIEW_ELEVATION_DEG = 18.0  # of the eye over the horizon
MODEL_TITLES = ("base model", "with causes")
MAX_PANEL_TITLE_LETTERS = 30  # of a line of a title


def draw_cloud_overlays(overlays: Sequence[CloudOverlay], faces: np.ndarray) -> Any:
    """Draw the cloth's triangles, and measured points coloured by their distance from it.

    Args:
        overlays: at least one, all with as many models; one column each.
        faces: [F, 3] triangles of the cloth.

    Returns:
        A matplotlib figure with one row for each model.
    """
    from matplotlib.figure import Figure

    rows, count = len(overlays[0].surfaces), len(overlays)
    columns, lines = grid_shape(count)
    distances = np.concatenate([o.distances[0].numpy() for o in overlays])
    limit = max(1e3 * float(np.quantile(distances, SHOWN_QUANTILE)), MIN_OVERLAY_COLOUR_LIMIT_MM)
    figure = Figure(figsize=(2.9 * columns + 1.4, (2.8 * rows + 0.3) * lines), layout="constrained")
    axes = figure.subplots(rows * lines, columns, squeeze=False, subplot_kw={"projection": "3d"})
    for k, o in enumerate(overlays):
        column = axes[k // columns * rows : (k // columns + 1) * rows, k % columns]
        for axis, x, distance, title in zip(column, o.surfaces, o.distances, MODEL_TITLES, strict=False):
            image = _draw_overlay(axis, o, x.numpy(), 1e3 * distance.numpy(), faces, limit)
            axis.set_title(f"{title}: {1e3 * float(distance.mean()):.1f} mm", fontsize=8)
        label = textwrap.fill(f"{o.motion}, {o.time:.2f} s", MAX_PANEL_TITLE_LETTERS)
        column[0].set_title(f"{label}\n{column[0].get_title()}", fontsize=8, parse_math=False)
    hide_unused_axes(axes, count, rows)
    figure.colorbar(image, ax=axes, label="point to surface, mm", shrink=0.8)  # pyright: ignore[reportPossiblyUnbound]
    return figure


def _draw_overlay(
    axis: Any, o: CloudOverlay, x: np.ndarray, distance: np.ndarray, faces: np.ndarray, limit: float
) -> Any:
    """Draw one model's cloth, from the same eye for all models; returns what the colour bar belongs to."""
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    cloth = Poly3DCollection(x[faces], facecolor="#d9d9d9", edgecolor="#a0a0a0", linewidth=0.2, alpha=0.35)
    axis.add_collection3d(cloth)
    subset = slice(None, None, 1 + (len(o.points) - 1) // MAX_DRAWN_POINTS)
    points = o.points.numpy()[subset]
    image = axis.scatter(*points.T, c=distance[subset], cmap="viridis", vmin=0.0, vmax=limit, s=2, depthshade=False)
    everything = np.concatenate([o.points.numpy(), *(surface.numpy() for surface in o.surfaces)])
    middle, half = 0.5 * (everything.max(0) + everything.min(0)), 0.5 * float(np.ptp(everything, axis=0).max())
    for name, centre in zip("xyz", middle, strict=True):
        getattr(axis, f"set_{name}lim")(centre - half, centre + half)
    axis.set_box_aspect((1, 1, 1), zoom=1.3)
    axis.view_init(elev=VIEW_ELEVATION_DEG, azim=_normal_azimuth(o.surfaces[0].numpy()) + VIEW_AZIMUTH_DEG)
    axis.set_axis_off()
    return image


def _normal_azimuth(x: np.ndarray) -> float:
    """Return the azimuth [degrees] of the normal of the plane in which a cloth mostly lies."""
    *_, normal = np.linalg.svd(x - x.mean(0), full_matrices=False)[2]
    return float(np.degrees(np.arctan2(normal[1], normal[0])))
