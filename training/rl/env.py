"""A cloth in grippers as a gymnasium environment: decision after decision, how far to go, until the motion is over.

The scene, the limits and what is in the way are those of ``torchcloth plan``. Decisions are causal: each adds a smooth
step (quintic, at rest at both ends) within its own stretch of time.
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
from torchcloth.planning.constrained_step import step_within
from torchcloth.planning.motion_parameters import Course, Span
from torchcloth.planning.problem import Asked, posed
from torchcloth.planning.task import Task
from torchcloth.recordings import Recording
from torchcloth.robots import ACCELERATION  # pyright: ignore[reportMissingImports] - mapped from robots/
from torchcloth.robots.primitives import Limits  # pyright: ignore[reportMissingImports]

try:
    import gymnasium
except ImportError as error:
    raise MissingDependency("reinforcement learning needs gymnasium", remedy='pip install "torchcloth[rl]"') from error

SEEN = 32  # vertices that are observed, far apart
SIZE = 0.5  # m, that observations are divided by
TORN = 5.0  # of the recorded motion's distance, that a motion counts that cannot be simulated


class Stepwise(Span):
    """What is added is added step by step: waypoint k from the end of stretch k - 1 to the end of stretch k."""

    def basis(self, times: Tensor) -> Tensor:
        """[N, K], the share of each step that is done at ``times`` [N] s."""
        ends = torch.linspace(self.begin, self.end, self.waypoints + 1, dtype=torch.float64)
        s = ((times.double()[:, None] - ends[:-1]) / ends.diff()).clamp(0.0, 1.0)
        return s**3 * (10 - 15 * s + 6 * s * s)


def stepwise(course: Course) -> Course:
    """The same gripper, to which steps are added."""
    return replace(course, span=Stepwise(*course.span))


class Tried(NamedTuple):
    """One finished motion."""

    distance: float  # m, from the goal at the end
    at: Tensor  # [N] steps, as ``Task`` has unknowns


class ReachEnv(gymnasium.Env):
    """One episode is one motion of the grippers; each action is one step of all of them.

    Observation: places of some vertices from the goal's middle, their velocities, where the grippers' coordinates have
    gone, and how much of the motion is over. Action: the step of every coordinate, as a share of the largest that the
    limits allow. Reward: minus the distance from the goal over that of the recorded motion's end, after every step;
    where cloth is torn, what ends the motion, for every step that is left as much as the last, and 5 at least.

    Args:
        task: with ``stepwise`` courses and one model.
        on_motion: called after every finished motion.
    """

    metadata: dict[str, Any] = {"render_modes": []}

    def __init__(self, task: Task, on_motion: Callable[[Tried], None] = lambda tried: None) -> None:
        self.task, self.on_motion = task, on_motion
        self.run = task.rehearsals[0]
        course = task.courses[0]
        self.stretches = course.span.waypoints
        self.ends = np.linspace(course.span.begin, course.span.end, self.stretches + 1)
        self.last = float(course.t[-1])  # of the wait
        numbered = task.split(torch.arange(len(task.start)))
        self.own = [torch.cat([z[k] for z in numbered]) for k in range(self.stretches)]  # unknowns of each stretch
        self.count = len(self.own[0])
        self.vertices = _far_apart(self.run.state.x, SEEN)
        self.middle = task.goal.points.mean(0).to(self.run.state.x)
        self.first = max(task.look(task.start)[0], 1e-9)
        self.reach = _reach(task)
        size = 6 * len(self.vertices) + self.count + 1
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32)
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
        acceleration: float = ACCELERATION,
        limits: Limits = Limits(),  # noqa: B008 - a tuple
        clearance: float = 0.02,
        dt: float | None = None,
    ) -> ReachEnv:
        """The scene of ``tc.plan`` with the same arguments, with one decision for each waypoint; doubts are warnings.

        Raises:
            InvalidInput: no cloth, or as ``tc.plan``.
            RecordingError: as there.
        """
        if not isinstance(cloth, Cloth):
            raise InvalidInput("cloth", got=type(cloth).__name__, expected="one Cloth")
        asked = Asked(waypoints, wait, acceleration, limits, clearance, dt)
        task, doubts = posed(cloth, recording, goal, asked, course=stepwise)
        for doubt in doubts:
            warnings.warn(doubt, stacklevel=2)
        return cls(task)

    def reset(self, *, seed: int | None = None, options: Mapping[str, Any] | None = None):
        """The cloth at rest where it is first."""
        super().reset(seed=seed)
        self.at, self.done, self.state = self.task.start.clone(), 0, self.run.state
        self.away = float(self.task.aims[0].distance(self.state.x))
        return self._seen(), {}

    def step(self, action: np.ndarray):
        """One stretch of time; the last one with the wait."""
        k = self.done
        share = torch.as_tensor(np.asarray(action, dtype=np.float64)).clamp(-1.0, 1.0)
        up, down = (reach[self.own[k]] for reach in self.reach)
        wanted = share * torch.where(share > 0, up, down)
        after = self.at.clone()
        after[self.own[k]] = self._allowed(k, wanted)
        if self.task.clear(after):
            self.at = after
        self.done += 1
        over = self.done == self.stretches
        end = self.last if over else float(self.ends[self.done])
        try:
            with torch.no_grad():
                self.state = self.run.go_on(self.state, self.task.motion(self.at), float(self.ends[k]), end)
            distance = self.away = float(self.task.aims[0].distance(self.state.x))
            reward = -distance / self.first
        except SimulationDiverged:  # cloth that is torn: the motion ends, and nothing is gained by ending it early
            distance, over = math.inf, True
            reward = -(self.stretches - k) * max(TORN, self.away / self.first)
        if over:
            self.on_motion(Tried(distance, self.at))
        return self._seen(), reward, over, False, {"distance": distance}

    def _allowed(self, k: int, wanted: Tensor) -> Tensor:
        """The steps of stretch ``k`` nearest to these that keep the limits after what has been done."""
        bounds, done = self.task.bounds, self.task.bounds.rows @ self.at
        own = self.own[k]
        left = bounds._replace(
            rows=bounds.rows[:, own], low=bounds.low - done, high=bounds.high - done, groups=bounds.groups[own]
        )
        return step_within(torch.zeros_like(wanted), -wanted, torch.eye(len(wanted)).to(wanted), left)

    def _seen(self) -> np.ndarray:
        x, v = self.state.x[self.vertices] - self.middle, self.state.v[self.vertices]
        gone = torch.cat([z.sum(0) for z in self.task.split(self.at)])
        parts = [(x / SIZE).flatten(), v.flatten(), gone, gone.new_tensor([self.done / self.stretches])]
        return torch.cat(parts).numpy().astype(np.float32)


def _reach(task: Task) -> tuple[Tensor, Tensor]:
    """[N] each, the largest step of each coordinate alone that the limits allow, up and down."""
    rows, high, low = task.bounds.rows, task.bounds.high[:, None], task.bounds.low[:, None]
    most = lambda way: torch.where(  # noqa: E731
        way * rows > 1e-12, high / (way * rows), torch.where(way * rows < -1e-12, low / (way * rows), torch.inf)
    ).amin(0)
    return most(1.0), most(-1.0)


def _far_apart(x: Tensor, count: int) -> Tensor:
    """Indices of vertices, each the farthest from those before."""
    chosen, distance = [0], (x - x[0]).norm(dim=1)
    while len(chosen) < min(count, len(x)):
        chosen.append(int(distance.argmax()))
        distance = torch.minimum(distance, (x - x[chosen[-1]]).norm(dim=1))
    return torch.tensor(chosen)
