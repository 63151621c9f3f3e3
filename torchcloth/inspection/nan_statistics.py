"""Medians of what was seen."""

from __future__ import annotations

import numpy as np


def median(values: np.ndarray, axis: int) -> np.ndarray:
    """Median along an axis over what is not NaN; NaN where nothing is."""
    values = np.moveaxis(values, axis, -1)
    seen = np.any(np.isfinite(values), axis=-1)
    return np.where(seen, np.nanmedian(np.where(seen[..., None], values, 0.0), axis=-1), np.nan)
