"""Many motions of one cloth at the same time: a vector environment whose scenes are one batch of the simulator."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AutoresetMode

from torchcloth.errors import InvalidInput, SimulationDiverged
from torchcloth.types import ClothState, Trajectory

from .env import FinishedMotion, ReachEnv, make_garment_env


class ReachVectorEnv(gymnasium.vector.VectorEnv):
    """Several motions in the scene of one ``ReachEnv``, simulated as one batch.

    A scene whose motion is over is reset in the same step. Its last observation is then in ``infos["final_obs"]``.

    Args:
        env: gives cloth, goal, limits, observations and rewards.
        num_envs: number of scenes.
        on_motion: called after each finished motion.

    Raises:
        InvalidInput: fewer than one scene.
    """

    metadata: dict[str, Any] = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(
        self, env: ReachEnv, num_envs: int = 1, on_motion: Callable[[FinishedMotion], None] = lambda tried: None
    ) -> None:
        if num_envs < 1:
            raise InvalidInput("num_envs", got=num_envs, expected="1 or more")
        self.env, self.num_envs, self.on_motion = env, num_envs, on_motion
        self.single_observation_space, self.single_action_space = env.observation_space, env.action_space
        self.observation_space = gymnasium.vector.utils.batch_space(env.observation_space, num_envs)
        self.action_space = gymnasium.vector.utils.batch_space(env.action_space, num_envs)

    def reset(self, *, seed: int | Sequence[int | None] | None = None, options: Mapping[str, Any] | None = None):
        """Reset all scenes to the first shape at rest."""
        super().reset(seed=seed if seed is None or isinstance(seed, int) else next(iter(seed), None))
        self.at = [self.env.task.start.clone() for _ in range(self.num_envs)]
        self.done = [0] * self.num_envs
        self.states = [self.env.run.state] * self.num_envs
        self.away = [self.env.first_distance] * self.num_envs
        return np.stack([self._observe(i) for i in range(self.num_envs)]), {}

    def step(self, actions: np.ndarray):
        """Simulate one interval of each scene; scenes in the same interval are one batch."""
        env, count = self.env, self.num_envs
        rewards, over, distances = np.zeros(count), np.zeros(count, dtype=bool), np.zeros(count)
        for k in sorted(set(self.done)):
            scenes = [i for i in range(count) if self.done[i] == k]
            for i in scenes:
                self.at[i] = env.add_step(self.at[i], k, actions[i])
            for i, state in zip(scenes, self._simulate(scenes, k), strict=True):
                if state is None:
                    distances[i], over[i], rewards[i] = np.inf, True, env.torn_reward(k, self.away[i])
                    continue
                self.states[i], over[i] = state, k + 1 == env.intervals
                distances[i] = self.away[i] = env.distance(state.x)
                rewards[i] = -distances[i] / env.recorded_distance
        self.done = [k + 1 for k in self.done]
        observations = np.stack([self._observe(i) for i in range(count)])
        infos: dict[str, Any] = {"distance": distances, "_distance": np.ones(count, dtype=bool)}
        if over.any():
            final = np.full(count, None, dtype=object)
            for i in np.flatnonzero(over).tolist():
                final[i] = observations[i].copy()
                self.on_motion(FinishedMotion(float(distances[i]), self.at[i]))
                self.at[i], self.done[i] = env.task.start.clone(), 0
                self.states[i], self.away[i] = env.run.state, env.first_distance
                observations[i] = self._observe(i)
            infos |= {"final_obs": final, "_final_obs": over.copy()}
        return observations, rewards, over, np.zeros(count, dtype=bool), infos

    def _observe(self, i: int) -> np.ndarray:
        return self.env.observe(self.states[i], self.at[i], self.done[i])

    @torch.no_grad()
    def _simulate(self, scenes: list[int], k: int) -> list[ClothState | None]:
        """Return the states after interval ``k``; None where the simulation is unstable."""
        motions = [self.env.task.motion(self.at[i]) for i in scenes]
        states = [self.states[i] for i in scenes]
        try:
            batch = self.env.run.simulate_interval(_stack_states(states), _stack_motions(motions), *self.env.times(k))
            return [batch.map(lambda field, j=j: field[j]) for j in range(len(scenes))]
        except SimulationDiverged:
            return [self._simulate_alone(state, motion, k) for state, motion in zip(states, motions, strict=True)]

    def _simulate_alone(self, state: ClothState, motion: Mapping[str, Trajectory], k: int) -> ClothState | None:
        try:
            return self.env.run.simulate_interval(state, motion, *self.env.times(k))
        except SimulationDiverged:
            return None


def make_garment_vector_env(num_envs: int = 1, **options: Any) -> ReachVectorEnv:
    """Build ``num_envs`` scenes of ``make_garment_env(**options)``."""
    return ReachVectorEnv(make_garment_env(**options), num_envs)


def _stack_states(states: Sequence[ClothState]) -> ClothState:
    memory = {name: torch.stack([state.memory[name] for state in states]) for name in states[0].memory}
    x, v, d3 = (torch.stack(parts) for parts in zip(*((s.x, s.v, s.d3) for s in states), strict=True))
    return ClothState(x, v, d3, memory)


def _stack_motions(motions: Sequence[Mapping[str, Trajectory]]) -> dict[str, Trajectory]:
    return {
        name: path._replace(pose=torch.stack([motion[name].pose for motion in motions]))
        for name, path in motions[0].items()
    }
