"""From the grippers' paths to joint motions that the arms can do: within their limits, clear of all that is hard."""

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
from .collision_checks import STEP, between_arms, within_arm
from .grasp_orientations import Hold, candidates, inward
from .inverse import reach
from .path_following import Load, Task, Way, dense, follow, load, ways
from .primitives import Action
from .scene import Scene
from .spline import Spline

# Flexiv publishes no joint accelerations; 3 rad/s^2 is what the examples of its RDK command (flexiv_rdk @ dca9a15).
ACCELERATION = 3.0  # rad/s^2
KEPT = 3  # ways of each arm that are tried with those of the others
EASE = 1.002  # slower than the limits ask for by that much, for what lies between the samples
SAME = 1e-9  # s


class Plan(NamedTuple):
    """Joint motions of all arms of a scene on common knots, and what they cost."""

    t: Tensor  # [K] s
    q: dict[str, Tensor]  # name -> [K, J] rad
    closed: dict[str, Tensor]  # name -> [K] bool
    release: float  # s, when the grippers open
    slower: float  # times the duration that was asked for
    limiting: str  # which joint of which arm, by what limit, is nearest to its bound
    gap: Gap  # what comes nearest, fingers at the table left out
    holds: dict[str, Hold]

    def __repr__(self) -> str:
        near = f"{self.gap.first} to {self.gap.second}, " if self.gap.first else "at least "
        return (
            f"Plan({', '.join(self.q)}: {float(self.t[-1]):.3g} s, {self.slower:.3g} times as long as asked, "
            f"limited by {self.limiting}; nearest: {near}{1e3 * self.gap.distance:.3g} mm)"
        )

    def motion(self, scene: Scene) -> dict[str, Trajectory]:
        """The poses that the joints lead through, by gripper."""
        return {name: Trajectory(self.t, scene[name](self.q[name]).detach(), self.closed[name]) for name in self.q}

    def joints(self) -> dict[str, JointMotion]:
        """As a recording stores it; with ``scene.infos()`` for its robots, ``replay`` gives the same poses."""
        t = self.t.numpy()
        return {name: JointMotion(t, q.numpy(), closed=self.closed[name].numpy()) for name, q in self.q.items()}


def plan(
    scene: Scene,
    action: Action,
    *,
    acceleration: float = ACCELERATION,
    clearance: float = 0.02,
    slow_down: bool = True,
    period: float = 0.01,
    holds: Mapping[str, Hold] | None = None,
) -> Plan:
    """Joint motions that lead the grippers along their paths.

    Each arm tries many directions of its tool and postures, and takes the way that needs least slowing down and stays
    clear. Checked: reach, soft position limits, velocity limits, accelerations, distances of all solids every 20 ms of
    the path, and that the joints keep within 0.1 mm of the path, between knots too.

    Args:
        scene: the arms, and the table if there is one.
        action: paths of grippers that have the names of arms; an arm without a path stands still at home. Where it is
            slowed down all times are multiplied, that of its beginning too.
        acceleration: the most that any joint may do [rad/s^2]; see ``ACCELERATION``.
        clearance: between two arms, and between an arm and the table [m]; the solids of the tool's own frame (the
            fingers) may come down to the table. Links of one arm keep 5 mm.
        slow_down: the whole motion may take longer than asked, as the joints' limits need; else it is refused.
        period: the longest time between two knots of the result [s].
        holds: directions of the tools, by arm, instead of a search.

    Raises:
        InvalidInput: names the joint or the pair of solids in the way, value, limit and time.
    """
    for name in scene.arms:
        if unshaped := scene[name].unshaped:
            raise InvalidInput(
                f"solids of {name!r}",
                got=f"meshes alone at {', '.join(unshaped)}",
                expected="boxes, cylinders or spheres, which can be kept apart",
                remedy="describe these links by some in the URDF's collisions",
            )
    if unknown := action.motion.keys() - scene.arms.keys():
        raise InvalidInput("action moves unknown arms", got=sorted(unknown), expected=f"among {list(scene.arms)}")
    if unknown := (holds or {}).keys() - scene.arms.keys():
        raise InvalidInput("holds of unknown arms", got=sorted(unknown), expected=f"among {list(scene.arms)}")
    if not action.motion:
        raise InvalidInput("action", got="no motion", expected=f"a path for one or more of {list(scene.arms)}")
    for name, value in {"acceleration": acceleration, "clearance": clearance, "period": period}.items():
        if not (math.isfinite(value) and value > 0):
            raise InvalidInput(name, got=value, expected="a finite value > 0")
    plain = {id(part): part.detach().clone() for part in scene.buffers()}  # a base may be of a graph
    scene = deepcopy(scene, plain).cpu().double()  # float32 has no digits for solutions as exact as these
    exact = {n: Trajectory(path.t.double(), path.pose.double(), path.closed) for n, path in action.motion.items()}
    action = action._replace(motion=exact)
    spans = {name: path.t[[0, -1]].tolist() for name, path in action.motion.items()}
    if any(max(ends) - min(ends) > SAME for ends in zip(*spans.values(), strict=True)):
        told = ", ".join(f"{name} {first:g} to {last:g} s" for name, (first, last) in spans.items())
        raise InvalidInput("paths of the action", got=told, expected="one beginning and one end for all arms")
    for name, path in action.motion.items():
        _check_reach(scene[name], name, path)
    options = {
        name: _options(scene, name, action, acceleration, clearance, (holds or {}).get(name)) for name in scene.arms
    }
    refusals = []
    for combination in sorted(product(*options.values()), key=lambda some: max(way.load.factor for way, _ in some)):
        chosen = {name: way for name, (way, _) in zip(options, combination, strict=True)}
        gap = between_arms(scene, {name: way.spline for name, way in chosen.items()}, clearance)
        if gap.distance >= clearance:
            nearest = min([gap, *(own for _, own in combination)], key=lambda gap: gap.distance)
            return _timed(scene, action, chosen, nearest, slow_down, period)
        refusals.append(gap.refusal(clearance))
    raise refusals[0]


