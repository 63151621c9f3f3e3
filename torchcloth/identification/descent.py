"""The paper's way: gradient descent on the Chamfer distance by reverse mode through the whole rollout."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from ..losses import chamfer_to_vertices
from .objective import Objective
from .replays import detached


def descend(
    objective: Objective, start: Tensor, iterations: int, rate: float, on_iterate: Callable[[Tensor, Objective], bool]
) -> Tensor:
    """Adam on the unconstrained parameters [K]; ``on_iterate(raw, objective)`` returns True to stop.

    The loss is the DiffCP paper's one-sided Chamfer distance, cloud to nearest vertex.
    """
    raw, seen = start.clone().requires_grad_(), start
    optimiser = torch.optim.Adam([raw], lr=rate)
    for _ in range(iterations):
        optimiser.zero_grad()
        frames = []
        for i, episode in enumerate(objective.episodes):
            seen = objective.simulate(raw, i)
            pairs = ((episode.positions(t), vertices) for t, vertices in enumerate(seen.x))
            loss = torch.stack([chamfer_to_vertices(cloud, x) for cloud, x in pairs if len(cloud)]).mean()
            (loss / len(objective.episodes)).backward()
            frames.append(detached(seen))
        objective.simulations += len(frames)
        objective.remember(raw.detach(), frames)
        seen = raw.detach().clone()
        if on_iterate(seen, objective):
            break
        optimiser.step()
        with torch.no_grad():
            raw.copy_(objective.clip(raw))
    return seen
