"""Joint motions that the arms can execute, for paths of their grippers: within limits, and clear of all solids."""

from __future__ import annotations

import math
from collections.abc import Mapping
from copy import deepcopy
from itertools import product
from typing import NamedTuple

import torch
from torch import Tensor

from torchcloth.errors import InvalidInput
from torchcloth.recordings import JointMotion
from torchcloth.types import Trajectory

from .arm import Arm
from .clearance import Gap
from .collision_checks import COLLISION_CHECK_PERIOD_S, check_between_arms, check_self_and_table
from .grasp_orientations import GraspOrientation, approach_heading, list_candidates
from .inverse import bound_reach
from .path_following import (
    JointPath,
    PathTask,
    RequiredSlowdown,
    densify_dwells,
    rank_orientations,
    required_slowdown,
    solve_joint_path,
)
from .primitives import Action
from .scene import Scene
from .spline import ClampedSpline, subdivide_times

# Flexiv publishes no joint accelerations; 3 rad/s^2 is what the examples of its RDK command (flexiv_rdk @ dca9a15).
DEFAULT_JOINT_ACCELERATION = 3.0  # rad/s^2
MAX_PATHS_PER_ARM = 3  # joint paths of each arm that are combined with those of the others
SLOWDOWN_MARGIN = 1.002  # factor of the duration beyond what the samples require, for limits between samples
KNOT_TIME_TOLERANCE_S = 1e-9  # knots that are nearer to each other are one


class JointPlan(NamedTuple):
    """Joint motions of all arms of a scene on common knots.

    Attributes:
        t: [K] s.
        q: [K, J] rad by arm.
        closed: [K] bool by arm.
        release_time: s, when the grippers open.
        slowdown: duration over the duration that was asked for.
        limiting_joint: joint, arm and limit that are nearest to their bound.
        smallest_gap: the solids that come nearest to each other, without fingers at the table.
        orientations: of the tools, by arm.
    """

    t: Tensor
    q: dict[str, Tensor]
    closed: dict[str, Tensor]
    release_time: float
    slowdown: float
    limiting_joint: str
    smallest_gap: Gap
    orientations: dict[str, GraspOrientation]

    def __repr__(self) -> str:
        near = f"{self.smallest_gap.first} to {self.smallest_gap.second}, " if self.smallest_gap.first else "at least "
        return (
            f"JointPlan({', '.join(self.q)}: {float(self.t[-1]):.3g} s, {self.slowdown:.3g} times as long as asked, "
            f"limited by {self.limiting_joint}; nearest: {near}{1e3 * self.smallest_gap.distance:.3g} mm)"
        )

    def motion(self, scene: Scene) -> dict[str, Trajectory]:
        """Return the poses by gripper that follow from the joint motions."""
        return {name: Trajectory(self.t, scene[name](self.q[name]).detach(), self.closed[name]) for name in self.q}

    def joint_motions(self) -> dict[str, JointMotion]:
        """Return the joint motions as a recording stores them.

        With ``scene.robot_infos()`` for the recording's robots, ``replay`` gives the same poses.
        """
        t = self.t.numpy()
        return {name: JointMotion(t, q.numpy(), closed=self.closed[name].numpy()) for name, q in self.q.items()}


