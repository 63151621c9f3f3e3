"""``torchcloth plan``: a motion after which the cloth lies where it shall."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .._utils.files import PROGRESS
from ..errors import InvalidInput
from .diagnose import progress_line
from .folders import check_apart, check_folder, how_to_go_on, place, replaces

if TYPE_CHECKING:
    from ..cloth import Cloth
    from ..diagnosis import Model
    from ..recordings import Recording

PICTURE = (520, 440)  # pixels of each of four moments


def add(verbs: Any) -> None:
    """The verb and its options."""
    parser = verbs.add_parser(
        "plan",
        help="change a motion until the cloth ends at a goal",
        description="Changes the motion of an episode's arms (or free grippers) until the simulated cloth ends at a "
        "goal, within the joints' limits and clear of each other and of the table. Writes plan.json, an episode with "
        "the planned motion to drive the arms by, and a picture.",
    )
    option = parser.add_argument
    option("episode", metavar="EPISODE", help="folder: cloth, grasps, arms, where it is, the motion to begin with")
    option(
        "--goal",
        required=True,
        metavar="GOAL",
        help="an episode (its last points), .npy [N, 3] of points, .obj or .ply of a mesh, pose.npz, or "
        ".npz with x [N, 3] and uv [N, 2] of pieces",
    )
    option(
        "--pieces",
        action="store_true",
        help="the goal tells each piece's place: a mesh by vt, or like pose.npz by vertices, an episode by markers",
    )
    option("--fit", type=Path, metavar="RESULT", help="identification.json, its folder or a .tcm file: take its values")
    option("--draws", type=int, default=1, metavar="N", help="plan for N models, drawn from what the fit leaves open")
    option("--waypoints", type=int, default=4, metavar="N", help="of what is added to each gripper's motion (4)")
    option(
        "--iterations",
        type=int,
        default=15,
        metavar="N",
        help="at most (15; adam needs several times as many: 60, say)",
    )
    option(
        "--method",
        choices=["gauss-newton", "adam"],
        default="gauss-newton",
        help="adam: descent of the distance by reverse mode, as in the DiffCP paper",
    )
    option("--rate", type=float, default=0.003, metavar="X", help="of adam, rad or m at a step (0.003)")
    option("--wait", type=float, default=0.3, metavar="SECONDS", help="after the motion (0.3)")
    option("--acceleration", type=float, metavar="X", help="of any joint, at most [rad/s^2] (3)")
    option("--clearance", type=float, default=0.02, metavar="M", help="of arms, and of arm and table [m] (0.02)")
    option("--dt", type=float, metavar="SECONDS", help="largest substep (default: the stable one)")
    option("--resume", action="store_true", help="go on with a search that was stopped")
    option("--out", type=place, required=True, metavar="DIR", help="folder for plan.json, the episode, the picture")
    parser.set_defaults(run=_plan, stopped=how_to_go_on)


def _plan(options: argparse.Namespace) -> int:
    import torch

    from .. import planning, recordings, viewing
    from .._utils.resume import clear
    from ..planning.result import EPISODE, RESULT, check_place
    from ..robots import ACCELERATION  # pyright: ignore[reportMissingImports] - mapped from robots/ at installation

    torch.set_default_dtype(torch.float64)
    torch.set_num_threads(1)
    for path in (options.out, options.out / EPISODE):
        check_apart(path, options.episode, options.goal)
    check_folder(options.out)
    check_place(options.out)
    recording, goal = recordings.read(options.episode), planning.read_goal(options.goal, options.pieces)
    models = _models(options, recording)
    with progress_line() as progress:
        found = planning.plan(
            models,
            recording,
            goal,
            waypoints=options.waypoints,
            iterations=options.iterations,
            method=options.method,
            rate=options.rate,
            wait=options.wait,
            acceleration=ACCELERATION if options.acceleration is None else options.acceleration,
            clearance=options.clearance,
            dt=options.dt,
            on_progress=lambda *numbers: progress(_words(*numbers)),
            journal=options.out / PROGRESS,
            resume=options.resume or None,
        )
    note = replaces(options.out / RESULT)
    files = found.save(options.out)
    clear(options.out / PROGRESS)
    picture = viewing.picture(viewing.film_of_plan(found, goal), options.out / "plan.png", size=PICTURE)
    planning.print_plan(found)
    print("result: " + ", ".join(str(path) for path in (*files, picture)) + note)
    return 0


def _models(options: argparse.Namespace, recording: Recording) -> list[Cloth] | list[Model]:
    """What is believed of the cloth: the best values first, then draws."""
    from .. import diagnosis
    from ..identification import cloth_from, drawn

    if options.draws < 1:
        raise InvalidInput("--draws", got=options.draws, expected="1 or more")
    if options.fit is None:
        if options.draws > 1:
            raise InvalidInput("--draws", got="it without --fit", expected="a fit, which says what is open")
        return [cloth_from(recording)]
    if options.fit.suffix == ".tcm":
        return diagnosis.drawn_models(diagnosis.read_model(options.fit, recording), options.draws)
    return drawn(options.fit, recording, options.draws, begun=diagnosis.start_of(options.fit))


def _words(number: int, distance: float, best: float) -> str:
    return f"motion {number}: {1e3 * distance:.2f} mm from the goal, the best so far {1e3 * best:.2f} mm"
