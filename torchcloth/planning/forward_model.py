"""The cloth under a motion: simulation from the episode's first shape to the end of the wait, for one cloth model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from ..cloth import Cloth
from ..episodes.observed import DEFAULT_FRAME_RATE_HZ, Episode, build_episode
from ..episodes.replay import SETTLE_TIME_S, Frames, first_state, frames_from_rollout
from ..episodes.world import MAX_CLOCK_DELAY_S, World, WorldModel
from ..recordings import Recording
from ..simulation.sensitivities import Directions
from ..types import ClothState, Trajectory
from .episode_conversion import extend_at_rest
from .motion_parameters import GripperMotionParameters

DIRECTION_DIFFERENCE_STEP = 1e-3  # finite-difference step along a direction, for errors of robot and observer


class ForwardModel:
    """A cloth model that is ready to be simulated under any motion of the planned grippers.

    Args:
        model: the cloth, the errors of the robot and the observer.
        recording: gives the first shape of the cloth.
        motions: of the grippers that are planned for; all others move as recorded.
        dt: s, largest substep; None: the stable one.
    """

    def __init__(
        self, model: WorldModel, recording: Recording, motions: Sequence[GripperMotionParameters], dt: float | None
    ) -> None:
        self.world, self.dt = model.build_world(), dt
        self.world.cloth.requires_grad_(False)
        self.mesh = model.base.cloth.mesh  # the observer's mesh; the simulated one may differ where a grip ends
        self.faces = torch.as_tensor(self.mesh.faces)
        episode = build_episode(model.base.cloth, recording, DEFAULT_FRAME_RATE_HZ)
        span, last = motions[0].span, float(motions[0].t[-1])
        count = max(1, round((last - span.begin) * DEFAULT_FRAME_RATE_HZ))
        self.times = torch.linspace(span.begin, last, count + 1, dtype=torch.float64)
        delayed = [last + MAX_CLOCK_DELAY_S] if self.world.observation_transforms else []  # what a delayed clock sees
        times = torch.cat([self.times, self.times.new_tensor(delayed)])
        no_points = [episode.initial.new_zeros(0, 3)] * len(times)
        others = {name: extend_at_rest(path, float(times[-1])) for name, path in episode.motion.items()}
        self.episode_template: Episode = replace(
            episode,
            motion=others,
            times=times,
            clouds=no_points,
            markers=None,
            marker_places=None,
            wrenches={},
            unobserved_count=0,
        )
        with torch.no_grad():
            self._first = self._commanded({m.name: m.trajectory(m.zero_waypoints) for m in motions})
            driven = self.world.apply_motion(self._first)
            state = first_state(self.world.cloth, driven)
            if driven.needs_settling:  # all motions start at the recorded pose, so the settled state is the same
                state = self.world.cloth.settle(state, driven.motion, start=span.begin, duration=SETTLE_TIME_S)
            self.state = state

    def simulate(self, motion: Mapping[str, Trajectory]) -> Tensor:
        """Return the observed cloth [T, V, 3] m under the given motions; differentiable in their poses."""
        driven = self._driven(motion)
        rollout = self.world.cloth(self.state, driven.motion, self.episode_template.times, dt=self.dt)
        return self._observe(frames_from_rollout(rollout), driven)

    def simulate_interval(
        self, state: ClothState, motion: Mapping[str, Trajectory], begin: float, end: float
    ) -> ClothState:
        """Return the cloth's state at ``end`` [s] under the given motions, from its state at ``begin`` [s]."""
        return self.world.cloth(state, self._driven(motion).motion, [begin, end], dt=self.dt, checkpoint=False).state

    def linearise_final_shape(
        self, motion: Mapping[str, Trajectory], pose_derivatives: Mapping[str, Tensor]
    ) -> tuple[Tensor, Tensor]:
        """Return the observed final shape and its derivatives along N directions.

        Args:
            motion: the poses by gripper.
            pose_derivatives: [N, K, 4, 4] by gripper, derivatives of the poses along the directions.

        Returns:
            [V, 3] m and [N, V, 3] m.
        """
        driven, along = self._driven(motion), self._motion_tangents(motion, pose_derivatives)
        rollout, tangent_rollout = self.world.cloth.sensitivities(
            self.state, driven.motion, self.episode_template.times, along=Directions(motion=along), dt=self.dt
        )
        frames, tangents = frames_from_rollout(rollout), frames_from_rollout(tangent_rollout)
        x = self._observe(frames, driven)[-1]
        if not self.world.observation_transforms:
            return x, tangents.x[:, -1]
        shifted = [self._observe(_nudged(frames, tangents, k), driven)[-1] for k in range(len(tangents.x))]
        return x, (torch.stack(shifted) - x) / DIRECTION_DIFFERENCE_STEP

    def identity(self) -> list[object]:
        """Return everything but the cloth and the motion that simulations depend on."""
        return [*self.world.fingerprint_parts(self._first), *self.state[:3], self.dt]

    def _driven(self, motion: Mapping[str, Trajectory]) -> Episode:
        return self.world.apply_motion(self._commanded(motion))

    def _commanded(self, motion: Mapping[str, Trajectory]) -> Episode:
        extended = {name: extend_at_rest(m, float(self.episode_template.times[-1])) for name, m in motion.items()}
        cast = {name: m._replace(pose=m.pose.to(self.episode_template.initial)) for name, m in extended.items()}
        return replace(self.episode_template, motion={**self.episode_template.motion, **cast})

    def _motion_tangents(
        self, motion: Mapping[str, Trajectory], pose_derivatives: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        """Tangents of the executed motion; by finite differences if the robot has errors, which are any function."""
        executed, count = self._driven(motion).motion, len(next(iter(pose_derivatives.values())))
        if not self.world.motion_transforms:
            tangents = {}
            for name, derivatives in pose_derivatives.items():
                appended = len(executed[name].t) - derivatives.shape[1]  # knots at which the gripper stands still
                extended = torch.cat([derivatives, derivatives[:, -1:].expand(-1, appended, 4, 4)], 1)
                tangents[name] = extended.to(self.state.x)
            return tangents
        steps = []
        for k in range(count):
            nudged = {
                name: m._replace(pose=m.pose + DIRECTION_DIFFERENCE_STEP * pose_derivatives[name][k])
                for name, m in motion.items()
            }
            steps.append(self._driven(nudged).motion)
        return {
            name: torch.stack([(s[name].pose - executed[name].pose) / DIRECTION_DIFFERENCE_STEP for s in steps])
            for name in pose_derivatives
        }

    def _observe(self, frames: Frames, driven: Episode) -> Tensor:
        return self.world.observe(frames, driven).x[: len(self.times)]


def exact_model(cloth: Cloth) -> WorldModel:
    """Return a cloth as a model whose robot and observer have no errors. The cloth is not copied."""
    return WorldModel(World(cloth), (), torch.zeros(0))


def _nudged(frames: Frames, tangents: Frames, k: int) -> Frames:
    step = DIRECTION_DIFFERENCE_STEP
    return frames._replace(x=frames.x + step * tangents.x[k], v=frames.v + step * tangents.v[k])
