"""Numbers as colours, the same in every picture and viewer."""

from __future__ import annotations

from typing import Any

import numpy as np

from .geometry import Array

UNKNOWN = (164, 168, 176)  # sRGB of what no measured point lies near
MAP = "YlOrRd"


def colours(values: Array, worst: float) -> Array:
    """sRGB uint8 [..., 3] of values >= 0, pale at 0 and dark red from ``worst`` on; grey where they are NaN."""
    shown = colour_map()(np.clip(np.nan_to_num(values, nan=0.0) / worst, 0, 1), bytes=True)[..., :3]
    return np.where(np.isnan(values)[..., None], np.array(UNKNOWN, np.uint8), shown)


def colour_map(name: str = MAP) -> Any:
    """One of matplotlib's maps, for a colour bar."""
    from matplotlib import colormaps

    return colormaps[name]
