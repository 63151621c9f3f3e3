"""The result of motion planning: the planned motion and what is expected of it."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torch import Tensor

from .._utils.files import to_json, write_text
from ..errors import InvalidInput
from ..recordings import Recording, write
from ..recordings.templates import is_template
from ..types import Trajectory

PLAN_FILE = "plan.json"
PLANNED_EPISODE_FOLDER = "episode"
PLAN_SCHEMA = "torchcloth.plan/1"
PLANNED_PROVENANCE = "synthetic: a motion that torchcloth plan proposes"
PLAN_CONVENTION = (
    "SI units. distance: mean distance of the goal's points from the cloth's surface at the last frame (one-sided "
    "Chamfer); for a goal with triangles, the mean of that and of the distance of the cloth's vertices from the goal's "
    "surface; for material points, their mean distance from where they shall be. before: the simulated recorded "
    "motion; after: the planned one; one number for each model. distance_history: mean over the models, for every "
    "motion that was evaluated. nearest_limit.fraction: of the way from the recorded motion to the first limit."
)


@dataclass(frozen=True, eq=False)
class MotionPlan:
    """The result of ``plan``.

    Attributes:
        recording: an episode without observations: the scene, the first shape and the planned motion, of arms their
            joints too. ``robots.replay`` gives its poses, ``recordings.write`` stores it.
        motion: the planned poses by gripper.
        distance_before: m, distance to the goal at the end of the recorded motion, for each model.
        distance_after: m, the same for the planned motion.
        distance_history: m, mean distance of every motion that was evaluated.
        times: [T] s, frames.
        frames: [T, V, 3] m, the cloth of the first model under the planned motion.
        frames_before: [T, V, 3] m, the same under the recorded motion.
        faces: [F, 3] vertex indices.
        path_change: m, largest distance of each gripper's path from the recorded one.
        nearest_limit: fraction of the way from the recorded motion to the first limit, and the name of that limit.
        nearest_solids: the two solids that come nearest to each other; empty if arm clearance was not checked.
        stop_reason: why the search stopped.
        seconds: duration of the search.
        warnings: what to mistrust, in sentences.
    """

    recording: Recording = field(repr=False)
    motion: dict[str, Trajectory] = field(repr=False)
    distance_before: list[float]
    distance_after: list[float]
    distance_history: list[float] = field(repr=False)
    times: Tensor = field(repr=False)
    frames: Tensor = field(repr=False)
    frames_before: Tensor = field(repr=False)
    faces: Tensor = field(repr=False)
    path_change: dict[str, float]
    nearest_limit: tuple[float, str]
    nearest_solids: str
    stop_reason: str
    seconds: float
    warnings: list[str]

    def as_dict(self) -> dict[str, Any]:
        """Return the content of plan.json."""
        return {
            "schema": PLAN_SCHEMA,
            "distance": {"before": self.distance_before, "after": self.distance_after, "unit": "m"},
            "distance_history": self.distance_history,
            "path_change": self.path_change,
            "nearest_limit": {"fraction": self.nearest_limit[0], "limit": self.nearest_limit[1]},
            "nearest_solids": self.nearest_solids,
            "stop_reason": self.stop_reason,
            "seconds": self.seconds,
            "episode": PLANNED_EPISODE_FOLDER,
            "convention": PLAN_CONVENTION,
            "warnings": self.warnings,
        }

    def save(self, folder: str | Path) -> tuple[Path, Path]:
        """Write the episode and then plan.json into ``folder``, and return both paths.

        Raises:
            InvalidInput: something else lies where the episode goes.
        """
        folder = Path(folder)
        check_result_folder(folder)
        (folder / PLAN_FILE).unlink(missing_ok=True)  # an earlier plan would not belong to the new episode
        episode = write(self.recording, folder / PLANNED_EPISODE_FOLDER, overwrite=True)
        return episode, write_text(folder / PLAN_FILE, to_json(self.as_dict()))


def check_result_folder(folder: Path) -> None:
    """Refuse a folder whose ``episode`` is more than an earlier plan: a recording in it must not be lost.

    Raises:
        InvalidInput: the episode holds observations, or is not a plan.
    """
    target = folder / PLANNED_EPISODE_FOLDER
    if os.path.lexists(target) and not is_template(target, PLANNED_PROVENANCE):
        got = f"{target}, which is no earlier plan, or holds more than one"
        raise InvalidInput("folder of the plan", got=got, expected="one without it", remedy="choose another folder")
