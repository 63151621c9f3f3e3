"""Film of a pose estimate and the measured points; hidden parts are coloured by their standard error."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..pose import PoseEstimate
from ..recordings import Recording
from .colours import COLOUR_LIMIT_QUANTILE, MIN_COLOUR_LIMIT_MM
from .film import ClothSurface, Film
from .recording_film import film_from_recording


def film_from_pose(recording: Recording, estimate: PoseEstimate, *, truth: bool = False) -> Film:
    """Make a film of an episode and its pose estimate, grey where the cloth was visible.

    Args:
        recording: the episode that the estimate was made from.
        estimate: the result of ``estimate_pose``.
        truth: also show the outline of a synthetic episode's true cloth (read it with ``with_truth=True``).
    """
    film = film_from_recording(recording, truth=truth, times=estimate.times.numpy())
    x, seen = estimate.x.numpy().astype(np.float32), estimate.seen.numpy()
    error = 1e3 * estimate.std.square().sum(-1).sqrt().numpy().astype(np.float32)
    colour_limit = (
        max(MIN_COLOUR_LIMIT_MM, float(np.ceil(np.quantile(error[~seen], COLOUR_LIMIT_QUANTILE))))
        if not seen.all()
        else MIN_COLOUR_LIMIT_MM
    )
    outlines = {name: replace(sheet, outline=True) for name, sheet in film.sheets.items()}
    return replace(
        film,
        title=f"{film.title}: pose, corrective force {100 * estimate.fit['force_fraction']:.1f} % of the weight",
        sheets={**outlines, "cloth": ClothSurface(x, estimate.faces.numpy(), np.where(seen, np.nan, error))},
        colour_limit=colour_limit,
        legend="standard error, hidden vertices",
        grey_label="seen",
    )
