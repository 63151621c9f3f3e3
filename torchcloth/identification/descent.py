"""The paper's way: gradient descent on the Chamfer distance by reverse mode through the whole rollout."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from ..cloth import Cloth
from ..losses import chamfer_to_vertices
from .episodes import Episode
from .replays import simulate
from .unknowns import Unknown


def descend(
    cloth: Cloth,
    unknowns: Sequence[Unknown],
    episodes: Sequence[Episode],
    start: Tensor,
    iterations: int,
    rate: float,
    on_iterate: Callable[[Tensor, list[Tensor]], bool],
) -> Tensor:
    """Adam on the unconstrained parameters; ``on_iterate(raw, frames)`` returns True to stop.

    The loss is the DiffCP paper's one-sided Chamfer distance, cloud to nearest vertex.
    """
    raw = start.clone().requires_grad_()
    optimiser = torch.optim.Adam([raw], lr=rate)
    for _ in range(iterations):
        optimiser.zero_grad()
        frames = []
        for episode in episodes:
            x = simulate(cloth, unknowns, raw, episode)
            clouds = zip(episode.clouds, x, strict=True)
            loss = torch.stack([chamfer_to_vertices(cloud, vertices) for cloud, vertices in clouds]).mean()
            (loss / len(episodes)).backward()
            frames.append(x.detach())
        if on_iterate(raw.detach().clone(), frames):
            break
        optimiser.step()
        with torch.no_grad():
            raw.copy_(torch.tensor([u.clip(float(r)) for u, r in zip(unknowns, raw, strict=True)]))
    return raw.detach()
