"""The same model on a mesh twice as fine: what differs is numerics, no physics.

Residuals are taken on the finer mesh, slopes on the coarser: an error of the slopes costs an iteration, an error of the
residuals would be named as a cause. Slopes along what acts in folds, which a coarse mesh loses, are none there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from ...episodes.world import Model, World
from ...identification.uncertainty.richardson import finer_cloth, finer_recording
from ...recordings import Recording


def refine_model(model: Model, recordings: Sequence[Recording]) -> tuple[Model, list[Recording]]:
    """(model, recordings) with every triangle divided into four."""
    coarse = model.base.cloth
    cloth = finer_cloth(coarse)
    found = [finer_recording(r, coarse.mesh, cloth.mesh) for r in recordings]
    return replace(model, base=World(cloth, model.base.motions, model.base.views)), found
