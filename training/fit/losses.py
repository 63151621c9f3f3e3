"""Losses of one episode, by name: the library's residuals with Huber's function, and Chamfer distances."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from torchcloth.errors import InvalidInput
from torchcloth.identification.residuals.blocks import BLOCKS
from torchcloth.identification.residuals.metrics import huber
from torchcloth.identification.residuals.rows import Scene
from torchcloth.losses import chamfer_to_vertices
from torchcloth.losses.surface import distances


class Loss:
    """The sum of named losses, each a mean over its observations in units of its scale.

    Args:
        scales: name -> what counts as 1, in the residual's unit (m, N, N m): near the noise. "points" (to the surface,
            along its normal), "edges" (the rim), "markers", "force", "torque": residuals, quadratic up to 1.5 scales,
            linear beyond. "chamfer_to_surface", "chamfer_to_vertices": one-sided distances from the cloud.

    Raises:
        InvalidInput: an unknown name or a scale that is not positive.
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

    def __call__(self, scene: Scene) -> Tensor:
        """Differentiable in the frames seen; what an episode does not hold is left out.

        Raises:
            InvalidInput: it holds nothing that the loss asks for.
        """
        parts = [LOSSES[name](scene, scale) for name, scale in self.scales.items()]
        found = [part for part in parts if part is not None]
        if not found:
            expected = f"data for {' or '.join(self.scales)}"
            raise InvalidInput(f"{scene.episode.name}: nothing to compare with", got="none of it", expected=expected)
        return torch.stack(found).sum()


def chamfer(scene: Scene) -> Tensor | None:
    """One-sided Chamfer distance cloud -> surface [m], mean over the frames after the first; None without clouds."""
    frames = scene.hits.items()
    parts = [distances(scene.episode.clouds[t], scene.seen.x[t], hits).mean() for t, hits in frames]
    return torch.stack(parts).mean() if parts else None


def _to_vertices(scene: Scene) -> Tensor | None:
    frames = [chamfer_to_vertices(scene.episode.clouds[t], scene.seen.x[t]) for t in scene.hits]
    return torch.stack(frames).mean() if frames else None


def _residuals(rows: Callable) -> Callable[[Scene, float], Tensor | None]:
    def loss(scene: Scene, scale: float) -> Tensor | None:
        found = rows(scene)
        seen = None if found is None else found.value[found.value != 0]  # zero: a piece of the rim that was not seen
        return None if seen is None or not len(seen) else huber(seen / scale)[0].mean()

    return loss


def _distance(mean: Callable[[Scene], Tensor | None]) -> Callable[[Scene, float], Tensor | None]:
    def loss(scene: Scene, scale: float) -> Tensor | None:
        found = mean(scene)
        return None if found is None else found / scale

    return loss


LOSSES: dict[str, Callable[[Scene, float], Tensor | None]] = {
    **{block.name: _residuals(block.rows) for block in BLOCKS},
    "chamfer_to_surface": _distance(chamfer),
    "chamfer_to_vertices": _distance(_to_vertices),
}
