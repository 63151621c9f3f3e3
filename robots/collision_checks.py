"""Checks of the distances between two arms, between an arm and the table, and between the links of one arm."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations

from torch import Tensor

from torchcloth.errors import InvalidInput

from .arm import Arm
from .clearance import Gap, NamedSolid, smallest_gap
from .scene import Scene
from .spline import ClampedSpline, subdivide_times

MIN_LINK_CLEARANCE_M = 0.005  # between links of one arm; the links of a folded wrist pass each other at 3 mm
COLLISION_CHECK_PERIOD_S = 0.02  # largest time between two checks


def check_self_and_table(
    scene: Scene, name: str, q: Tensor, times: Tensor, clearance: float
) -> tuple[Gap, InvalidInput | None]:
    """Return the smallest distance of one arm to the table and to itself, and an error if one is too small.

    Fingers on the table do not count in the distance: they work there.

    Args:
        scene: contains the arm.
        name: of the arm.
        q: [T, J] rad, joint positions.
        times: [T] s, their times.
        clearance: m, smallest distance to the table. It is 0 for the solids of the tool's own frame. Between links it
            is ``MIN_LINK_CLEARANCE_M``.
    """
    arm = scene[name]
    solids, joints = _named_solids(arm, name, q), arm.solid_joints
    link_pairs = [(i, j) for i, j in combinations(range(len(solids)), 2) if abs(joints[i] - joints[j]) > 1]
    gaps = [(MIN_LINK_CLEARANCE_M, smallest_gap(solids, link_pairs, times))]
    if scene.table is not None:
        top = len(solids)
        fingers = [i for i in range(top) if solids[i].primitive.link == arm.frame]
        others = [i for i in range(top) if i not in fingers and joints[i] > 0]  # the root may stand on the table
        solids = [*solids, NamedSolid("the table", scene.table.primitive())]
        gaps.append((clearance, smallest_gap(solids, [(i, top) for i in others], times, clearance)))
        gaps.append((0.0, smallest_gap(solids, [(i, top) for i in fingers], times)))
    errors = [gap.to_error(min_distance) for min_distance, gap in gaps if gap.distance < min_distance]
    closest = min((gap for min_distance, gap in gaps if min_distance > 0), key=lambda gap: gap.distance)
    return closest, errors[0] if errors else None


def check_between_arms(scene: Scene, splines: Mapping[str, ClampedSpline], clearance: float = 0.0) -> Gap:
    """Return the smallest distance between any two arms.

    Args:
        scene: contains the arms.
        splines: joint motions by arm.
        clearance: m; larger distances than this and ``MAX_RESOLVED_GAP_M`` are not refined.
    """
    times = subdivide_times(next(iter(splines.values())).t, COLLISION_CHECK_PERIOD_S)
    groups = [_named_solids(scene[name], name, spline.positions(times)) for name, spline in splines.items()]
    solids = [solid for group in groups for solid in group]
    owner = [number for number, group in enumerate(groups) for _ in group]
    pairs = [(i, j) for i, j in combinations(range(len(solids)), 2) if owner[i] != owner[j]]
    return smallest_gap(solids, pairs, times, clearance)


def _named_solids(arm: Arm, name: str, q: Tensor) -> list[NamedSolid]:
    return [NamedSolid(f"{p.link} of {name}", p) for p in arm.geometry(q)]
