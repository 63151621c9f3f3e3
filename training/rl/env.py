"""A cloth in grippers as a gymnasium environment: each action adds a step to the grippers' motion.

The scene, the limits and the obstacles are those of ``torchcloth plan``. Actions are causal: each adds a smooth step
(quintic, at rest at both ends) within its own interval of time.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchcloth.cloth import Cloth
from torchcloth.errors import InvalidInput, MissingDependency, SimulationDiverged
from torchcloth.planning import Goal
from torchcloth.planning.constrained_step import solve_constrained_step
from torchcloth.planning.motion_parameters import GripperMotionParameters, SplineSpan
from torchcloth.planning.problem import PlanOptions, build_problem
from torchcloth.planning.task import PlanningTask
from torchcloth.recordings import Recording
from torchcloth.robots import DEFAULT_JOINT_ACCELERATION  # pyright: ignore[reportMissingImports] - mapped from robots/
from torchcloth.robots.primitives import GripperLimits  # pyright: ignore[reportMissingImports]
from torchcloth.types import ClothState

try:
    import gymnasium
except ImportError as error:
    raise MissingDependency("reinforcement learning needs gymnasium", remedy='pip install "torchcloth[rl]"') from error

OBSERVED_VERTICES = 32  # spread over the cloth
LENGTH_SCALE_M = 0.5  # by which observed positions are divided
MAX_OBSERVATION = 20.0  # observations are cut there; a garment is never that far away nor that fast
TORN_PENALTY = 5.0  # cost of an unstable simulation, in units of the recorded motion's distance


class StepwiseSpline(SplineSpan):
    """Spline of steps: waypoint k is added from the end of interval k - 1 to the end of interval k."""

    def basis(self, times: Tensor) -> Tensor:
        """Return [N, K] the fraction of each step that is done at ``times`` [N] s."""
        ends = torch.linspace(self.begin, self.end, self.waypoints + 1, dtype=torch.float64)
        s = ((times.double()[:, None] - ends[:-1]) / ends.diff()).clamp(0.0, 1.0)
        return s**3 * (10 - 15 * s + 6 * s * s)


def make_stepwise(course: GripperMotionParameters) -> GripperMotionParameters:
    """Return the parameters of a gripper whose motion is changed by steps."""
    return replace(course, span=StepwiseSpline(*course.span))


class FinishedMotion(NamedTuple):
    """A finished motion.

    Attributes:
        distance: from the goal at the end [m]; infinite if the simulation was unstable.
        at: [N] steps, the unknowns of the planning task.
    """

    distance: float
    at: Tensor


class ReachEnv(gymnasium.Env):
    """Environment in which an episode is one motion of the grippers and an action is one step of all grippers.

    Observation: positions of some vertices relative to the goal's centre, their velocities, the steps so far, and the
    fraction of the motion that is done.
    Action: step of each coordinate as a fraction of the largest step within the limits.
    Reward: after each step, minus the distance from the goal divided by that of the recorded motion's end. If the
    simulation becomes unstable, the motion ends; each remaining step costs as much as the last one, and 5 at least.

    Args:
        task: planning task with one model, whose motions are ``make_stepwise``.
        on_motion: called after each finished motion.
    """

    metadata: dict[str, Any] = {"render_modes": []}

    def __init__(self, task: PlanningTask, on_motion: Callable[[FinishedMotion], None] = lambda tried: None) -> None:
        self.task, self.on_motion = task, on_motion
        self.run = task.forward_models[0]
        course = task.motions[0]
        self.intervals = course.span.waypoints
        self.ends = np.linspace(course.span.begin, course.span.end, self.intervals + 1)
        self.last = float(course.t[-1])  # of the wait
        numbered = task.split_waypoints(torch.arange(len(task.start)))
        self.interval_unknowns = [
            torch.cat([z[k] for z in numbered]) for k in range(self.intervals)
        ]  # unknowns of each stretch
        self.count = len(self.interval_unknowns[0])
        self.vertices = _spread_vertices(self.run.state.x, OBSERVED_VERTICES)
        self.middle = task.goal.points.mean(0).to(self.run.state.x)
        self.recorded_distance = max(task.evaluate(task.start)[0], 1e-9)
        self.first_distance = self.distance(self.run.state.x)
        self.reach = _largest_steps(task)
        size = 6 * len(self.vertices) + self.count + 1
        self.observation_space = gymnasium.spaces.Box(-MAX_OBSERVATION, MAX_OBSERVATION, (size,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (self.count,), np.float32)

    @classmethod
    def of(
        cls,
        cloth: Cloth,
        recording: Recording,
        goal: Goal | Tensor,
        *,
        waypoints: int = 4,
        wait: float = 0.3,
        acceleration: float = DEFAULT_JOINT_ACCELERATION,
        limits: GripperLimits = GripperLimits(),  # noqa: B008 - a tuple
        clearance: float = 0.02,
        dt: float | None = None,
    ) -> ReachEnv:
        """Build the environment from the arguments of ``tc.plan``, with one action for each waypoint.

        Raises:
            InvalidInput: ``cloth`` is no Cloth, or see ``tc.plan``.
            RecordingError: see ``tc.plan``.
        """
        if not isinstance(cloth, Cloth):
            raise InvalidInput("cloth", got=type(cloth).__name__, expected="one Cloth")
        options = PlanOptions(waypoints, wait, acceleration, limits, clearance, dt)
        task, planning_warnings = build_problem(cloth, recording, goal, options, adapt_motion=make_stepwise)
        for text in planning_warnings:
            warnings.warn(text, stacklevel=2)
        return cls(task)

    def reset(self, *, seed: int | None = None, options: Mapping[str, Any] | None = None):
        """Reset the cloth to its first shape at rest."""
        super().reset(seed=seed)
        self.at, self.done, self.state = self.task.start.clone(), 0, self.run.state
        self.away = self.first_distance
        return self.observe(self.state, self.at, self.done), {}

    def step(self, action: np.ndarray):
        """Simulate one interval of time; the last one includes the wait."""
        k = self.done
        self.at = self.add_step(self.at, k, action)
        self.done += 1
        is_over = self.done == self.intervals
        try:
            with torch.no_grad():
                self.state = self.run.simulate_interval(self.state, self.task.motion(self.at), *self.times(k))
            distance = self.away = self.distance(self.state.x)
            reward = -distance / self.recorded_distance
        except SimulationDiverged:
            distance, is_over, reward = math.inf, True, self.torn_reward(k, self.away)
        if is_over:
            self.on_motion(FinishedMotion(distance, self.at))
        return self.observe(self.state, self.at, self.done), reward, is_over, False, {"distance": distance}

    def times(self, k: int) -> tuple[float, float]:
        """Return begin and end [s] of interval ``k``; the last one includes the wait."""
        return float(self.ends[k]), self.last if k + 1 == self.intervals else float(self.ends[k + 1])

    def distance(self, x: Tensor) -> float:
        """Return the distance [m] of a cloth [V, 3] m from the goal."""
        return float(self.task.objectives[0].distance(x))

    def torn_reward(self, k: int, distance: float) -> float:
        """Return the reward where the simulation becomes unstable in interval ``k``: an early end does not pay off."""
        return -(self.intervals - k) * max(TORN_PENALTY, distance / self.recorded_distance)

    def add_step(self, at: Tensor, k: int, action: np.ndarray) -> Tensor:
        """Return the unknowns [N] with the step of interval ``k``, nearest to the wanted one within the limits."""
        fraction = torch.as_tensor(np.asarray(action, dtype=np.float64)).clamp(-1.0, 1.0)
        interval_unknowns = self.interval_unknowns[k]
        largest_up, largest_down = (reach[interval_unknowns] for reach in self.reach)
        wanted = fraction * torch.where(fraction > 0, largest_up, largest_down)
        bounds, done = self.task.bounds, self.task.bounds.rows @ at
        left = bounds._replace(rows=bounds.rows[:, interval_unknowns], low=bounds.low - done, high=bounds.high - done)
        identity = torch.eye(len(wanted)).to(wanted)
        after = at.clone()
        after[interval_unknowns] = solve_constrained_step(torch.zeros_like(wanted), -wanted, identity, left)
        return after if self.task.is_clear(after) else at

    def observe(self, state: ClothState, at: Tensor, done: int) -> np.ndarray:
        """Return the observation [O] after ``done`` intervals."""
        x, v = state.x[self.vertices] - self.middle, state.v[self.vertices]
        steps_so_far = torch.cat([z.sum(0) for z in self.task.split_waypoints(at)])
        fraction = steps_so_far.new_tensor([done / self.intervals])
        parts = [(x / LENGTH_SCALE_M).flatten(), v.flatten(), steps_so_far, fraction]
        return torch.cat(parts).clamp(-MAX_OBSERVATION, MAX_OBSERVATION).numpy().astype(np.float32)


def _largest_steps(task: PlanningTask) -> tuple[Tensor, Tensor]:
    """Return [N] and [N], the largest steps of each coordinate alone within the limits, up and down."""
    rows, high, low = task.bounds.rows, task.bounds.high[:, None], task.bounds.low[:, None]

    def largest_step(sign: float) -> Tensor:
        change = sign * rows
        limit = torch.where(change < -1e-12, low / change, torch.inf)
        return torch.where(change > 1e-12, high / change, limit).amin(0)

    return largest_step(1.0), largest_step(-1.0)


def _spread_vertices(x: Tensor, count: int) -> Tensor:
    """Return indices of vertices by farthest-point sampling."""
    chosen, distance = [0], (x - x[0]).norm(dim=1)
    while len(chosen) < min(count, len(x)):
        chosen.append(int(distance.argmax()))
        distance = torch.minimum(distance, (x - x[chosen[-1]]).norm(dim=1))
    return torch.tensor(chosen)


def make_garment_env(
    garment: str = "dress", action: str = "carry", triangles: int = 150, waypoints: int = 2, seed: int = 0
) -> ReachEnv:
    """Build the environment of a garment in two grippers and a hidden goal, as in the study ``trajectories``.

    Args:
        garment: "dress", "trousers" or "shirt".
        action: the motion to begin with: "carry", "drag", "cover" or "fling".
        triangles: approximate number.
        waypoints: number of actions.
        seed: of the hidden goal.
    """
    from ..studies.manipulations.scenes import Discretisation
    from ..studies.trajectory_scenes import build_scene, make_hidden_goal

    scene = build_scene(garment, action, Discretisation(triangles, gap=0.1), waypoints)
    goal = make_hidden_goal(scene, np.random.default_rng(seed))
    courses = [make_stepwise(course) for course in scene.courses]
    return ReachEnv(PlanningTask([scene.run], courses, goal, None, None))
