"""Conversion of an episode to parametrised motions of its grippers, and of planned motions to an episode."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from .._utils.linalg import find_last_knot
from ..boundaries.motion import interpolate_poses
from ..cloth import Cloth
from ..episodes.observed import DEFAULT_FRAME_RATE_HZ, build_episode
from ..errors import InvalidInput
from ..recordings import Recording
from ..recordings.templates import as_template
from ..robots import (  # pyright: ignore[reportMissingImports] - mapped from robots/ at installation
    arm_from_recording,
    replay,
    to_gripper_motion,
)
from ..robots.primitives import GripperLimits  # pyright: ignore[reportMissingImports]
from ..robots.replan_episode import MIN_TABLE_NORMAL_Z, max_table_height  # pyright: ignore[reportMissingImports]
from ..robots.replay import locate_model, unwrap_joints  # pyright: ignore[reportMissingImports]
from ..robots.spline import subdivide_times  # pyright: ignore[reportMissingImports]
from ..types import Trajectory
from .deceleration import Deceleration, gripper_coordinates
from .motion_parameters import (
    BOUND_CHECK_PERIOD_S,
    FREE_GRIPPER_TURN_LIMITS,
    ArmMotionParameters,
    FreeGripperMotionParameters,
    GripperMotionParameters,
    SplineSpan,
    interpolate_monotone,
    rotation_matrix,
)
from .result import PLANNED_PROVENANCE

MIN_WAYPOINT_SPACING_S = 0.1  # motions through nearer waypoints tremble
KNOT_MERGE_TIME_S = 1e-6  # knots that are nearer to each other are one
STOPPING_TIME_S = 0.01  # time to stop a gripper that moves where its recording ends
MIN_REPORTED_DECELERATION_S = 0.02  # shorter decelerations give no warning
MIN_REPORTED_SPEED_M_PER_S = 0.02  # slower starts give no warning
MIN_LEVEL_TABLE_COSINE = 0.9999  # cosine of a table's slope; below it the table counts as inclined


def extract_motion_parameters(
    cloth: Cloth, recording: Recording, waypoints: int, wait: float, acceleration: float, limits: GripperLimits
) -> list[GripperMotionParameters]:
    """Extract the parametrised motion of every gripper that holds the cloth.

    A motion spans the time from the first frame to the end of the recording and a wait after it. A gripper that is
    under way coordinates the end comes to rest in the wait.

    Args:
        cloth: the cloth.
        recording: the episode.
        waypoints: number of waypoints of each gripper.
        wait: s, time after the end of the recording.
        acceleration: rad/s^2, largest acceleration of a joint.
        limits: of a gripper without an arm.

    Raises:
        InvalidInput: no gripper holds the cloth, a gripper takes hold after the first frame, or waypoints are too near
            to each other.
        RecordingError: the episode has no motion for one of the cloth's grasps.
    """
    episode = build_episode(cloth, recording, DEFAULT_FRAME_RATE_HZ)
    recorded_paths = replay(recording, names=episode.motion)
    begin = float(episode.times[0])
    names = [n for n in episode.motion if n in recording.grasps and _is_ever_closed(recorded_paths[n], begin)]
    if not names:
        expected = "a gripper that holds the cloth, whose motion to change"
        raise InvalidInput("recording", got="no grasp that is closed from the first frame on", expected=expected)
    end = min(float(recorded_paths[name].t[-1]) for name in names)
    if end - begin < waypoints * MIN_WAYPOINT_SPACING_S:
        got = f"{waypoints} of {max(end - begin, 0):.3g} s of motion after the first frame"
        remedy = "ask for fewer, or begin with a longer motion"
        expected = f"{MIN_WAYPOINT_SPACING_S:g} s or more for each"
        raise InvalidInput("waypoints", got=got, expected=expected, remedy=remedy)
    arms = {n: arm_from_recording(recording, n) for n in names if n in recording.joints and n in recording.robots}
    angles = {n: torch.as_tensor(unwrap_joints(arm, recording.joints[n].q)) for n, arm in arms.items()}
    paths = {n: recorded_paths[n]._replace(pose=recorded_paths[n].pose.double()) for n in names}
    decelerations: dict[str, Deceleration] = {}
    for n, path in paths.items():
        coordinates = partial(interpolate_monotone, path.t, angles[n]) if n in arms else gripper_coordinates(path, end)
        free = [limits.acceleration] * 3 + [FREE_GRIPPER_TURN_LIMITS.acceleration] * 3
        max_acceleration = torch.tensor([acceleration] if n in arms else free, dtype=torch.float64)
        decelerations[n] = Deceleration.estimate(coordinates, begin, end, wait, max_acceleration)
    span = SplineSpan(
        begin, end, waypoints, max(float(deceleration.allotted_time.max()) for deceleration in decelerations.values())
    )
    knots = _merge_knots([path.t for path in paths.values()], span, wait)
    recorded = knots.clamp(max=end)  # then all deceleration and wait, and what was recorded longer as well
    motions: list[GripperMotionParameters] = []
    for n, path in paths.items():
        closed = path.closed[find_last_knot(path.t, knots + KNOT_MERGE_TIME_S).clamp(min=0)]
        _check_hold(n, closed)
        displacement = decelerations[n].displacement(knots)
        if n in arms:
            q = interpolate_monotone(path.t, angles[n], recorded) + displacement
            motions.append(ArmMotionParameters(n, knots, closed, span, decelerations[n], arms[n], q, acceleration))
        else:
            pose = interpolate_poses(path, recorded)
            table = max_table_height(recording.colliders, pose[:, :2, 3].numpy())
            lowest = min(table, float(pose[:, 2, 3].min()))
            pose[:, :3] = torch.cat(
                [rotation_matrix(displacement[:, 3:]) @ pose[:, :3, :3], pose[:, :3, 3:] + displacement[:, :3, None]], 2
            )
            motions.append(FreeGripperMotionParameters(n, knots, closed, span, decelerations[n], pose, limits, lowest))
    return motions


def build_planned_episode(
    recording: Recording, motions: Sequence[GripperMotionParameters], waypoints: Sequence[Tensor]
) -> Recording:
    """Return the episode with the planned motions and without any observation.

    Args:
        recording: the episode that the plan began with.
        motions: parametrised motions of the planned grippers.
        waypoints: [K, C] of each motion.
    """
    planned = list(zip(motions, waypoints, strict=True))
    grippers = {c.name: to_gripper_motion(_detached(c.trajectory(z))) for c, z in planned}
    joints = {name: recorded for name, recorded in recording.joints.items() if name not in grippers}
    joints |= {c.name: c.joint_motion(z) for c, z in planned if isinstance(c, ArmMotionParameters)}
    robots = {name: replace(robot, model=locate_model(recording, name)) for name, robot in recording.robots.items()}
    template = as_template(recording, PLANNED_PROVENANCE)
    return replace(
        template,
        grippers={**template.grippers, **grippers},
        joints=joints,
        robots=robots,
        clock_offset=0.0,
        split={**recording.split, "motion": "planned", "replicate_of": None},
        path=None,
    )


def motion_warnings(recording: Recording, motions: Sequence[GripperMotionParameters]) -> list[str]:
    """Return what a reader should know about the recorded motion that was planned from, in sentences."""
    warnings, begin = [], motions[0].span.begin
    recorded_paths = replay(recording, names=[motion.name for motion in motions])
    for motion in motions:
        path = recorded_paths[motion.name]
        speed = (path.pose[1:, :3, 3] - path.pose[:-1, :3, 3]).norm(dim=-1) / path.t.diff()
        starts_later = begin > float(path.t[0]) + KNOT_MERGE_TIME_S
        first_speed = float(speed[find_last_knot(path.t, path.t.new_tensor([begin]))[0]])
        if starts_later and first_speed > MIN_REPORTED_SPEED_M_PER_S:
            warnings.append(
                f"{motion.name}: the planned motion begins at the first frame, {begin - float(path.t[0]):.2f} s after "
                "the recorded one, which is under way there: bring the arm there as recorded"
            )
        end, needed = motion.span.end, float(motion.deceleration.required_time.max())
        wait = float(motion.t[-1]) - end
        if needed > MIN_REPORTED_DECELERATION_S:
            known = f"{motion.name}: the recorded motion is under way where it ends, at {end:.2f} s"
            if needed <= wait + KNOT_MERGE_TIME_S:
                warnings.append(f"{known}: it takes {needed:.2f} s of the wait to come to rest")
            else:
                warnings.append(
                    f"{known}, and cannot come to rest in a wait of {wait:.2f} s: wait {needed:.2f} s or longer"
                )
    hands = ", ".join(c.name for c in motions if isinstance(c, FreeGripperMotionParameters))
    for name, collider in recording.colliders.items() if hands else ():
        if collider.normal[2] <= MIN_TABLE_NORMAL_Z:
            warnings.append(f"{hands}: {name} is too steep for a table: grippers may pass through it")
        elif collider.normal[2] < MIN_LEVEL_TABLE_COSINE:
            warnings.append(f"{hands}: {name} is inclined: grippers keep above its height below the recorded path only")
    if free := [c.name for c in motions if isinstance(c, FreeGripperMotionParameters) and c.name in recording.robots]:
        names = ", ".join(free)
        warnings.append(f"{names}: an arm is named, but its joints were not recorded: joint limits are not checked")
    return warnings


def extend_at_rest(path: Trajectory, last: float) -> Trajectory:
    """Return a path that stands still after its end, until ``last`` [s] or later."""
    end = float(path.t[-1])
    if end >= last:
        return path
    more = path.t.new_tensor([last] if last - end < 2 * STOPPING_TIME_S else [end + STOPPING_TIME_S, last])
    pose, closed = (
        torch.cat([field, field[-1:].expand(len(more), *field.shape[1:])]) for field in (path.pose, path.closed)
    )
    return Trajectory(torch.cat([path.t, more]), pose, closed)


def _is_ever_closed(path: Trajectory, begin: float) -> bool:
    return bool(
        path.closed[find_last_knot(path.t, path.t.new_tensor([begin + KNOT_MERGE_TIME_S])).clamp(min=0) :].any()
    )


def _check_hold(name: str, closed: Tensor) -> None:
    """Refuse a gripper that takes hold later: cloth follows increments of its pose, so an offset would be ignored."""
    if not bool(closed[0]) or bool((closed[1:] & ~closed[:-1]).any()):
        when = "after the first frame" if not bool(closed[0]) else "again"
        raise InvalidInput(
            f"gripper {name!r}",
            got=f"one that takes hold {when}",
            expected="grippers that hold the cloth from the first frame until they let go",
            remedy="plan from an episode that begins when it has closed",
        )


def _merge_knots(times: Sequence[Tensor], span: SplineSpan, wait: float) -> Tensor:
    """Knots [S] s: the ends of span and wait, all recorded knots, and more where these are far apart."""
    ends = times[0].new_tensor([span.begin, span.end, span.end + wait])
    knots = torch.cat([*times, ends]).double().unique()
    knots = knots[(knots >= span.begin) & (knots <= span.end + wait)]
    knots = knots[torch.cat([knots.new_ones(1), knots.diff()]) > KNOT_MERGE_TIME_S]
    return subdivide_times(knots, BOUND_CHECK_PERIOD_S)


def _detached(path: Trajectory) -> Trajectory:
    return path._replace(pose=path.pose.detach())
