"""What the arms that the episodes name can do of the experiments, and an experiment as a folder to drive them by."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from ...errors import TorchclothError
from ...recordings import Recording, write
from ...recordings.templates import is_undone, undone
from ...robots import JointPlan, to_gripper_motion, replan_episode  # pyright: ignore[reportMissingImports] - mapped from robots/
from ...robots.replan_episode import scene_from_episode  # pyright: ignore[reportMissingImports]
from ..data.dataset import Progress
from ..inference.episode_simulation import map_parallel
from .motions import Experiment, blank_frames, blank_readings, planned, possible

FOLDER = "next_experiment"  # beside diagnosis.json
PROPOSED = "synthetic: an experiment that torchcloth diagnose proposes"


@dataclass(frozen=True, eq=False)
class Choice:
    """An experiment as fast as it can be done.

    Attributes:
        experiment: at a speed that the arms can do.
        episode: it, with what is not known yet left blank.
        plan: of the arms; None where no arm was asked.
        why_not: what is in the arms' way; None: nothing.
        unasked: why arms that are named could not be asked; None: they were, or none are.
    """

    experiment: Experiment
    episode: Recording
    plan: JointPlan | None = None
    why_not: str | None = None
    unasked: str | None = None


def feasible(recordings: Sequence[Recording], progress: Progress) -> list[Choice]:
    """All experiments that may be asked for, with what the arms can do about them."""

    def ask(choice: tuple[Experiment, Recording]) -> Choice:
        experiment, template = choice
        episode = planned(experiment, template)
        try:
            scene = scene_from_episode(episode)
        except TorchclothError as error:
            return Choice(experiment, episode, unasked=str(error))
        if scene is None:
            return Choice(experiment, episode)
        if bare := [name for name in scene.arms if scene[name].links_without_primitives]:
            return Choice(experiment, episode, unasked=f"solids of {bare[0]!r} are meshes, which cannot be kept apart")
        progress(f"{experiment}: whether the arms can do it")
        try:
            plan = replan_episode(episode, scene)
        except TorchclothError as error:
            progress(f"{experiment}: the arms cannot do it: {error}")
            return Choice(experiment, episode, why_not=str(error))
        slower = replace(experiment, speed=experiment.speed / plan.slower)
        paths = {name: to_gripper_motion(path) for name, path in plan.motion(scene).items()}
        grippers = {name: blank_readings(path, episode.grippers[name]) for name, path in paths.items()}
        done = replace(
            episode,
            grippers=grippers,
            joints=plan.joints(),
            points=blank_frames(episode, float(plan.t[-1])),
            split={"motion": str(slower)},
        )
        return Choice(slower, done, plan)

    return map_parallel(ask, possible(recordings))


def write_episode(episode: Recording | None, folder: Path) -> str | None:
    """An experiment that nobody has done yet as an episode beside diagnosis.json: paths, joints, the first shape.

    It takes the place of an earlier diagnosis's; None takes that away. What was recorded there stays.

    Returns:
        A warning, or None; a proposal that cannot be written is no reason to lose a diagnosis.
    """
    target = folder / FOLDER
    try:
        if os.path.lexists(target) and not is_undone(target, PROPOSED):
            return f"{target} is no proposal, or holds more than one, and was left as it is"
        if episode is not None:
            write(undone(episode, PROPOSED), target, overwrite=True)
        elif target.exists():
            shutil.rmtree(target)
    except (TorchclothError, OSError) as error:
        return f"the proposed experiment was not written: {error}"
    return None
