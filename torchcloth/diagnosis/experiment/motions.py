"""Short, safe motions from where the grippers are: what may be asked of a robot to tell causes apart.

On a table all keep within 17 cm of the first pose, but for the lift (42 cm) and the fold that is opened again (39 cm:
what then stays is a crease), in the air within 5 cm, but for the turn (each gripper on a quarter of a circle about the
middle of all, which goes 4 cm ahead), and stretch the cloth by at most 1 cm. They are those of
``training/validation/independent/motions.py``, so that another engine can carry an experiment out.
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
from ...types import Trajectory

STILL, KNOT = 0.2, 0.01  # s, all stand still before and after; between knots


@dataclass(frozen=True)
class Plan:
    """Waypoints of the grippers, relative to where they are: x ahead of the cloth, y along its upper edge, z up."""

    t: tuple[float, ...]  # s
    offset: tuple[tuple[float, float, float], ...]  # m, of all grippers
    apart: tuple[float, ...] = ()  # m, beyond the first distance
    yaw: tuple[float, ...] = ()  # rad, about the vertical through their middle
    lying: bool = False  # begins with the cloth on a table


def _back_and_forth(amplitude: float, leg: float, cycles: int, axis: int) -> Plan:
    offsets, times = [(0.0, 0.0, 0.0)], [0.0]
    for k in range(2 * cycles):
        there = np.eye(3)[axis] * amplitude * (-1) ** k
        offsets.append((float(there[0]), float(there[1]), float(there[2])))
        times.append(times[-1] + (leg if k else 0.6 * leg))
    return Plan((*times, times[-1] + 0.6 * leg), (*offsets, (0.0, 0.0, 0.0)))


HERE = (0.0, 0.0, 0.0)
AHEAD = (0.04, 0.0, 0.0)
OVER = (-0.22, 0.0, 0.07)
PLANS = {
    "hang": Plan((0.0, 1.0), (HERE, HERE)),
    "swing": _back_and_forth(0.05, 0.85, 1, 0),
    "swing-fast": _back_and_forth(0.04, 0.34, 1, 0),
    "shake": _back_and_forth(0.02, 0.22, 3, 2),
    "stretch": Plan((0.0, 0.5, 0.8, 1.3), (HERE,) * 4, apart=(0.0, 0.010, 0.010, 0.0)),
    "turn": Plan((0.0, 1.0, 1.3, 2.3), (HERE, AHEAD, AHEAD, HERE), yaw=(0.0, np.pi / 2, np.pi / 2, 0.0)),
    "drag": Plan((0.0, 0.25, 1.25), (HERE, (0.0, 0.0, 0.02), (0.16, 0.0, 0.02)), lying=True),
    "drag-fast": Plan((0.0, 0.25, 0.70), (HERE, (0.0, 0.0, 0.02), (0.16, 0.0, 0.02)), lying=True),
    "lift": Plan((0.0, 1.4), (HERE, (-0.12, 0.0, 0.40)), lying=True),
    "fold-open": Plan(
        (0.0, 0.6, 1.1, 1.3, 2.5), (HERE, (-0.12, 0.0, 0.15), OVER, OVER, (-0.15, 0.0, 0.36)), lying=True
    ),
}


@dataclass(frozen=True)
class Experiment:
    """One that may be done.

    Attributes:
        motion: one of ``PLANS``.
        heading: degrees about the vertical by which grippers and cloth, and not the camera, are turned from how the
            episode begins that is repeated.
        speed: 2 takes half the time.
    """

    motion: str
    heading: float = 0.0
    speed: float = 1.0

    def __str__(self) -> str:
        turned = f", grippers and cloth turned by {self.heading:g} degrees" if self.heading else ""
        return f"{self.motion}{turned}" + (f", {self.speed:.3g} times as fast" if self.speed != 1 else "")


LIBRARY = (
    *(Experiment("hang", heading) for heading in (0.0, 90.0)),
    *(Experiment("swing", 0.0, speed) for speed in (0.7, 1.0, 1.5)),
    Experiment("swing", 90.0),
    *(Experiment("swing-fast", heading) for heading in (0.0, 90.0)),
    Experiment("shake"),
    Experiment("stretch"),
    *(Experiment("turn", heading) for heading in (0.0, 90.0)),
    *(Experiment(name) for name in ("drag", "drag-fast", "lift", "fold-open")),
)


def possible(recordings: Sequence[Recording]) -> list[tuple[Experiment, Recording]]:
    """Experiments with the episode whose first shape they begin with; none where no gripper was recorded."""
    placed = [r for r in recordings if r.cloth.initial_vertices is not None or r.cloth.vertices is not None]
    begins = {lying: next((r for r in placed if _lies(r) == lying), None) for lying in (False, True)}
    found = []
    for experiment in LIBRARY:
        template = begins[PLANS[experiment.motion].lying]
        if template is None or not holding_paths(template):
            continue
        if experiment.motion == "stretch" and len(holding_paths(template)) < 2:
            continue
        found.append((experiment, template))
    return found


def _lies(recording: Recording) -> bool:
    """Whether half of the cloth begins on a table."""
    first = recording.cloth.initial_vertices
    if first is None or not recording.colliders:
        return False
    points = first.reshape(-1, 3)
    heights = [(points - c.point) @ c.normal for c in recording.colliders.values()]
    return bool(np.median(np.min(heights, axis=0)) < 0.03)


def planned(experiment: Experiment, template: Recording) -> Recording:
    """The experiment as an episode: what the grippers do, where the cloth begins; nothing is seen of it yet."""
    plan = PLANS[experiment.motion]
    first = _first(template)
    centre = np.mean([place for place, _ in first.values()], axis=0)
    initial = template.cloth.initial_vertices
    shape = np.asarray(template.cloth.vertices if initial is None else initial)
    heading = np.deg2rad(experiment.heading)
    turn, ahead = about_z(heading)[0], about_z(heading + heading_of(template))[0]
    knots = STILL + np.asarray(plan.t) / experiment.speed
    t = np.arange(round((knots[-1] + STILL) / KNOT) + 1) * KNOT
    offset = minimum_jerk(t, knots, np.asarray(plan.offset)) @ ahead.T
    apart, yaw = (minimum_jerk(t, knots, np.asarray(v)) if v else np.zeros(len(t)) for v in (plan.apart, plan.yaw))
    spin = about_z(yaw)
    grippers = {}
    for name, (place, rotation) in first.items():
        aside = turn @ (place - centre)
        flat = aside * [1.0, 1.0, 0.0]
        outward = flat / max(float(np.linalg.norm(flat)), 1e-9)
        path = centre + offset + np.einsum("kab,kb->ka", spin, aside + 0.5 * apart[:, None] * outward)
        grippers[name] = _gripper(t, path, spin @ turn @ rotation, template, name)
    moved = (shape - centre) @ turn.T + centre
    placed = replace(template, cloth=replace(template.cloth, initial_vertices=moved))
    arms = {name: robot for name, robot in template.robots.items() if name in grippers}
    return replace(
        placed,
        grippers=grippers,
        joints={},
        robots={name: replace(r, model=locate_model(template, name)) for name, r in arms.items()},
        points=blank_frames(placed, float(t[-1])),
        markers=None,
        clock_offset=0.0,
        split={"motion": str(experiment)},
        path=None,
    )


def blank_frames(recording: Recording, end: float) -> PointClouds:
    """One point of the first shape, in frames until ``end`` [s]."""
    frames = np.arange(int(end * DEFAULT_FRAME_RATE_HZ) + 1) / DEFAULT_FRAME_RATE_HZ
    initial = recording.cloth.initial_vertices
    point = np.asarray(recording.cloth.vertices if initial is None else initial).reshape(-1, 3)[:1]
    return PointClouds(frames, np.repeat(point, len(frames), axis=0), np.ones(len(frames), int))


def _gripper(t: np.ndarray, path: np.ndarray, rotation: np.ndarray, template: Recording, name: str) -> GripperMotion:
    """With empty readings where the template has some."""
    measured = template.grippers.get(name) or template.joints.get(name)
    pose = np.tile(np.eye(4), (len(t), 1, 1))
    pose[:, :3, :3], pose[:, :3, 3] = rotation, path
    closed = torch.ones(len(t), dtype=torch.bool)
    return blank_readings(to_gripper_motion(Trajectory(torch.as_tensor(t), torch.as_tensor(pose), closed)), measured)


def blank_readings(path: GripperMotion, like: object) -> GripperMotion:
    """With zero force and torque where the other has measured some."""
    zero = np.zeros((len(path.t), 3))
    return replace(path, **{key: zero for key in ("force", "torque") if getattr(like, key, None) is not None})


def _first(template: Recording) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """By holding gripper (position [3] m, rotation [3, 3]) when the cloth is seen first."""
    own, seen = holding_paths(template), template.markers if template.points is None else template.points
    start = max(p.t[0] for p in own.values())
    if seen is not None:
        start = max(start, float(seen.t[0] + template.clock_offset))
    return {name: (place[0], turn[0]) for name, path in own.items() for place, turn in [path.at(np.array([start]))]}


def heading_of(recording: Recording) -> float:
    """rad about the vertical from x to where the cloth faces, square to its upper edge; 0 with a single gripper.

    Of the two sides of the edge the one with the first gripper, by name, on its left; of cloth that lies on a table the
    one where it does not lie.
    """
    first = _first(recording)
    if len(first) < 2:
        return 0.0
    left, right = (first[name][0] for name in (min(first), max(first)))
    ahead = np.array([(left - right)[1], (right - left)[0]])
    initial = recording.cloth.initial_vertices
    if initial is not None and _lies(recording):
        behind = initial.reshape(-1, 3).mean(0) - 0.5 * (left + right)
        ahead = ahead * (-1.0 if ahead @ behind[:2] > 0 else 1.0)
    return float(np.arctan2(ahead[1], ahead[0]))


def minimum_jerk(t: np.ndarray, knots: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Values [K, ...] at times [K] s between ``values`` [N, ...] at ``knots`` [N] s, at rest at each."""
    leg = np.clip(np.searchsorted(knots, t, side="right") - 1, 0, len(knots) - 2)
    s = np.clip((t - knots[leg]) / (knots[leg + 1] - knots[leg]), 0, 1)
    s = (s**3 * (10 - 15 * s + 6 * s * s)).reshape(-1, *[1] * (values.ndim - 1))
    return (1 - s) * values[leg] + s * values[leg + 1]


def about_z(angle: np.ndarray | float) -> np.ndarray:
    """[K, 3, 3] rotations."""
    a = np.atleast_1d(np.asarray(angle, float))
    c, s, o = np.cos(a), np.sin(a), 0 * a
    return np.stack([c, -s, o, s, c, o, o, o, o + 1], 1).reshape(-1, 3, 3)
