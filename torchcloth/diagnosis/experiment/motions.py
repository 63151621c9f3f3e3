"""Short, safe motions from the grippers' present poses, which distinguish causes.

Motions on a table stay within 17 cm of the first pose. Exceptions are the lift (42 cm) and the fold that is opened
again (39 cm; what then stays is a crease). Motions in the air stay within 5 cm. The exception is the turn, in which
each gripper moves on a quarter of a circle about the middle of all, which moves 4 cm ahead. No motion stretches the
cloth by more than 1 cm. ``training/validation/independent/motions.py`` has the same motions, so that another simulator
can carry out an experiment.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from ...episodes.observed import DEFAULT_FRAME_RATE_HZ
from ...recordings import GripperMotion, PointClouds, Recording
from ...robots import to_gripper_motion  # pyright: ignore[reportMissingImports] - mapped from robots/ at installation
from ...robots.paths import holding_paths  # pyright: ignore[reportMissingImports]
from ...robots.replay import locate_model  # pyright: ignore[reportMissingImports]
from ...robots.trajectories import minimum_jerk as path_fraction  # pyright: ignore[reportMissingImports]
from ...types import Trajectory

STILL_S = 0.2  # grippers stand still before and after a motion
KNOT_INTERVAL_S = 0.01  # between the knots of a path
MAX_LYING_HEIGHT_M = 0.03  # median height over a table of a cloth that lies on it
MIN_STRETCH_GRIPPERS = 2


@dataclass(frozen=True)
class GripperWaypoints:
    """Waypoints of the grippers relative to their poses: x ahead of the cloth, y along its upper edge, z up.

    Attributes:
        t: times of the waypoints [s].
        offset: offset of all grippers [m].
        apart: increase of the distance between grippers [m].
        yaw: rotation about the vertical through the grippers' middle [rad].
        lying: whether the cloth lies on a table at first.
    """

    t: tuple[float, ...]
    offset: tuple[tuple[float, float, float], ...]
    apart: tuple[float, ...] = ()
    yaw: tuple[float, ...] = ()
    lying: bool = False


START_OFFSET_M = (0.0, 0.0, 0.0)
LIFTED_OFFSET_M = (0.0, 0.0, 0.02)
DRAGGED_OFFSET_M = (0.16, 0.0, 0.02)
TURNED_OFFSET_M = (0.04, 0.0, 0.0)
FOLDED_OFFSET_M = (-0.22, 0.0, 0.07)
QUARTER_TURN_RAD = np.pi / 2


def _back_and_forth(amplitude: float, leg: float, cycles: int, axis: int) -> GripperWaypoints:
    offsets, times = [START_OFFSET_M], [0.0]
    for k in range(2 * cycles):
        offset = np.eye(3)[axis] * amplitude * (-1) ** k
        offsets.append((float(offset[0]), float(offset[1]), float(offset[2])))
        times.append(times[-1] + (leg if k else 0.6 * leg))
    return GripperWaypoints((*times, times[-1] + 0.6 * leg), (*offsets, START_OFFSET_M))


MOTIONS = {
    "hang": GripperWaypoints((0.0, 1.0), (START_OFFSET_M, START_OFFSET_M)),
    "swing": _back_and_forth(0.05, 0.85, 1, 0),
    "swing-fast": _back_and_forth(0.04, 0.34, 1, 0),
    "shake": _back_and_forth(0.02, 0.22, 3, 2),
    "stretch": GripperWaypoints((0.0, 0.5, 0.8, 1.3), (START_OFFSET_M,) * 4, apart=(0.0, 0.010, 0.010, 0.0)),
    "turn": GripperWaypoints(
        (0.0, 1.0, 1.3, 2.3),
        (START_OFFSET_M, TURNED_OFFSET_M, TURNED_OFFSET_M, START_OFFSET_M),
        yaw=(0.0, QUARTER_TURN_RAD, QUARTER_TURN_RAD, 0.0),
    ),
    "drag": GripperWaypoints((0.0, 0.25, 1.25), (START_OFFSET_M, LIFTED_OFFSET_M, DRAGGED_OFFSET_M), lying=True),
    "drag-fast": GripperWaypoints((0.0, 0.25, 0.70), (START_OFFSET_M, LIFTED_OFFSET_M, DRAGGED_OFFSET_M), lying=True),
    "lift": GripperWaypoints((0.0, 1.4), (START_OFFSET_M, (-0.12, 0.0, 0.40)), lying=True),
    "fold-open": GripperWaypoints(
        (0.0, 0.6, 1.1, 1.3, 2.5),
        (START_OFFSET_M, (-0.12, 0.0, 0.15), FOLDED_OFFSET_M, FOLDED_OFFSET_M, (-0.15, 0.0, 0.36)),
        lying=True,
    ),
}


@dataclass(frozen=True)
class Experiment:
    """A motion with a heading and a speed.

    Attributes:
        motion: one of ``MOTIONS``.
        heading: angle about the vertical by which grippers and cloth, and not the camera, are turned from the initial
            state of the episode that is repeated [degrees].
        speed: factor of the speed; 2 takes half the time.
    """

    motion: str
    heading: float = 0.0
    speed: float = 1.0

    def __str__(self) -> str:
        turned = f", grippers and cloth turned by {self.heading:g} degrees" if self.heading else ""
        return f"{self.motion}{turned}" + (f", {self.speed:.3g} times as fast" if self.speed != 1 else "")


EXPERIMENTS = (
    *(Experiment("hang", heading) for heading in (0.0, 90.0)),
    *(Experiment("swing", 0.0, speed) for speed in (0.7, 1.0, 1.5)),
    Experiment("swing", 90.0),
    *(Experiment("swing-fast", heading) for heading in (0.0, 90.0)),
    Experiment("shake"),
    Experiment("stretch"),
    *(Experiment("turn", heading) for heading in (0.0, 90.0)),
    *(Experiment(name) for name in ("drag", "drag-fast", "lift", "fold-open")),
)


def list_experiments(recordings: Sequence[Recording]) -> list[tuple[Experiment, Recording]]:
    """Return the experiments that can be made, each with the episode whose initial state it starts from.

    The list is empty if no gripper was recorded.
    """
    with_shape = [r for r in recordings if r.cloth.initial_vertices is not None or r.cloth.vertices is not None]
    templates = {lying: next((r for r in with_shape if _is_lying(r) == lying), None) for lying in (False, True)}
    experiments = []
    for experiment in EXPERIMENTS:
        template = templates[MOTIONS[experiment.motion].lying]
        if template is None or not holding_paths(template):
            continue
        if experiment.motion == "stretch" and len(holding_paths(template)) < MIN_STRETCH_GRIPPERS:
            continue
        experiments.append((experiment, template))
    return experiments


def _is_lying(recording: Recording) -> bool:
    """Whether half of the cloth lies on a table at first."""
    initial = recording.cloth.initial_vertices
    if initial is None or not recording.colliders:
        return False
    points = initial.reshape(-1, 3)
    heights = [(points - c.point) @ c.normal for c in recording.colliders.values()]
    return bool(np.median(np.min(heights, axis=0)) < MAX_LYING_HEIGHT_M)


def make_episode(experiment: Experiment, template: Recording) -> Recording:
    """Return an experiment as an episode: the grippers' paths and the initial shape, without measurements.

    Args:
        experiment: the motion.
        template: an episode from whose initial state it starts.
    """
    waypoints = MOTIONS[experiment.motion]
    poses = _initial_poses(template)
    centre = np.mean([position for position, _ in poses.values()], axis=0)
    initial = template.cloth.initial_vertices
    shape = np.asarray(template.cloth.vertices if initial is None else initial)
    heading = np.deg2rad(experiment.heading)
    turn, ahead = rotation_about_z(heading)[0], rotation_about_z(heading + measure_heading(template))[0]
    knots = STILL_S + np.asarray(waypoints.t) / experiment.speed
    t = np.arange(round((knots[-1] + STILL_S) / KNOT_INTERVAL_S) + 1) * KNOT_INTERVAL_S
    offset = interpolate_minimum_jerk(t, knots, np.asarray(waypoints.offset)) @ ahead.T
    apart, yaw = (
        interpolate_minimum_jerk(t, knots, np.asarray(values)) if values else np.zeros(len(t))
        for values in (waypoints.apart, waypoints.yaw)
    )
    spin = rotation_about_z(yaw)
    grippers = {}
    for name, (position, rotation) in poses.items():
        arm = turn @ (position - centre)
        horizontal = arm * [1.0, 1.0, 0.0]
        outward = horizontal / max(float(np.linalg.norm(horizontal)), 1e-9)
        path = centre + offset + np.einsum("kab,kb->ka", spin, arm + 0.5 * apart[:, None] * outward)
        grippers[name] = _make_gripper(t, path, spin @ turn @ rotation, template, name)
    moved_shape = (shape - centre) @ turn.T + centre
    placed = replace(template, cloth=replace(template.cloth, initial_vertices=moved_shape, initial_velocities=None))
    arms = {name: robot for name, robot in template.robots.items() if name in grippers}
    return replace(
        placed,
        grippers=grippers,
        joints={},
        robots={name: replace(r, model=locate_model(template, name)) for name, r in arms.items()},
        points=make_blank_frames(placed, float(t[-1])),
        markers=None,
        clock_offset=0.0,
        split={"motion": str(experiment)},
        path=None,
    )


def make_blank_frames(recording: Recording, end: float) -> PointClouds:
    """Return frames with one point of the initial shape, in place of measurements.

    Args:
        recording: source of the initial shape.
        end: time of the last frame [s].
    """
    frames = np.arange(int(end * DEFAULT_FRAME_RATE_HZ) + 1) / DEFAULT_FRAME_RATE_HZ
    initial = recording.cloth.initial_vertices
    point = np.asarray(recording.cloth.vertices if initial is None else initial).reshape(-1, 3)[:1]
    return PointClouds(frames, np.repeat(point, len(frames), axis=0), np.ones(len(frames), int))


def _make_gripper(
    t: np.ndarray, path: np.ndarray, rotation: np.ndarray, template: Recording, name: str
) -> GripperMotion:
    measured = template.grippers.get(name) or template.joints.get(name)
    pose = np.tile(np.eye(4), (len(t), 1, 1))
    pose[:, :3, :3], pose[:, :3, 3] = rotation, path
    closed = torch.ones(len(t), dtype=torch.bool)
    trajectory = Trajectory(torch.as_tensor(t), torch.as_tensor(pose), closed)
    return add_blank_readings(to_gripper_motion(trajectory), measured)


def add_blank_readings(path: GripperMotion, like: object) -> GripperMotion:
    """Return a path with zero forces and torques where another one has measurements.

    Args:
        path: the gripper's path.
        like: recorded gripper or arm.
    """
    zero = np.zeros((len(path.t), 3))
    return replace(path, **{key: zero for key in ("force", "torque") if getattr(like, key, None) is not None})


def _initial_poses(template: Recording) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return (position [3] m, rotation [3, 3]) of each holding gripper when the cloth is first observed."""
    paths, observed = holding_paths(template), template.markers if template.points is None else template.points
    start = max(p.t[0] for p in paths.values())
    if observed is not None:
        start = max(start, float(observed.t[0] + template.clock_offset))
    return {
        name: (positions[0], rotations[0])
        for name, path in paths.items()
        for positions, rotations in [path.at(np.array([start]))]
    }


