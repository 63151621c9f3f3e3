"""Learn motions by Soft Actor-Critic (Haarnoja et al. 2018) from stable-baselines3."""

from __future__ import annotations

import random
import time
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchcloth.errors import MissingDependency
from torchcloth.planning.task import PlanningTask

from .env import FinishedMotion, ReachEnv
from .vector_env import ReachVectorEnv


class LearningResult(NamedTuple):
    """Result of learning.

    Attributes:
        best: [N] steps of the best motion.
        history: distances of all motions [m], in order; the last one is that of the final policy.
        seconds: CPU time [s] until the end of each motion, learning included.
        policy: distance of the final policy without exploration [m].
    """

    best: Tensor
    history: list[float]
    seconds: list[float]
    policy: float


def learn(task: PlanningTask, motions: int, seed: int = 0, random_motions: int = 10, scenes: int = 1) -> LearningResult:
    """Learn to reach the goal.

    Args:
        task: planning task with one model, whose motions are ``make_stepwise``.
        motions: number of simulated motions.
        seed: of networks and exploration.
        random_motions: number of motions with random steps before learning begins.
        scenes: number of motions that are simulated at the same time.

    Raises:
        MissingDependency: stable-baselines3 is not installed.
    """
    try:
        from stable_baselines3 import SAC
        from stable_baselines3.common.callbacks import BaseCallback
        from stable_baselines3.common.logger import Logger
    except ImportError as error:
        remedy = 'pip install "torchcloth[rl]"'
        raise MissingDependency("SAC needs stable-baselines3", remedy=remedy) from error
    motions_tried: list[FinishedMotion] = []
    seconds: list[float] = []
    began = time.thread_time()

    def on_motion(tried: FinishedMotion) -> None:
        motions_tried.append(tried)
        seconds.append(time.thread_time() - began)

    class StopAfterMotions(BaseCallback):
        def _on_step(self) -> bool:
            return len(motions_tried) < motions  # an unstable simulation ends a motion early

    env = ReachEnv(task, on_motion)
    training_env: Any = env if scenes == 1 else _as_vec_env(ReachVectorEnv(env, scenes, on_motion))
    before, torch_type = torch.get_num_threads(), torch.get_default_dtype()
    random_states = random.getstate(), np.random.get_state(), torch.get_rng_state()  # noqa: NPY002 - seeded by it
    torch.set_num_threads(1)  # the networks are small; more threads take tens of times as long
    torch.set_default_dtype(torch.float32)  # required by the networks; the cloth keeps its own type
    try:
        model = SAC(
            "MlpPolicy",
            training_env,
            seed=seed,
            learning_starts=random_motions * env.intervals,
            gradient_steps=scenes,
            device="cpu",
        )
        model.set_logger(Logger(None, []))  # otherwise a folder is made
        model.learn(motions * env.intervals + scenes * env.intervals, StopAfterMotions())
        del motions_tried[motions:], seconds[motions:]  # the last batch may be larger than asked for
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
    return LearningResult(best.at, [t.distance for t in motions_tried], seconds, motions_tried[-1].distance)


def _as_vec_env(env: ReachVectorEnv) -> Any:
    """Return the vector environment with the interface of stable-baselines3."""
    from stable_baselines3.common.vec_env import VecEnv

    class VecEnvAdapter(VecEnv):
        def __init__(self) -> None:
            super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)
            self.actions = np.zeros((env.num_envs, env.env.count))

        def reset(self) -> np.ndarray:
            return env.reset()[0]

        def step_async(self, actions: np.ndarray) -> None:
            self.actions = actions

        def step_wait(self):
            observations, rewards, over, _, more = env.step(self.actions)
            infos: list[dict[str, Any]] = [{"distance": float(d)} for d in more["distance"]]
            for i in np.flatnonzero(over):
                infos[i] |= {"terminal_observation": more["final_obs"][i], "TimeLimit.truncated": False}
            return observations, rewards.astype(np.float32), over, infos

        def close(self) -> None:
            env.close()

        def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
            return [getattr(env, attr_name)] * self.num_envs

        def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
            raise NotImplementedError("the scenes share one environment")

        def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
            return [getattr(env, method_name)(*args, **kwargs)] * self.num_envs

        def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
            return [False] * self.num_envs

    return VecEnvAdapter()