def plan(
    scene: Scene,
    action: Action,
    *,
    acceleration: float = DEFAULT_JOINT_ACCELERATION,
    clearance: float = 0.02,
    slow_down: bool = True,
    period: float = 0.01,
    orientations: Mapping[str, GraspOrientation] | None = None,
) -> JointPlan:
    """Compute joint motions that lead the grippers along their paths.

    Each arm tries many directions of its tool and postures. It takes the one that needs least slowing down and collides
    with nothing. The plan checks reach, soft position limits, velocity limits and accelerations. It checks the
    distances of all solids every 20 ms of the path, and that the grippers stay within 0.1 mm of the path, between knots
    too.

    Args:
        scene: the arms, and the table if there is one.
        action: paths of grippers that have the names of arms; an arm without a path stands still at home. If the motion
            is slowed down, all times are multiplied, that of its beginning too.
        acceleration: rad/s^2, the largest of any joint; see ``DEFAULT_JOINT_ACCELERATION``.
        clearance: m, between two arms, and between an arm and the table. The solids of the tool's own frame (the
            fingers) may come down to the table. Links of one arm keep 5 mm.
        slow_down: allow a longer duration if the joints' limits require it; otherwise such a motion is refused.
        period: s, the longest time between two knots of the result.
        orientations: of the tools, by arm, instead of a search.

    Raises:
        InvalidInput: names the joint or the pair of solids that prevents the motion, with value, limit and time.
    """
    for name in scene.arms:
        if links := scene[name].links_without_primitives:
            raise InvalidInput(
                f"solids of {name!r}",
                got=f"only meshes at {', '.join(links)}",
                expected="boxes, cylinders or spheres, whose distances can be computed",
                remedy="describe these links by such solids in the URDF's collisions",
            )
    if unknown := action.motion.keys() - scene.arms.keys():
        raise InvalidInput("action moves unknown arms", got=sorted(unknown), expected=f"among {list(scene.arms)}")
    if unknown := (orientations or {}).keys() - scene.arms.keys():
        raise InvalidInput("orientations of unknown arms", got=sorted(unknown), expected=f"among {list(scene.arms)}")
    if not action.motion:
        raise InvalidInput("action", got="no motion", expected=f"a path for one or more of {list(scene.arms)}")
    for name, value in {"acceleration": acceleration, "clearance": clearance, "period": period}.items():
        if not (math.isfinite(value) and value > 0):
            raise InvalidInput(name, got=value, expected="a finite value > 0")
    detached = {id(part): part.detach().clone() for part in scene.buffers()}  # a base may belong to a graph
    scene = deepcopy(scene, detached).cpu().double()  # float32 is too coarse for the tolerances of the solver
    exact = {n: Trajectory(path.t.double(), path.pose.double(), path.closed) for n, path in action.motion.items()}
    action = action._replace(motion=exact)
    spans = {name: path.t[[0, -1]].tolist() for name, path in action.motion.items()}
    if any(max(ends) - min(ends) > KNOT_TIME_TOLERANCE_S for ends in zip(*spans.values(), strict=True)):
        got = ", ".join(f"{name} {first:g} to {last:g} s" for name, (first, last) in spans.items())
        raise InvalidInput("paths of the action", got=got, expected="one beginning and one end for all arms")
    for name, path in action.motion.items():
        _check_reach(scene[name], name, path)
    options = {
        name: _joint_paths(scene, name, action, acceleration, clearance, (orientations or {}).get(name))
        for name in scene.arms
    }
    errors = []
    for combination in sorted(product(*options.values()), key=lambda paths: max(p.slowdown.factor for p, _ in paths)):
        chosen = {name: path for name, (path, _) in zip(options, combination, strict=True)}
        gap = check_between_arms(scene, {name: path.spline for name, path in chosen.items()}, clearance)
        if gap.distance >= clearance:
            smallest = min([gap, *(arm_gap for _, arm_gap in combination)], key=lambda gap: gap.distance)
            return _assemble_plan(scene, action, chosen, smallest, slow_down, period)
        errors.append(gap.to_error(clearance))
    raise errors[0]


