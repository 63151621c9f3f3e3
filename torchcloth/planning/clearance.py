"""Whether the arms stay clear of each other, of the table and of themselves along a motion."""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor

from ..errors import InvalidInput
from ..recordings import Recording
from ..robots.clearance import Gap  # pyright: ignore[reportMissingImports] - mapped from robots/ at installation
from ..robots.crowd import STEP, between_arms, within_arm  # pyright: ignore[reportMissingImports]
from ..robots.retrace import scene_of  # pyright: ignore[reportMissingImports]
from ..robots.scene import Scene  # pyright: ignore[reportMissingImports]
from ..robots.spline import Spline  # pyright: ignore[reportMissingImports]


class Clearance:
    """The solids of a scene's arms, and how near they may come.

    Args:
        scene: arms and table.
        least: m, between two arms and between an arm and the table; fingers may come down to that.
    """

    def __init__(self, scene: Scene, least: float) -> None:
        self.scene, self.least = scene, least

    def nearest(self, t: Tensor, q: Mapping[str, Tensor]) -> tuple[Gap, InvalidInput | None]:
        """(the smallest distance, what is too near) of joint angles [S, J] by arm, at [S] s."""
        splines = {name: Spline.through(t, own.detach()) for name, own in q.items()}
        gaps, refusals = [], []
        for name, spline in splines.items():
            gap, refusal = within_arm(self.scene, name, *spline.sampled(STEP), self.least)
            gaps.append(gap)
            refusals += [] if refusal is None else [refusal]
        gap = between_arms(self.scene, splines, self.least)
        gaps.append(gap)
        refusals += [gap.refusal(self.least)] if gap.distance < self.least else []
        return min(gaps, key=lambda gap: gap.distance), refusals[0] if refusals else None


def clearance_of(
    recording: Recording, t: Tensor, q: Mapping[str, Tensor], least: float
) -> tuple[Clearance | None, str]:
    """(what to hold a motion against, why there is nothing).

    A recorded motion that comes nearer by our solids was done all the same: then they are no judges.
    """
    scene = scene_of(recording)
    if scene is None or set(scene.arms) != set(q):
        return None, "not every gripper that holds the cloth has an arm: whether arms stay clear was not looked at"
    if bare := [name for name in scene.arms if scene[name].unshaped]:
        return None, f"solids of {bare[0]!r} are meshes: whether the arms stay clear was not looked at"
    found = Clearance(scene, least)
    _, refusal = found.nearest(t, q)
    if refusal is not None:
        return (
            None,
            f"the recorded motion itself is not clear ({refusal}): whether the planned one is was not looked at",
        )
    return found, ""
