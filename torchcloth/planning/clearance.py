"""Whether the arms stay clear of each other, of the table and of themselves along a motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from torch import Tensor

from ..errors import InvalidInput
from ..recordings import Recording
from ..robots.clearance import Gap  # pyright: ignore[reportMissingImports] - mapped from robots/ at installation
from ..robots.collision_checks import between_arms, within_arm  # pyright: ignore[reportMissingImports]
from ..robots.replan_episode import table_of  # pyright: ignore[reportMissingImports]
from ..robots.scene import Scene, Table  # pyright: ignore[reportMissingImports]
from ..robots.spline import Spline  # pyright: ignore[reportMissingImports]
from .motion_parameters import ArmCourse, Course

AROUND = 0.1  # m, that the table reaches beyond the goal


class Clearance:
    """The solids of a scene's arms, and how near they may come.

    Args:
        scene: arms and table.
        least: m, between two arms and between an arm and the table; fingers may come down to that.
        times: [N] s, the instants at which joint angles are given.
    """

    def __init__(self, scene: Scene, least: float, times: Tensor) -> None:
        self.scene, self.least, self.times = scene, least, times

    def nearest(self, q: Mapping[str, Tensor]) -> tuple[Gap, InvalidInput | None]:
        """(the smallest distance, what is too near) of joint angles [N, J] by arm."""
        gaps, refusals = [], []
        for name, own in q.items():
            gap, refusal = within_arm(self.scene, name, own, self.times, self.least)
            gaps.append(gap)
            refusals += [] if refusal is None else [refusal]
        gap = between_arms(self.scene, {name: Spline.through(self.times, own) for name, own in q.items()}, self.least)
        gaps.append(gap)
        refusals += [gap.refusal(self.least)] if gap.distance < self.least else []
        return min(gaps, key=lambda gap: gap.distance), refusals[0] if refusals else None


def clearance_of(
    recording: Recording, courses: Sequence[Course], goal: Tensor, least: float
) -> tuple[Clearance | None, str]:
    """(what to hold motions against, why there is nothing); the table reaches to the goal's points [N, 3] m.

    A recorded motion that comes nearer by our solids was done all the same: then they are no judges.
    """
    arms = {c.name: c.arm for c in courses if isinstance(c, ArmCourse)}
    if len(arms) < len(courses):
        return None, "not every gripper that holds the cloth is moved by an arm: whether arms stay clear is not known"
    if bare := [name for name, arm in arms.items() if arm.unshaped]:
        return None, f"solids of {bare[0]!r} are meshes: whether the arms stay clear was not looked at"
    table = table_of(recording)
    scene = Scene(arms, None if table is None else _reaching(table, goal))
    found = Clearance(scene, least, courses[0].span.instants)
    _, refusal = found.nearest({c.name: c.at_instants(c.nothing) for c in courses})
    if refusal is not None:
        return (
            None,
            f"the recorded motion itself is not clear ({refusal}): whether the planned one is was not looked at",
        )
    return found, ""


def _reaching(table: Table, goal: Tensor) -> Table:
    """An episode gives a table's plane alone; it ends beyond cloth, paths and goal."""
    low, high = (goal.amin(0) - AROUND).tolist(), (goal.amax(0) + AROUND).tolist()
    widened = lambda side, k: (min(side[0], low[k]), max(side[1], high[k]))  # noqa: E731
    return table._replace(x=widened(table.x, 0), y=widened(table.y, 1))
