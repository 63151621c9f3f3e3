"""``torchcloth pose``: estimate the full mesh over time from a recording that shows a part of it."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import InvalidInput
from .first_shape_option import add_network_option, read_network
from .identify import describe_causes_outside_cloth, parse_assignments, parse_nuisances
from .output_paths import check_output_folder, check_outside_episodes, output_path, print_line, replacement_note
from .recording_checks import add_checks_option

if TYPE_CHECKING:
    from ..cloth import Cloth
    from ..pose import PoseEstimate
    from ..recordings import Recording

PANEL_SIZE_PX = (520, 440)  # of each of the four frames in pose.png


def add(verbs: Any) -> None:
    """Add the verb and its options."""
    pose = verbs.add_parser("pose", help="estimate the full mesh over time from partial clouds")
    pose.add_argument("episode", metavar="EPISODE", help="folder of a recording")
    pose.add_argument(
        "--fit",
        type=Path,
        metavar="RESULT",
        help="take the values of identification.json, of its folder or of a .tcm file",
    )
    pose.add_argument(
        "--uncertainty",
        nargs="+",
        action="extend",
        default=[],
        metavar="NAME=SPREAD",
        help="uncertainty of a value; SPREAD is a factor for positive parameters, a standard deviation for others",
    )
    pose.add_argument(
        "--window",
        type=float,
        default=0.15,
        metavar="SECONDS",
        help="time over which the corrective force is constant (default: 0.15)",
    )
    pose.add_argument(
        "--modes", type=int, default=8, metavar="N", help="number of smooth modes of the corrective force (default: 8)"
    )
    pose.add_argument(
        "--nuisance",
        nargs="+",
        action="extend",
        default=[],
        metavar="NAME[=STD]",
        help="unknowns of the episode, as in `torchcloth identify`",
    )
    pose.add_argument(
        "--use", nargs="+", choices=["points", "markers", "force"], help="kinds of data to compare with (default: all)"
    )
    pose.add_argument("--dt", type=float, metavar="SECONDS", help="largest substep (default: the stable one)")
    add_checks_option(pose)
    add_network_option(pose)
    pose.add_argument("--truth", action="store_true", help="show the true cloth of a synthetic episode in the picture")
    pose.add_argument(
        "--out", type=output_path, required=True, metavar="DIR", help="folder for the result and the picture"
    )
    pose.set_defaults(run=_pose)


def _pose(options: argparse.Namespace) -> int:
    import torch

    from .. import recordings, viewing
    from ..inspection.corrections import check_all
    from ..pose.tables import print_pose

    torch.set_default_dtype(torch.float64)
    torch.set_num_threads(1)
    check_outside_episodes(options.out, options.episode)
    check_output_folder(options.out)
    recording = recordings.read(options.episode, with_truth=options.truth)
    if options.truth:
        recording.require("truth", by="--truth")
    cloth, uncertain = _model(options, recording)
    estimate = _estimate(options, cloth, uncertain, recording)
    note = replacement_note(options.out / "pose.json")
    files = estimate.save(options.out)
    shown = check_all([recording])[0][0] if options.checks else recording  # the clouds at the times that were used
    film = viewing.film_from_pose(shown, estimate, truth=options.truth)
    picture = viewing.write_png(film, options.out / "pose.png", size=PANEL_SIZE_PX)
    print_pose(estimate)
    if options.fit is not None and _was_fitted_to(options.fit, recording):
        print("note: the fit used this episode. It counts twice, so the fabric's standard errors are too small")
    print("result: " + ", ".join(str(path) for path in (*files, picture)) + note)
    return 0


def _was_fitted_to(fit: Path, recording: Recording) -> bool:
    """Whether the fit or model was fitted to this episode."""
    from .. import diagnosis
    from ..identification import is_fitted_episode

    return diagnosis.was_fitted(fit, recording) if fit.suffix == ".tcm" else is_fitted_episode(fit, recording)


def _model(options: argparse.Namespace, recording: Recording) -> tuple[Cloth, dict[str, tuple[float, float]]]:
    """Return the cloth, and value and spread of each uncertain parameter."""
    from ..diagnosis import make_start_builder
    from ..episodes.unknowns import find_scalar_parameters
    from ..identification import build_cloth, load_fitted_cloth

    if options.fit is None:
        cloth, uncertain = build_cloth(recording), {}
    elif options.fit.suffix == ".tcm":
        cloth, uncertain = _cloth_from_model(options.fit, recording)
    else:
        cloth, uncertain = load_fitted_cloth(options.fit, recording, make_start_builder(options.fit))
    names = find_scalar_parameters(cloth)
    for name, spread in parse_assignments(options.uncertainty, "--uncertainty").items():
        if name not in names:
            raise InvalidInput("--uncertainty", got=repr(name), expected=f"one of {', '.join(sorted(names))}")
        uncertain[name] = (cloth.get_submodule(names[name]).value.item(), spread)  # type: ignore[union-attr]
    return cloth, uncertain


def _cloth_from_model(path: Path, recording: Recording) -> tuple[Cloth, dict[str, tuple[float, float]]]:
    from .. import diagnosis

    file = diagnosis.read_model(path, recording)
    for note in describe_causes_outside_cloth(file.model):
        print(f"note: {note}")
    return file.model.build_world().cloth, diagnosis.derive_priors(file)


def _estimate(
    options: argparse.Namespace, cloth: Cloth, uncertain: dict[str, tuple[float, float]], recording: Recording
) -> PoseEstimate:
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    from ..pose import estimate_pose

    columns = (SpinnerColumn(), TimeElapsedColumn(), TextColumn("{task.description}"))
    with Progress(*columns, refresh_per_second=2, disable=not sys.stdout.isatty()) as progress:
        task = progress.add_task("reading", total=None)

        def advance(stage: str, share: float) -> None:
            text = f"{stage}: corrective force {100 * share:.1f} % of the weight"
            progress.update(task, description=text)
            if not progress.console.is_terminal:
                print_line(text)

        return estimate_pose(
            cloth,
            recording,
            uncertain=uncertain,
            window=options.window,
            modes=options.modes,
            nuisances=parse_nuisances(options.nuisance),
            use=options.use,
            dt=options.dt,
            on_progress=advance,
            checks=options.checks,
            start=read_network(options) or "recording",
        )
