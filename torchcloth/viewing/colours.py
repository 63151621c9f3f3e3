"""Map numbers to colours, in the same way for every picture and viewer."""

from __future__ import annotations

from typing import Any

import numpy as np

from .geometry import Array

UNKNOWN_COLOUR = (164, 168, 176)  # sRGB, where no value is known
COLOUR_MAP_NAME = "YlOrRd"
MIN_COLOUR_LIMIT_MM = 2.0  # smaller distances and errors would be dramatised
COLOUR_LIMIT_QUANTILE = 0.95  # of the values, is dark red


def map_colours(values: Array, colour_limit: float) -> Array:
    """Map values >= 0 to sRGB colours: pale at 0, dark red from ``colour_limit`` on, grey for NaN.

    Args:
        values: [...].
        colour_limit: value at the end of the colour bar.

    Returns:
        uint8 [..., 3].
    """
    shown = get_colour_map()(np.clip(np.nan_to_num(values, nan=0.0) / colour_limit, 0, 1), bytes=True)[..., :3]
    return np.where(np.isnan(values)[..., None], np.array(UNKNOWN_COLOUR, np.uint8), shown)


def get_colour_map(name: str = COLOUR_MAP_NAME) -> Any:
    """Return a colour map of matplotlib by its name."""
    from matplotlib import colormaps

    return colormaps[name]
