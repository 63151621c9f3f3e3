"""Losses of one episode by name: the library's residuals with the Huber loss, and Chamfer distances."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from torchcloth.errors import InvalidInput
from torchcloth.identification.residuals.blocks import RESIDUAL_BLOCKS
from torchcloth.identification.residuals.metrics import huber
from torchcloth.identification.residuals.rows import ResidualRows, SimulatedEpisode
from torchcloth.losses import chamfer_to_vertices
from torchcloth.losses.surface import point_distances


class Loss:
    """Sum of named losses, each a mean over its observations in units of its scale.

    Args:
        scales: scale of each loss by name, in the residual's unit (m, N, N m); choose it near the noise. "points"
            (to the surface, along its normal), "edges" (boundary), "markers", "force" and "torque" are residuals,
            quadratic up to 1.5 scales and linear above. "chamfer_to_surface" and "chamfer_to_vertices" are one-sided
            distances from the cloud.

    Raises:
        InvalidInput: a name is unknown, or a scale is not positive.
    """

    def __init__(self, scales: Mapping[str, float]) -> None:
        for name, scale in scales.items():
            if name not in LOSSES:
                raise InvalidInput(f"config: loss.{name}", got="unknown", expected=f"one of {', '.join(LOSSES)}")
            if not (scale > 0 and math.isfinite(scale)):
                raise InvalidInput(f"config: loss.{name}", got=scale, expected="a scale > 0 in m, N or N m")
        if not scales:
            raise InvalidInput("config: loss", got="none", expected=f"some of {', '.join(LOSSES)}")
        self.scales = dict(scales)

    def __call__(self, scene: SimulatedEpisode) -> Tensor:
        """Compute the loss of a simulated episode; losses without data are left out.

        Raises:
            InvalidInput: the episode has data for none of the losses.
        """
        parts = [LOSSES[name](scene, scale) for name, scale in self.scales.items()]
        losses = [part for part in parts if part is not None]
        if not losses:
            expected = f"data for {' or '.join(self.scales)}"
            raise InvalidInput(f"{scene.episode.name}: nothing to compare with", got="none of it", expected=expected)
        return torch.stack(losses).sum()


def chamfer(scene: SimulatedEpisode) -> Tensor | None:
    """Compute the one-sided Chamfer distance from cloud to surface [m], mean over the frames after the first.

    None without clouds.
    """
    frames = scene.hits.items()
    parts = [point_distances(scene.episode.clouds[t], scene.frames.x[t], hits).mean() for t, hits in frames]
    return torch.stack(parts).mean() if parts else None


def _to_vertices(scene: SimulatedEpisode) -> Tensor | None:
    frames = [chamfer_to_vertices(scene.episode.clouds[t], scene.frames.x[t]) for t in scene.hits]
    return torch.stack(frames).mean() if frames else None


def _residuals(
    rows: Callable[[SimulatedEpisode], ResidualRows | None],
) -> Callable[[SimulatedEpisode, float], Tensor | None]:
    def loss(scene: SimulatedEpisode, scale: float) -> Tensor | None:
        block_rows = rows(scene)
        if block_rows is None:
            return None
        observed = block_rows.residual[block_rows.residual != 0]  # zero: a part of the boundary without observation
        return huber(observed / scale)[0].mean() if len(observed) else None

    return loss


def _distance(mean: Callable[[SimulatedEpisode], Tensor | None]) -> Callable[[SimulatedEpisode, float], Tensor | None]:
    def loss(scene: SimulatedEpisode, scale: float) -> Tensor | None:
        distance = mean(scene)
        return None if distance is None else distance / scale

    return loss


LOSSES: dict[str, Callable[[SimulatedEpisode, float], Tensor | None]] = {
    **{block.name: _residuals(block.rows) for block in RESIDUAL_BLOCKS},
    "chamfer_to_surface": _distance(chamfer),
    "chamfer_to_vertices": _distance(_to_vertices),
}
