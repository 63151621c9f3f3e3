"""The same model on a mesh twice as fine: the difference between both is discretisation error, not physics.

Residuals are computed on the fine mesh, slopes on the coarse one. An error of the slopes costs an iteration, an error
of the residuals would be named as a cause. Only effects that act in folds have their slopes on the fine mesh, because a
coarse mesh does not resolve folds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from ...episodes.world import World, WorldModel
from ...identification.uncertainty.richardson import refine_cloth, refine_recording
from ...recordings import Recording


def refine_model(model: WorldModel, recordings: Sequence[Recording]) -> tuple[WorldModel, list[Recording]]:
    """Return the model and the recordings with every triangle divided into four."""
    coarse = model.base.cloth
    cloth = refine_cloth(coarse)
    recordings = [refine_recording(r, coarse.mesh, cloth.mesh) for r in recordings]
    return replace(
        model, base=World(cloth, model.base.motion_transforms, model.base.observation_transforms)
    ), recordings
