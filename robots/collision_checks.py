"""What must stay apart in a scene: arm and arm, arm and table, the links of one arm."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations

from torch import Tensor

from torchcloth.errors import InvalidInput

from .arm import Arm
from .clearance import Gap, Named, nearest
from .scene import Scene
from .spline import Spline

OWN = 0.005  # m, between the links of one arm; the wrist's pass each other at 3 mm when folded up
STEP = 0.02  # s, between the instants that are looked at


def within_arm(scene: Scene, name: str, q: Tensor, times: Tensor, clearance: float) -> tuple[Gap, InvalidInput | None]:
    """The smallest distance of one arm to the table or to itself, and the refusal if one is too small.

    Fingers on the table do not count in the distance: they work there.

    Args:
        scene: the arm is in.
        name: of the arm.
        q: [T, J] rad, its joint positions at
        times: [T] s.
        clearance: to the table [m]; 0 for the solids of the tool's own frame, ``OWN`` among the links.
    """
    arm = scene[name]
    solids, bodies = _solids(arm, name, q), arm.bodies
    own = [(i, j) for i, j in combinations(range(len(solids)), 2) if abs(bodies[i] - bodies[j]) > 1]
    gaps = [(OWN, nearest(solids, own, times))]
    if scene.table is not None:
        top = len(solids)
        fingers = [i for i in range(top) if solids[i].primitive.link == arm.frame]
        others = [i for i in range(top) if i not in fingers and bodies[i] > 0]  # the root may stand on it
        solids = [*solids, Named("the table", scene.table.primitive())]
        gaps.append((clearance, nearest(solids, [(i, top) for i in others], times, clearance)))
        gaps.append((0.0, nearest(solids, [(i, top) for i in fingers], times)))
    refusals = [gap.refusal(least) for least, gap in gaps if gap.distance < least]
    closest = min((gap for least, gap in gaps if least > 0), key=lambda gap: gap.distance)
    return closest, refusals[0] if refusals else None


def between_arms(scene: Scene, splines: Mapping[str, Spline], clearance: float = 0.0) -> Gap:
    """The smallest distance of any arm to any other; ``FAR`` or ``clearance`` [m] where all are farther apart."""
    times = next(iter(splines.values())).finer(STEP)
    groups = [_solids(scene[name], name, spline.at(times)[0]) for name, spline in splines.items()]
    solids = [solid for group in groups for solid in group]
    owner = [number for number, group in enumerate(groups) for _ in group]
    pairs = [(i, j) for i, j in combinations(range(len(solids)), 2) if owner[i] != owner[j]]
    return nearest(solids, pairs, times, clearance)


def _solids(arm: Arm, name: str, q: Tensor) -> list[Named]:
    return [Named(f"{p.link} of {name}", p) for p in arm.geometry(q)]