def _options(
    scene: Scene, name: str, action: Action, acceleration: float, clearance: float, hold: Hold | None
) -> list[tuple[Way, Gap]]:
    """A few ways of one arm that are clear of the table and of itself, fastest first."""
    arm = scene[name]
    limit = torch.full_like(arm.home, acceleration)
    if name not in action.motion:
        times = next(iter(action.motion.values())).t[[0, -1]]
        still = Spline.through(times, arm.home.expand(2, -1).to(times))
        gap, refusal = within_arm(scene, name, arm.home.expand(2, -1), times, clearance)
        if refusal is not None:
            what, remedy = f"the idle arm: {refusal.what}", "lower the table, or leave that arm out of the scene"
            raise InvalidInput(what, got=refusal.got, expected=refusal.expected, remedy=remedy)
        return [(Way(Hold(), still, load(arm, still, limit)), gap)]

    def check(q: Tensor, times: Tensor) -> InvalidInput | None:
        return within_arm(scene, name, q, times, clearance)[1]

    task = Task(arm, dense(action.motion[name]), inward(name, action.motion, arm), limit, check)
    found: list[tuple[Way, Gap]] = []
    refusals: list[InvalidInput] = []
    for tried in ways(task, candidates() if hold is None else [hold]):
        try:
            way = follow(task, tried)
        except InvalidInput as error:
            refusals.append(error)
            continue
        found.append((way, within_arm(scene, name, *way.spline.sampled(STEP), clearance)[0]))
        if len(found) == KEPT:
            break
    if not found:
        raise refusals[0]
    return sorted(found, key=lambda option: option[0].load.factor)


def _check_reach(arm: Arm, name: str, path: Trajectory) -> None:
    """Refuses at once what is farther than the arm is long; the search would take long to find that out."""
    shoulder, longest = reach(arm)
    distance = (path.pose[:, :3, 3].to(shoulder) - shoulder).norm(dim=-1)
    if float(distance.max()) > longest:
        raise InvalidInput(
            f"the path of {name!r} leaves the reach of {arm.name!r} at t = {float(path.t[distance.argmax()]):.3g} s",
            got=f"{float(distance.max()):.3g} m from the shoulder",
            expected=f"less than {longest:.3g} m, the arm stretched out",
            remedy="move the grips or the path nearer to the arm",
        )


def _timed(scene: Scene, action: Action, chosen: dict[str, Way], gap: Gap, slow_down: bool, period: float) -> Plan:
    """All arms slowed down alike, sampled at every knot of the path and between."""
    name, hardest = max(chosen.items(), key=lambda item: item[1].load.factor)
    slower = EASE * hardest.load.factor if hardest.load.factor > 1 else 1.0
    if slower > 1 and not slow_down:
        raise _too_fast(scene, name, hardest.load)
    splines = {key: way.spline.slower(slower) for key, way in chosen.items()}
    knots = torch.cat([dense(path).t for path in action.motion.values()]).unique()
    knots = knots[torch.cat([knots.new_ones(1, dtype=torch.bool), knots.diff() > SAME])]
    t = Spline(slower * knots, knots[:, None], knots[:, None]).finer(period)

    def closed(name: str) -> Tensor:
        if name not in action.motion:
            return torch.zeros(len(t), dtype=torch.bool)
        own = action.motion[name]
        return own.closed[torch.searchsorted(slower * own.t, t + 1e-9, right=True) - 1]

    return Plan(
        t=t,
        q={key: spline.at(t)[0] for key, spline in splines.items()},
        closed={key: closed(key) for key in chosen},
        release=slower * action.release,
        slower=slower,
        limiting=f"{scene[name].joint_names[hardest.load.joint]} of {name}: {hardest.load.what}",
        gap=gap._replace(time=slower * gap.time),
        holds={key: way.hold for key, way in chosen.items()},
    )


def _too_fast(scene: Scene, name: str, load: Load) -> InvalidInput:
    unit = "rad/s" if load.what == "velocity" else "rad/s^2"
    return InvalidInput(
        f"the motion breaks the {load.what} limit of {scene[name].joint_names[load.joint]!r} of {name!r} "
        f"at t = {load.time:.3g} s",
        got=f"{load.value:.3g} {unit}",
        expected=f"at most {load.limit:.3g} {unit}",
        remedy=f"let it take {EASE * load.factor:.3g} times as long (slow_down=True), or ask for less",
    )
