"""Experiments that the arms of the episodes can carry out, and a proposed experiment as an episode on disk."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from ...errors import TorchclothError
from ...recordings import Recording, write
from ...recordings.templates import as_template, is_template
from ...robots import (  # pyright: ignore[reportMissingImports] - mapped from robots/ at installation
    JointPlan,
    joint_motion_for_episode,
    to_gripper_motion,
)
from ...robots.replan_episode import scene_from_episode  # pyright: ignore[reportMissingImports]
from ..data.dataset import Progress
from ..inference.episode_simulation import map_parallel
from .motions import Experiment, add_blank_readings, list_experiments, make_blank_frames, make_episode

EXPERIMENT_FOLDER = "next_experiment"  # beside diagnosis.json
PROPOSAL_PROVENANCE = "synthetic: an experiment that torchcloth diagnose proposes"


@dataclass(frozen=True, eq=False)
class FeasibleExperiment:
    """An experiment as fast as the arms can do it.

    Attributes:
        experiment: at a speed that the arms can do.
        episode: the experiment as an episode without measurements.
        plan: motion of the arms; None if no arm was checked.
        why_not: why the arms cannot do it; None: they can.
        not_checked: why arms could not be checked; None: they were, or the episodes name none.
    """

    experiment: Experiment
    episode: Recording
    plan: JointPlan | None = None
    why_not: str | None = None
    not_checked: str | None = None


def check_feasibility(recordings: Sequence[Recording], progress: Progress) -> list[FeasibleExperiment]:
    """Return all experiments that the recordings allow, with what the arms can do.

    Args:
        recordings: the episodes.
        progress: called with one line for each experiment that arms are checked for.
    """

    def check(choice: tuple[Experiment, Recording]) -> FeasibleExperiment:
        experiment, template = choice
        episode = make_episode(experiment, template)
        try:
            scene = scene_from_episode(episode)
        except TorchclothError as error:
            return FeasibleExperiment(experiment, episode, not_checked=str(error))
        if scene is None:
            return FeasibleExperiment(experiment, episode)
        if without_primitives := [name for name in scene.arms if scene[name].links_without_primitives]:
            reason = f"solids of {without_primitives[0]!r} are meshes, for which collisions are not checked"
            return FeasibleExperiment(experiment, episode, not_checked=reason)
        progress(f"{experiment}: whether the arms can do it")
        try:
            plan = joint_motion_for_episode(episode, scene)
        except TorchclothError as error:
            progress(f"{experiment}: the arms cannot do it: {error}")
            return FeasibleExperiment(experiment, episode, why_not=str(error))
        slower = replace(experiment, speed=experiment.speed / plan.slowdown)
        paths = {name: to_gripper_motion(path) for name, path in plan.motion(scene).items()}
        grippers = {name: add_blank_readings(path, episode.grippers[name]) for name, path in paths.items()}
        planned = replace(
            episode,
            grippers=grippers,
            joints=plan.joint_motions(),
            points=make_blank_frames(episode, float(plan.t[-1])),
            split={"motion": str(slower)},
        )
        return FeasibleExperiment(slower, planned, plan)

    return map_parallel(check, list_experiments(recordings))


def write_episode(episode: Recording | None, folder: Path) -> str | None:
    """Write a proposed experiment as an episode beside diagnosis.json: paths, joints, the initial shape.

    It replaces the proposal of an earlier diagnosis; None removes that. A folder with measurements stays.

    Args:
        episode: the experiment, or None.
        folder: folder of the diagnosis.

    Returns:
        A warning, or None. A proposal that cannot be written is no reason to lose a diagnosis.
    """
    target = folder / EXPERIMENT_FOLDER
    try:
        if os.path.lexists(target) and not is_template(target, PROPOSAL_PROVENANCE):
            return f"{target} is no proposal, or holds more than one, and was left as it is"
        if episode is not None:
            write(as_template(episode, PROPOSAL_PROVENANCE), target, overwrite=True)
        elif target.exists():
            shutil.rmtree(target)
    except (TorchclothError, OSError) as error:
        return f"the proposed experiment was not written: {error}"
    return None
