"""Statistics that ignore missing observations."""

from __future__ import annotations

import numpy as np


def nan_median(values: np.ndarray, axis: int) -> np.ndarray:
    """Return the median along an axis, ignoring NaN; NaN where all values are NaN."""
    values = np.moveaxis(values, axis, -1)
    seen = np.any(np.isfinite(values), axis=-1)
    return np.where(seen, np.nanmedian(np.where(seen[..., None], values, 0.0), axis=-1), np.nan)
