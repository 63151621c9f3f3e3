"""Whether the arms stay clear of each other, of the table and of themselves along a motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from torch import Tensor

from ..errors import InvalidInput
from ..recordings import Recording
from ..robots.clearance import Gap  # pyright: ignore[reportMissingImports] - mapped from robots/ at installation
from ..robots.collision_checks import (  # pyright: ignore[reportMissingImports]
    check_between_arms,
    check_self_and_table,
)
from ..robots.replan_episode import (  # pyright: ignore[reportMissingImports]
    TABLE_MARGIN_M,
    table_from_episode,
)
from ..robots.scene import Scene, Table  # pyright: ignore[reportMissingImports]
from ..robots.spline import ClampedSpline  # pyright: ignore[reportMissingImports]
from .motion_parameters import ArmMotionParameters, GripperMotionParameters


class ArmClearance:
    """The solids of a scene's arms and how near they may come to each other.

    Args:
        scene: arms and table.
        min_distance: m, between two arms and between an arm and the table; fingers may touch the table.
        times: [N] s, the times at which joint angles are given.
    """

    def __init__(self, scene: Scene, min_distance: float, times: Tensor) -> None:
        self.scene, self.min_distance, self.times = scene, min_distance, times

    def smallest_gap(self, q: Mapping[str, Tensor]) -> tuple[Gap, InvalidInput | None]:
        """Return the smallest distance along joint angles [N, J] by arm, and an error if one is too small."""
        gaps, errors = [], []
        for name, joint_angles in q.items():
            gap, error = check_self_and_table(self.scene, name, joint_angles, self.times, self.min_distance)
            gaps.append(gap)
            errors += [] if error is None else [error]
        splines = {name: ClampedSpline(self.times, joint_angles) for name, joint_angles in q.items()}
        gap = check_between_arms(self.scene, splines, self.min_distance)
        gaps.append(gap)
        errors += [gap.to_error(self.min_distance)] if gap.distance < self.min_distance else []
        return min(gaps, key=lambda gap: gap.distance), errors[0] if errors else None


def build_clearance(
    recording: Recording, motions: Sequence[GripperMotionParameters], goal: Tensor, min_distance: float
) -> tuple[ArmClearance | None, str]:
    """Build the clearance check of an episode's arms.

    The check is switched off if the recorded motion itself violates it: the robot has executed that motion, so the
    simplified solids are wrong.

    Args:
        recording: the episode.
        motions: of the grippers that hold the cloth.
        goal: [N, 3] m, points that the table must reach to.
        min_distance: m, smallest distance allowed.

    Returns:
        The check, or None and a sentence that says why there is none.
    """
    arms = {motion.name: motion.arm for motion in motions if isinstance(motion, ArmMotionParameters)}
    if len(arms) < len(motions):
        return None, "arm clearance was not checked: not every gripper that holds the cloth is moved by an arm"
    if names := [name for name, arm in arms.items() if arm.links_without_primitives]:
        return None, f"arm clearance was not checked: solids of {names[0]!r} are meshes"
    table = table_from_episode(recording)
    scene = Scene(arms, None if table is None else _extend_table(table, goal))
    clearance = ArmClearance(scene, min_distance, motions[0].span.bound_check_times)
    _, error = clearance.smallest_gap(
        {motion.name: motion.coordinates_at_check_times(motion.zero_waypoints) for motion in motions}
    )
    if error is not None:
        return None, f"arm clearance was not checked: the recorded motion itself is not clear ({error})"
    return clearance, ""


def _extend_table(table: Table, goal: Tensor) -> Table:
    """An episode gives only a table's plane: let the table reach beyond cloth, paths and goal."""
    low, high = (goal.amin(0) - TABLE_MARGIN_M).tolist(), (goal.amax(0) + TABLE_MARGIN_M).tolist()
    x, y = ((min(side[0], low[k]), max(side[1], high[k])) for k, side in enumerate((table.x, table.y)))
    return table._replace(x=x, y=y)
