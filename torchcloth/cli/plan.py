"""``torchcloth plan``: plan a motion that brings the cloth to a goal."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .._utils.durations import IterationTimer
from .._utils.files import PROGRESS_FOLDER_NAME
from ..errors import InvalidInput
from .diagnose import show_progress_line
from .first_shape_option import add_network_option, estimate_first_shapes
from .output_paths import check_output_folder, check_outside_episodes, output_path, replacement_note, resume_hint

if TYPE_CHECKING:
    from ..cloth import Cloth
    from ..diagnosis import WorldModel
    from ..recordings import Recording

PANEL_SIZE_PX = (520, 440)  # of each of the four frames in plan.png


def add(verbs: Any) -> None:
    """Add the verb and its options."""
    parser = verbs.add_parser(
        "plan",
        help="plan a motion that brings the cloth to a goal",
        description="Change the motion of an episode's arms (or free grippers) until the simulated cloth ends at a "
        "goal. The motion stays within the joints' limits, and the arms keep clear of each other and of the table. "
        "Writes plan.json, an episode with the planned motion for the arms, and a picture.",
    )
    option = parser.add_argument
    option(
        "episode", metavar="EPISODE", help="folder with the cloth, its first shape, the arms and a motion to begin with"
    )
    option(
        "--goal",
        required=True,
        metavar="GOAL",
        help="an episode (its last points), an .npy file of points [N, 3], a mesh (.obj or .ply), a pose.npz, or an "
        ".npz file with points x [N, 3] and their pattern coordinates uv [N, 2]",
    )
    option(
        "--correspondences",
        action="store_true",
        help="match material points instead of shapes: of a mesh by its vt, or by its vertices like pose.npz; of an "
        "episode by its markers",
    )
    option(
        "--fit",
        type=Path,
        metavar="RESULT",
        help="take the values of identification.json, of its folder or of a .tcm file",
    )
    option(
        "--samples",
        type=int,
        default=1,
        metavar="N",
        help="plan for N models that are sampled from the posterior of --fit (default: 1)",
    )
    option(
        "--waypoints",
        type=int,
        default=4,
        metavar="N",
        help="waypoints of the correction of each gripper's motion (default: 4)",
    )
    option(
        "--iterations",
        type=int,
        default=15,
        metavar="N",
        help="most iterations (default: 15; adam needs several times as many, e.g. 60)",
    )
    option(
        "--method",
        choices=["gauss-newton", "adam"],
        default="gauss-newton",
        help="default: gauss-newton. adam follows reverse-mode gradients of the distance, as the DiffCP paper does",
    )
    option(
        "--learning-rate", type=float, default=0.003, metavar="X", help="step size of adam [rad or m] (default: 0.003)"
    )
    option("--wait", type=float, default=0.3, metavar="SECONDS", help="time after the motion's end (default: 0.3)")
    option("--acceleration", type=float, metavar="X", help="largest acceleration of a joint [rad/s^2] (default: 3)")
    option(
        "--clearance",
        type=float,
        default=0.02,
        metavar="M",
        help="smallest distance between the arms, and between arms and table [m] (default: 0.02)",
    )
    add_network_option(parser)
    option("--dt", type=float, metavar="SECONDS", help="largest substep (default: the stable one)")
    option("--resume", action="store_true", help="resume a plan that was stopped")
    option(
        "--out",
        type=output_path,
        required=True,
        metavar="DIR",
        help="folder for plan.json, the episode and the picture",
    )
    parser.set_defaults(run=_plan, stopped=resume_hint)


def _plan(options: argparse.Namespace) -> int:
    import torch

    from .. import planning, recordings, viewing
    from .._utils.resume import clear_store
    from ..identification import build_cloth
    from ..planning.result import PLAN_FILE, PLANNED_EPISODE_FOLDER, check_result_folder
    from ..robots import DEFAULT_JOINT_ACCELERATION  # pyright: ignore[reportMissingImports] - mapped from robots/ at installation

    torch.set_default_dtype(torch.float64)
    torch.set_num_threads(1)
    for path in (options.out, options.out / PLANNED_EPISODE_FOLDER):
        check_outside_episodes(path, options.episode, options.goal)
    check_output_folder(options.out)
    check_result_folder(options.out)
    recording, goal = recordings.read(options.episode), planning.read_goal(options.goal, options.correspondences)
    (recording,), _ = estimate_first_shapes(options, build_cloth(recording), [recording])
    models, timer = _models(options, recording), IterationTimer(options.iterations)
    with show_progress_line() as progress:
        result = planning.plan(
            models,
            recording,
            goal,
            waypoints=options.waypoints,
            iterations=options.iterations,
            method=options.method,
            rate=options.learning_rate,
            wait=options.wait,
            acceleration=DEFAULT_JOINT_ACCELERATION if options.acceleration is None else options.acceleration,
            clearance=options.clearance,
            dt=options.dt,
            on_progress=lambda *numbers: progress(_progress_text(timer, *numbers)),
            journal=options.out / PROGRESS_FOLDER_NAME,
            resume=options.resume or None,
        )
    replacement = replacement_note(options.out / PLAN_FILE)
    files = result.save(options.out)
    clear_store(options.out / PROGRESS_FOLDER_NAME)
    picture = viewing.write_png(viewing.film_from_plan(result, goal), options.out / "plan.png", size=PANEL_SIZE_PX)
    planning.print_plan(result)
    print("result: " + ", ".join(str(path) for path in (*files, picture)) + replacement)
    return 0


def _models(options: argparse.Namespace, recording: Recording) -> list[Cloth] | list[WorldModel]:
    """Return the models to plan with: the best estimate first, then samples of the posterior."""
    from .. import diagnosis
    from ..identification import build_cloth, sample_posterior

    if options.samples < 1:
        raise InvalidInput("--samples", got=options.samples, expected="1 or more")
    if options.fit is None:
        if options.samples > 1:
            raise InvalidInput("--samples", got="it without --fit", expected="--fit as well")
        return [build_cloth(recording)]
    if options.fit.suffix == ".tcm":
        return diagnosis.draw_models(diagnosis.read_model(options.fit, recording), options.samples)
    return sample_posterior(
        options.fit, recording, options.samples, build_start=diagnosis.make_start_builder(options.fit)
    )


def _progress_text(timer: IterationTimer, number: int, distance: float, best: float) -> str:
    text = f"motion {number}: {1e3 * distance:.2f} mm from the goal, the best so far {1e3 * best:.2f} mm"
    return ", ".join(filter(None, (text, timer.describe(number))))
