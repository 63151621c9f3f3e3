"""Measured points over the simulated cloth, before and after."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import Any

import numpy as np

from .cloud_overlays import CloudOverlay
from .figure_layout import grid_shape, hide_unused_axes

SHOWN = 0.98  # quantile of the distances at the end of the colour bar
LEAST = 1.0  # mm, that the colour bar spans at least: less would dramatise noise
MOST = 2000  # points of a picture
ASIDE, ABOVE = 50.0, 18.0  # degrees, of the eye from the cloth's normal and over the horizon
TITLES = ("base model", "with causes")
WIDE = 30  # letters of a title's line


def draw_cloud_overlays(overlays: Sequence[CloudOverlay], faces: np.ndarray) -> Any:
    """One column a moment, one row a model: the cloth's triangles, and points coloured by how far off they are.

    Args:
        overlays: at least one, all by as many models.
        faces: [F, 3] of the cloth.

    Returns:
        a matplotlib figure.
    """
    from matplotlib.figure import Figure

    rows, count = len(overlays[0].surfaces), len(overlays)
    across, down = grid_shape(count)
    every = np.concatenate([o.distances[0].numpy() for o in overlays])
    limit = max(1e3 * float(np.quantile(every, SHOWN)), LEAST)
    figure = Figure(figsize=(2.9 * across + 1.4, (2.8 * rows + 0.3) * down), layout="constrained")
    axes = figure.subplots(rows * down, across, squeeze=False, subplot_kw={"projection": "3d"})
    for k, o in enumerate(overlays):
        column = axes[k // across * rows : (k // across + 1) * rows, k % across]
        for axis, x, distance, told in zip(column, o.surfaces, o.distances, TITLES, strict=False):
            drawn = _moment(axis, o, x.numpy(), 1e3 * distance.numpy(), faces, limit)
            axis.set_title(f"{told}: {1e3 * float(distance.mean()):.1f} mm", fontsize=8)
        named = textwrap.fill(f"{o.motion}, {o.time:.2f} s", WIDE)
        column[0].set_title(f"{named}\n{column[0].get_title()}", fontsize=8, parse_math=False)
    hide_unused_axes(axes, count, rows)
    figure.colorbar(drawn, ax=axes, label="point to surface, mm", shrink=0.8)  # pyright: ignore[reportPossiblyUnbound]
    return figure


def _moment(axis: Any, o: CloudOverlay, x: np.ndarray, distance: np.ndarray, faces: np.ndarray, limit: float) -> Any:
    """One model's cloth in one moment, seen alike whatever the model; returns what the colours belong to."""
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    cloth = Poly3DCollection(x[faces], facecolor="#d9d9d9", edgecolor="#a0a0a0", linewidth=0.2, alpha=0.35)
    axis.add_collection3d(cloth)
    some = slice(None, None, 1 + (len(o.points) - 1) // MOST)
    points = o.points.numpy()[some]
    drawn = axis.scatter(*points.T, c=distance[some], cmap="viridis", vmin=0.0, vmax=limit, s=2, depthshade=False)
    everything = np.concatenate([o.points.numpy(), *(sheet.numpy() for sheet in o.surfaces)])
    middle, half = 0.5 * (everything.max(0) + everything.min(0)), 0.5 * float(np.ptp(everything, axis=0).max())
    for name, centre in zip("xyz", middle, strict=True):
        getattr(axis, f"set_{name}lim")(centre - half, centre + half)
    axis.set_box_aspect((1, 1, 1), zoom=1.3)
    axis.view_init(elev=ABOVE, azim=_around(o.surfaces[0].numpy()) + ASIDE)
    axis.set_axis_off()
    return drawn


def _around(x: np.ndarray) -> float:
    """Degrees about the vertical of the normal of the plane in which a cloth mostly lies."""
    *_, normal = np.linalg.svd(x - x.mean(0), full_matrices=False)[2]
    return float(np.degrees(np.arctan2(normal[1], normal[0])))
