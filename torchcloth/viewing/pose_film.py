"""A pose estimate beside what was measured; what was hidden is coloured by its standard error."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..pose import PoseEstimate
from ..recordings import Recording
from .film import Film, Sheet
from .recording_film import film_of

LEAST = 2.0  # mm, that the colour bar spans at least
QUANTILE = 0.95  # of the hidden vertices' errors, is dark red


def film_of_pose(recording: Recording, estimate: PoseEstimate, *, truth: bool = False) -> Film:
    """An episode and its estimate: grey where the cloth was seen.

    Args:
        recording: the one that was estimated from.
        estimate: the result.
        truth: show the true cloth of a synthetic episode too, as a net (read it with ``with_truth=True``).
    """
    film = film_of(recording, truth=truth, times=estimate.times.numpy())
    x, seen = estimate.x.numpy().astype(np.float32), estimate.seen.numpy()
    error = 1e3 * estimate.std.square().sum(-1).sqrt().numpy().astype(np.float32)
    worst = max(LEAST, float(np.ceil(np.quantile(error[~seen], QUANTILE)))) if not seen.all() else LEAST
    nets = {name: replace(sheet, net=True) for name, sheet in film.sheets.items()}
    return replace(
        film,
        title=f"{film.title}: pose, corrective force {100 * estimate.fit['force_share']:.1f} % of the weight",
        sheets={**nets, "cloth": Sheet(x, estimate.faces.numpy(), np.where(seen, np.nan, error))},
        worst=worst,
        legend="standard error, hidden vertices",
        grey="seen",
    )
