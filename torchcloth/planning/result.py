"""What was planned, and what is expected of it."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torch import Tensor

from .._utils.files import as_json, write_text
from ..errors import InvalidInput
from ..recordings import Recording, write
from ..recordings.templates import is_undone
from ..types import Trajectory

RESULT, EPISODE = "plan.json", "episode"  # in the result's folder
PLANNED = "synthetic: a motion that torchcloth plan proposes"
CONVENTION = (
    "SI units. distance: mean distance of the goal's points from the cloth's surface at the last frame (one-sided "
    "Chamfer); of a goal with triangles the mean of that and of the cloth's vertices from the goal's surface; of "
    "pieces their mean distance from where they shall be. before: "
    "the recorded motion, simulated; after: the planned one; several numbers: one for each model that was planned for. "
    "history: mean over the models at every motion that was looked at. limit.share: of the way "
    "to the first limit, from the recorded motion."
)


@dataclass(frozen=True, eq=False)
class MotionPlan:
    """The result of ``plan``.

    Attributes:
        recording: an episode without observations: the scene, the first shape, the planned motion; of arms their joints
            too. ``robots.replay`` gives its poses, ``recordings.write`` stores it.
        motion: the planned poses by gripper.
        before: m, the distance that the recorded motion ends at, for each model.
        after: m, the same of the planned motion.
        history: m, the mean distance at every motion that was looked at.
        times: [T] s, frames.
        frames: [T, V, 3] m, the cloth as the first model has it under the planned motion.
        frames_before: the same under the recorded motion.
        faces: [F, 3].
        moved: m, by gripper, how far its path is from the recorded one, at most.
        limit: (share of the way to the first limit, from the recorded motion; whose limit of what).
        nearest: what comes nearest to what, in words; empty where no arms were looked at.
        ended: why the search ended.
        seconds: that it took.
        warnings: what to mistrust, in sentences.
    """

    recording: Recording = field(repr=False)
    motion: dict[str, Trajectory] = field(repr=False)
    before: list[float]
    after: list[float]
    history: list[float] = field(repr=False)
    times: Tensor = field(repr=False)
    frames: Tensor = field(repr=False)
    frames_before: Tensor = field(repr=False)
    faces: Tensor = field(repr=False)
    moved: dict[str, float]
    limit: tuple[float, str]
    nearest: str
    ended: str
    seconds: float
    warnings: list[str]

    def as_dict(self) -> dict[str, Any]:
        """The content of plan.json."""
        return {
            "distance": {"before": self.before, "after": self.after, "unit": "m"},
            "history": self.history,
            "moved": self.moved,
            "limit": {"share": self.limit[0], "what": self.limit[1]},
            "nearest": self.nearest,
            "ended": self.ended,
            "seconds": self.seconds,
            "episode": EPISODE,
            "convention": CONVENTION,
            "warnings": self.warnings,
        }

    def save(self, folder: str | Path) -> tuple[Path, Path]:
        """Write the episode and then plan.json into ``folder``; their paths.

        Raises:
            InvalidInput: something else is where the episode shall be.
        """
        folder = Path(folder)
        check_place(folder)
        (folder / RESULT).unlink(missing_ok=True)  # of an earlier plan, beside whose episode it would stand
        episode = write(self.recording, folder / EPISODE, overwrite=True)
        return episode, write_text(folder / RESULT, as_json(self.as_dict()))


def check_place(folder: Path) -> None:
    """Refuse a folder whose ``episode`` is more than an earlier plan: what was recorded there must stay.

    Raises:
        InvalidInput: it is.
    """
    target = folder / EPISODE
    if os.path.lexists(target) and not is_undone(target, PLANNED):
        got = f"{target}, which is no earlier plan, or holds more than one"
        raise InvalidInput("folder of the plan", got=got, expected="one without it", remedy="choose another folder")