def measure_heading(recording: Recording) -> float:
    """Return the angle [rad] about the vertical from x to where the cloth faces; 0 with a single gripper.

    The cloth faces perpendicular to its upper edge, to the side with the first gripper, by name, on its left. A cloth
    that lies on a table faces the side where it does not lie.
    """
    poses = _initial_poses(recording)
    if len(poses) < 2:
        return 0.0
    left, right = (poses[name][0] for name in (min(poses), max(poses)))
    ahead = np.array([(left - right)[1], (right - left)[0]])
    initial = recording.cloth.initial_vertices
    if initial is not None and _is_lying(recording):
        behind = initial.reshape(-1, 3).mean(0) - 0.5 * (left + right)
        ahead = ahead * (-1.0 if ahead @ behind[:2] > 0 else 1.0)
    return float(np.arctan2(ahead[1], ahead[0]))


def interpolate_minimum_jerk(t: np.ndarray, knots: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Interpolate values by minimum-jerk segments, at rest at each knot.

    Args:
        t: [K] times [s].
        knots: [N] times of the knots [s].
        values: [N, ...] values at the knots.

    Returns:
        [K, ...] values at the times.
    """
    segment = np.clip(np.searchsorted(knots, t, side="right") - 1, 0, len(knots) - 2)
    fraction = np.clip((t - knots[segment]) / (knots[segment + 1] - knots[segment]), 0, 1)
    weight = np.asarray(path_fraction(torch.as_tensor(fraction))).reshape(-1, *[1] * (values.ndim - 1))
    return (1 - weight) * values[segment] + weight * values[segment + 1]


def rotation_about_z(angle: np.ndarray | float) -> np.ndarray:
    """Return [K, 3, 3] rotations about the vertical by angles [K] [rad]."""
    a = np.atleast_1d(np.asarray(angle, float))
    c, s, o = np.cos(a), np.sin(a), 0 * a
    return np.stack([c, -s, o, s, c, o, o, o, o + 1], 1).reshape(-1, 3, 3)
