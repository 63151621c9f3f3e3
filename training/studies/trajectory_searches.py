"""Searches of the trajectories study, with the number of simulated motions and the CPU time of each trial."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchcloth.errors import MissingDependency, SimulationDiverged
from torchcloth.planning import Goal
from torchcloth.planning.forward_model import ForwardModel
from torchcloth.planning.motion_parameters import GripperMotionParameters
from torchcloth.planning.objective import QuadraticModel
from torchcloth.planning.optimizers import adam, gauss_newton
from torchcloth.planning.task import PlanningTask

from .trajectory_scenes import WAYPOINT_SHIFT_STD_M, WAYPOINT_TURN_STD_RAD, Scene, project_to_limits

ADAM_RATE = 0.01  # m and rad, of the first steps
MOTIONS_PER_GRADIENT = 3  # a reverse-mode gradient simulates, simulates again from checkpoints, and goes back
SCENES_PER_BATCH = 4  # of the learner


class Trial(NamedTuple):
    """A motion that was tried.

    Attributes:
        motions: simulated so far, this one included.
        seconds: of CPU time so far.
        distance: from the goal [m].
    """

    motions: int
    seconds: float
    distance: float


class SearchOutcome(NamedTuple):
    """The result of a search.

    Attributes:
        task: with the parametrisation of the motion.
        best: [N], unknowns of the best motion.
        expected: m, its distance from the goal.
        history: all trials.
        ended: why the search stopped.
    """

    task: PlanningTask
    best: Tensor
    expected: float
    history: list[Trial]
    ended: str


class CountingTask(PlanningTask):
    """A planning task that counts simulated motions and CPU time.

    A linearisation counts as one motion for each unknown, a gradient by reverse mode as ``MOTIONS_PER_GRADIENT``, each
    times the number of models.
    """

    def __init__(
        self, forward_models: Sequence[ForwardModel], motions: Sequence[GripperMotionParameters], goal: Goal
    ) -> None:
        super().__init__(forward_models, motions, goal, None, None)
        self.history: list[Trial] = []
        self.simulated, self.began = 0, time.thread_time()

    @property
    def seconds(self) -> float:
        """CPU time since the start [s]."""
        return time.thread_time() - self.began

    def _record(self, motions: int, distance: float | None = None) -> None:
        self.simulated += motions * len(self.forward_models)
        if distance is not None:
            self.history.append(Trial(self.simulated, self.seconds, distance))

    def evaluate(self, at: Tensor) -> tuple[float, float]:
        """Return the distance [m] and the mean square distance [m^2] at the unknowns [N]."""
        try:
            distance, mean_square = super().evaluate(at)
        except SimulationDiverged:
            self._record(1, math.inf)
            raise
        self._record(1, distance)
        return distance, mean_square

    def quadratic_model(self, at: Tensor) -> QuadraticModel:
        """Return the local model of the mean square distance."""
        model = super().quadratic_model(at)
        self._record(len(at))
        return model

    def distance_gradient(self, at: Tensor) -> tuple[float, Tensor]:
        """Return the distance [m] and its gradient [N]."""
        distance, gradient = super().distance_gradient(at)
        self._record(MOTIONS_PER_GRADIENT, distance)
        return distance, gradient


def search_by_gauss_newton(scenes: Sequence[Scene], goal: Goal, iterations: int) -> SearchOutcome:
    """Minimise the mean square distance by Gauss-Newton, as ``tc.plan`` does; of several scenes the mean."""
    task = CountingTask([scene.run for scene in scenes], scenes[0].courses, goal)
    result = gauss_newton(task, task.start, iterations, lambda *progress: None)
    history = list(task.history)
    return SearchOutcome(task, result.best, task.evaluate(result.best)[0], history, result.stop_reason)


def search_by_adam(scene: Scene, goal: Goal, iterations: int) -> SearchOutcome:
    """Minimise the distance by Adam, as the DiffCP paper does."""
    task = CountingTask([scene.run], scene.courses, goal)
    result = adam(task, task.start, iterations, ADAM_RATE, lambda *progress: None)
    return SearchOutcome(task, result.best, min(result.history), task.history, result.stop_reason)


def search_by_cmaes(scene: Scene, goal: Goal, seconds: float, seed: int) -> SearchOutcome:
    """Minimise the distance by CMA-ES (Hansen 2016) for the given CPU time.

    It begins with the standard deviations from which the hidden motion was drawn. Each candidate is projected to the
    nearest motion within the limits.

    Raises:
        MissingDependency: cmaes is not installed.
    """
    try:
        from cmaes import CMA
    except ImportError as error:
        raise MissingDependency("CMA-ES needs cmaes", remedy='pip install "torchcloth[rl]"') from error
    task = CountingTask([scene.run], scene.courses, goal)
    scale = torch.tensor([WAYPOINT_SHIFT_STD_M] * 3 + [WAYPOINT_TURN_STD_RAD] * 3, dtype=torch.float64)
    scale = scale.repeat(len(task.start) // len(scale))
    search = CMA(mean=np.zeros(len(task.start)), sigma=1.0, seed=seed)
    best, least = task.start, task.evaluate(task.start)[0]
    while task.seconds < seconds:
        generation = []
        while len(generation) < search.population_size and task.seconds < seconds:
            candidate = search.ask()
            at = project_to_limits(task, scale * torch.as_tensor(candidate))
            distance = _evaluate_or_infinite(task, at)
            generation.append((candidate, distance))
            if distance < least:
                best, least = at, distance
        if len(generation) == search.population_size:
            worst = max((d for _, d in generation if math.isfinite(d)), default=1.0)
            search.tell([(z, d if math.isfinite(d) else 2 * worst) for z, d in generation])
    return SearchOutcome(task, best, least, task.history, f"after {seconds:.1f} s")


def search_by_sac(scene: Scene, goal: Goal, motions: int, seed: int) -> SearchOutcome:
    """Let Soft Actor-Critic try motions, several scenes in one simulation.

    Raises:
        MissingDependency: gymnasium or stable-baselines3 is not installed.
    """
    from ..rl import learn
    from ..rl.env import make_stepwise

    task = PlanningTask([scene.run], [make_stepwise(course) for course in scene.courses], goal, None, None)
    result = learn(task, motions, seed, scenes=SCENES_PER_BATCH)
    history = [Trial(k, s, d) for k, (s, d) in enumerate(zip(result.seconds, result.history, strict=True), 1)]
    return SearchOutcome(task, result.best, min(result.history), history, f"after {motions} motions")


def _evaluate_or_infinite(task: PlanningTask, at: Tensor) -> float:
    try:
        return task.evaluate(at)[0]
    except SimulationDiverged:
        return math.inf
