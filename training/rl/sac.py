"""Learn motions by Soft Actor-Critic (Haarnoja et al. 2018) from stable-baselines3."""

from __future__ import annotations

import random
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchcloth.errors import MissingDependency
from torchcloth.planning.task import PlanningTask

from .env import FinishedMotion, ReachEnv


class LearningResult(NamedTuple):
    """Result of learning.

    Attributes:
        best: [N] steps of the best motion.
        history: distances of all motions [m], in order; the last one is that of the final policy.
        policy: distance of the final policy without exploration [m].
    """

    best: Tensor
    history: list[float]
    policy: float


def learn(task: PlanningTask, motions: int, seed: int = 0, random_motions: int = 10) -> LearningResult:
    """Learn to reach the goal.

    Args:
        task: planning task with one model, whose motions are ``make_stepwise``.
        motions: number of simulated motions.
        seed: of networks and exploration.
        random_motions: number of motions with random steps before learning begins.

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
    motions_tried: list[FinishedMotion] = []
    env = ReachEnv(task, motions_tried.append)
    before, torch_type = torch.get_num_threads(), torch.get_default_dtype()
    random_states = random.getstate(), np.random.get_state(), torch.get_rng_state()  # noqa: NPY002 - seeded by it
    torch.set_num_threads(1)  # the networks are small; more threads take tens of times as long
    torch.set_default_dtype(torch.float32)  # required by the networks; the cloth keeps its own type
    try:
        model = SAC(
            "MlpPolicy", env, seed=seed, learning_starts=random_motions * env.intervals, gradient_steps=1, device="cpu"
        )
        model.set_logger(Logger(None, []))  # otherwise a folder is made
        model.learn(
            motions * env.intervals, StopTrainingOnMaxEpisodes(motions)
        )  # an unstable simulation ends one early
        observation, is_over = env.reset()[0], False
        while not is_over:
            observation, _, is_over, _, _ = env.step(model.predict(observation, deterministic=True)[0])
    finally:
        torch.set_num_threads(before)
        torch.set_default_dtype(torch_type)
        random.setstate(random_states[0])
        np.random.set_state(random_states[1])  # noqa: NPY002
        torch.set_rng_state(random_states[2])
    best = min(motions_tried, key=lambda t: t.distance)
    return LearningResult(best.at, [t.distance for t in motions_tried], motions_tried[-1].distance)