def _joint_paths(
    scene: Scene, name: str, action: Action, acceleration: float, clearance: float, orientation: GraspOrientation | None
) -> list[tuple[JointPath, Gap]]:
    """A few joint paths of one arm that are clear of the table and of itself, fastest first."""
    arm = scene[name]
    limit = torch.full_like(arm.home, acceleration)
    if name not in action.motion:
        times = next(iter(action.motion.values())).t[[0, -1]]
        still = ClampedSpline(times, arm.home.expand(2, -1).to(times))
        gap, error = check_self_and_table(scene, name, arm.home.expand(2, -1), times, clearance)
        if error is not None:
            what, remedy = f"the idle arm: {error.what}", "lower the table, or leave that arm out of the scene"
            raise InvalidInput(what, got=error.got, expected=error.expected, remedy=remedy)
        return [(JointPath(GraspOrientation(), still, required_slowdown(arm, still, limit)), gap)]

    def check(q: Tensor, times: Tensor) -> InvalidInput | None:
        return check_self_and_table(scene, name, q, times, clearance)[1]

    task = PathTask(arm, densify_dwells(action.motion[name]), approach_heading(name, action.motion, arm), limit, check)
    paths: list[tuple[JointPath, Gap]] = []
    errors: list[InvalidInput] = []
    for candidate in rank_orientations(task, list_candidates() if orientation is None else [orientation]):
        try:
            path = solve_joint_path(task, candidate)
        except InvalidInput as error:
            errors.append(error)
            continue
        q, times = path.spline.sample(COLLISION_CHECK_PERIOD_S)
        paths.append((path, check_self_and_table(scene, name, q, times, clearance)[0]))
        if len(paths) == MAX_PATHS_PER_ARM:
            break
    if not paths:
        raise errors[0]
    return sorted(paths, key=lambda option: option[0].slowdown.factor)


def _check_reach(arm: Arm, name: str, path: Trajectory) -> None:
    """Refuse a path beyond the length of the arm at once; the search would take long to find that out."""
    shoulder, longest = bound_reach(arm, arm.home)
    distance = (path.pose[:, :3, 3].to(shoulder) - shoulder).norm(dim=-1)
    if float(distance.max()) > longest:
        raise InvalidInput(
            f"the path of {name!r} leaves the reach of {arm.name!r} at t = {float(path.t[distance.argmax()]):.3g} s",
            got=f"{float(distance.max()):.3g} m from the shoulder",
            expected=f"less than {longest:.3g} m, the arm stretched out",
            remedy="move the grips or the path nearer to the arm",
        )


def _assemble_plan(
    scene: Scene, action: Action, chosen: dict[str, JointPath], gap: Gap, slow_down: bool, period: float
) -> JointPlan:
    """All arms slowed down by one factor, sampled at every knot of the path and between."""
    name, hardest = max(chosen.items(), key=lambda item: item[1].slowdown.factor)
    factor = SLOWDOWN_MARGIN * hardest.slowdown.factor if hardest.slowdown.factor > 1 else 1.0
    if factor > 1 and not slow_down:
        raise _too_fast(scene, name, hardest.slowdown)
    splines = {key: path.spline.slow_down(factor) for key, path in chosen.items()}
    knots = torch.cat([densify_dwells(path).t for path in action.motion.values()]).unique()
    knots = knots[torch.cat([knots.new_ones(1, dtype=torch.bool), knots.diff() > KNOT_TIME_TOLERANCE_S])]
    t = subdivide_times(factor * knots, period)

    def closed(name: str) -> Tensor:
        if name not in action.motion:
            return torch.zeros(len(t), dtype=torch.bool)
        path = action.motion[name]
        return path.closed[torch.searchsorted(factor * path.t, t + KNOT_TIME_TOLERANCE_S, right=True) - 1]

    return JointPlan(
        t=t,
        q={key: spline.positions(t) for key, spline in splines.items()},
        closed={key: closed(key) for key in chosen},
        release_time=factor * action.release_time,
        slowdown=factor,
        limiting_joint=f"{scene[name].joint_names[hardest.slowdown.joint]} of {name}: {hardest.slowdown.quantity}",
        smallest_gap=gap._replace(time=factor * gap.time),
        orientations={key: path.orientation for key, path in chosen.items()},
    )


def _too_fast(scene: Scene, name: str, slowdown: RequiredSlowdown) -> InvalidInput:
    unit = "rad/s" if slowdown.quantity == "velocity" else "rad/s^2"
    return InvalidInput(
        f"the motion breaks the {slowdown.quantity} limit of {scene[name].joint_names[slowdown.joint]!r} of {name!r} "
        f"at t = {slowdown.time:.3g} s",
        got=f"{slowdown.value:.3g} {unit}",
        expected=f"at most {slowdown.limit:.3g} {unit}",
        remedy=f"let it take {SLOWDOWN_MARGIN * slowdown.factor:.3g} times as long (slow_down=True), or ask for less",
    )
