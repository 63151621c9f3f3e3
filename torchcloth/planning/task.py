"""The planning task: find waypoints of all grippers after which the simulated cloth lies at the goal."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

import torch
from torch import Tensor
from torch.func import jacfwd

from .._utils.resume import ResumableStore
from ..robots.clearance import Gap  # pyright: ignore[reportMissingImports] - mapped from robots/ at installation
from ..types import Trajectory
from .clearance import ArmClearance
from .forward_model import ForwardModel
from .goal import Goal
from .motion_parameters import GripperMotionParameters, LinearBounds
from .objective import QuadraticModel, average_models, build_objective

ROTATION_LEVER_ARM_M = 0.1  # turns the rotation of a gripper into an equivalent displacement
METRIC_REGULARISATION_M2 = 1e-3  # for unknowns that move no gripper
T = TypeVar("T", bound=Sequence)


class PlanningTask:
    """The distance between cloth and goal as a function of all waypoints; see ``optimizers.SearchProblem``.

    All distances are means over the models. The unknowns [N] are the waypoints [K, C] of the grippers, flattened, one
    gripper after the other.

    Args:
        forward_models: one for each cloth model.
        motions: parametrised motions of the grippers.
        goal: where the cloth shall be.
        clearance: check of the arms; None if there is none.
        store: keeps computed results, so that a stopped search can resume.
    """

    def __init__(
        self,
        forward_models: Sequence[ForwardModel],
        motions: Sequence[GripperMotionParameters],
        goal: Goal,
        clearance: ArmClearance | None,
        store: ResumableStore | None,
    ) -> None:
        self.forward_models, self.motions, self.goal = forward_models, motions, goal
        self.bounds, self._clearance, self._store = LinearBounds.concatenate(motions), clearance, store
        self.objectives = [build_objective(goal, model.mesh) for model in forward_models]
        self.start = torch.cat([motion.zero_waypoints.flatten() for motion in motions])
        self.metric = self._path_metric()

    def motion(self, at: Tensor) -> dict[str, Trajectory]:
        """Return the poses by gripper at the unknowns [N]; differentiable."""
        return {m.name: m.trajectory(z) for m, z in zip(self.motions, self.split_waypoints(at), strict=True)}

    def split_waypoints(self, at: Tensor) -> list[Tensor]:
        """Split the unknowns [N] into the waypoints [K, C] of each gripper."""
        shapes = [motion.zero_waypoints.shape for motion in self.motions]
        return [part.reshape(s) for part, s in zip(at.split([s.numel() for s in shapes]), shapes, strict=True)]

    @torch.no_grad()
    def evaluate(self, at: Tensor) -> tuple[float, float]:
        """Return the distance [m] and the mean square distance [m^2] at the unknowns [N]."""
        distance, mean_square = self._compute("evaluate", at, lambda: self._evaluate(at))
        return float(distance), float(mean_square)

    def quadratic_model(self, at: Tensor) -> QuadraticModel:
        """Return the local model of the mean square distance, by forward mode in constant memory (float64)."""
        return QuadraticModel(
            *(part.double() for part in self._compute("quadratic_model", at, lambda: self._quadratic_model(at)))
        )

    def distance_gradient(self, at: Tensor) -> tuple[float, Tensor]:
        """Return the distance [m] and its gradient [N], by reverse mode."""
        distance, gradient = self._compute("distance_gradient", at, lambda: self._distance_gradient(at))
        return float(distance), gradient

    def is_clear(self, at: Tensor) -> bool:
        """Return whether the arms stay clear; always true without a clearance check."""
        return self._clearance is None or self._clearance.smallest_gap(self.joint_angles(at))[1] is None

    def smallest_gap(self, at: Tensor) -> Gap | None:
        """Return the smallest distance between solids along the motion; None without a clearance check."""
        return None if self._clearance is None else self._clearance.smallest_gap(self.joint_angles(at))[0]

    def joint_angles(self, at: Tensor) -> dict[str, Tensor]:
        """Return joint angles [N, J] rad by arm at ``SplineSpan.bound_check_times``."""
        waypoints = self.split_waypoints(at)
        return {m.name: m.coordinates_at_check_times(z) for m, z in zip(self.motions, waypoints, strict=True)}

    def evaluate_models(self, at: Tensor) -> tuple[list[float], Tensor]:
        """Return the distance [m] of every model, and the frames [T, V, 3] m of the first one."""
        with torch.no_grad():
            runs = [model.simulate(self.motion(at)) for model in self.forward_models]
        distances = [
            float(objective.distance(frames[-1])) for objective, frames in zip(self.objectives, runs, strict=True)
        ]
        return distances, runs[0]

    def _compute(self, question: str, at: Tensor, work: Callable[[], T]) -> T:
        return work() if self._store is None else self._store.get_or_compute(question, at, work)

    def _evaluate(self, at: Tensor) -> tuple[Tensor, Tensor]:
        motion = self.motion(at)
        final = [(o, model.simulate(motion)[-1]) for o, model in zip(self.objectives, self.forward_models, strict=True)]
        distance = torch.stack([objective.distance(x) for objective, x in final]).mean()
        return distance, torch.tensor([objective.mean_square(x) for objective, x in final]).mean()

    def _quadratic_model(self, at: Tensor) -> QuadraticModel:
        motion, pose_derivatives = self.motion(at), self._pose_derivatives(at)
        parts = []
        for objective, model in zip(self.objectives, self.forward_models, strict=True):
            parts.append(objective.quadratic_model(*model.linearise_final_shape(motion, pose_derivatives)))
        return average_models(parts)

    def _distance_gradient(self, at: Tensor) -> tuple[Tensor, Tensor]:
        """One model after the other, so that only one graph is in memory at a time."""
        values, gradient = [], torch.zeros_like(at)
        for objective, model in zip(self.objectives, self.forward_models, strict=True):
            with torch.enable_grad():
                unknowns = at.clone().requires_grad_()
                distance = objective.distance(model.simulate(self.motion(unknowns))[-1])
                gradient += torch.autograd.grad(distance, unknowns)[0].to(gradient) / len(self.forward_models)
            values.append(distance.detach())
        return torch.stack(values).mean(), gradient

    def _pose_derivatives(self, at: Tensor) -> dict[str, Tensor]:
        """Derivatives [N, S, 4, 4] of each gripper's poses by all unknowns."""
        derivatives, done = {}, 0
        for motion, waypoints in zip(self.motions, self.split_waypoints(at), strict=True):
            by_waypoint = jacfwd(lambda w, m=motion: m.trajectory(w).pose)(waypoints)  # [S, 4, 4, K, C]
            block = by_waypoint.flatten(3).movedim(3, 0)
            before, after = (block.new_zeros(n, *block.shape[1:]) for n in (done, len(at) - done - len(block)))
            derivatives[motion.name] = torch.cat([before, block, after])
            done += len(block)
        return derivatives

    def _path_metric(self) -> Tensor:
        """Metric [N, N] m^2 at the recorded motion: mean square displacement of the grippers over time."""
        total = METRIC_REGULARISATION_M2 * torch.eye(len(self.start), dtype=torch.float64)
        for pose in self._pose_derivatives(self.start).values():
            shift, turn = pose[:, :, :3, 3].flatten(1), ROTATION_LEVER_ARM_M * pose[:, :, :3, :3].flatten(1)
            total = total + (shift @ shift.mT + 0.5 * turn @ turn.mT) / pose.shape[1]
        return total
