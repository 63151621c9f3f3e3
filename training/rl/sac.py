"""Soft Actor-Critic (Haarnoja et al. 2018) on a cloth, by stable-baselines3."""

from __future__ import annotations

import random
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchcloth.errors import MissingDependency
from torchcloth.planning.task import Task

from .env import ReachEnv, Tried


class Learnt(NamedTuple):
    """What learning has found.

    Attributes:
        best: [N] steps of the best motion that was tried.
        history: m, the distance of every motion that was tried, in order, the final policy's last.
        policy: m, where that ends, without exploring.
    """

    best: Tensor
    history: list[float]
    policy: float


def learn(task: Task, motions: int, seed: int = 0, warm: int = 10) -> Learnt:
    """Learn to reach the goal from so many motions.

    Args:
        task: with ``stepwise`` courses and one model.
        motions: that are simulated.
        seed: of networks and exploration.
        warm: motions with random steps, before learning begins.

    Raises:
        MissingDependency: stable-baselines3 is not installed.
    """
    try:
        from stable_baselines3 import SAC
        from stable_baselines3.common.callbacks import StopTrainingOnMaxEpisodes
        from stable_baselines3.common.logger import Logger
    except ImportError as error:
        remedy = 'pip install "torchcloth[rl]"'
        raise MissingDependency("SAC needs stable-baselines3", remedy=remedy) from error
    tried: list[Tried] = []
    env = ReachEnv(task, tried.append)
    before, torch_type = torch.get_num_threads(), torch.get_default_dtype()
    drawn = random.getstate(), np.random.get_state(), torch.get_rng_state()  # noqa: NPY002 - seeded by it
    torch.set_num_threads(1)  # networks are small: more threads take tens of times as long
    torch.set_default_dtype(torch.float32)  # as its networks want; the cloth keeps its own
    try:
        model = SAC("MlpPolicy", env, seed=seed, learning_starts=warm * env.stretches, gradient_steps=1, device="cpu")
        model.set_logger(Logger(None, []))  # else it makes a folder
        model.learn(motions * env.stretches, StopTrainingOnMaxEpisodes(motions))  # torn cloth ends one early
        seen, over = env.reset()[0], False
        while not over:
            seen, _, over, _, _ = env.step(model.predict(seen, deterministic=True)[0])
    finally:
        torch.set_num_threads(before)
        torch.set_default_dtype(torch_type)
        random.setstate(drawn[0])
        np.random.set_state(drawn[1])  # noqa: NPY002
        torch.set_rng_state(drawn[2])
    best = min(tried, key=lambda t: t.distance)
    return Learnt(best.at, [t.distance for t in tried], tried[-1].distance)
