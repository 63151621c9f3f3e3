"""The paper's way: gradient descent on the Chamfer distance by reverse mode through the whole rollout."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from ..losses import chamfer_to_vertices
from .objective import Objective
from .replays import simulate


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
        for episode in objective.episodes:
            x = simulate(objective.cloth, objective.unknowns, raw, episode, objective.dt)
            clouds = zip(episode.clouds, x, strict=True)
            loss = torch.stack([chamfer_to_vertices(cloud, vertices) for cloud, vertices in clouds]).mean()
            (loss / len(objective.episodes)).backward()
            frames.append(x.detach())
        objective.simulations += len(frames)
        objective.remember(raw.detach(), frames)
        seen = raw.detach().clone()
        if on_iterate(seen, objective):
            break
        optimiser.step()
        with torch.no_grad():
            raw.copy_(objective.clip(raw))
    return seen
