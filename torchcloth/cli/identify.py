"""``torchcloth identify`` and ``torchcloth demo``: fit fabric parameters to recorded episodes."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .._utils.durations import IterationTimer
from .._utils.files import PROGRESS_FOLDER_NAME
from ..errors import InvalidInput
from . import identify_fields
from .first_shape_option import add_network_option, estimate_first_shapes
from .output_paths import (
    check_output_folder,
    check_outside_episodes,
    output_path,
    print_line,
    replacement_note,
    resume_hint,
)
from .recording_checks import add_checks_option

if TYPE_CHECKING:
    from ..cloth import Cloth
    from ..diagnosis import WorldModel
    from ..identification import Identification
    from ..identification.fields import FieldFit
    from ..recordings import Recording

DEMO_EPISODE = "bimanual_swing"
NUISANCE_OF_CAUSE = {"obs.clock": "clock", "obs.extrinsic": "camera", "obs.rotation": "camera", "obs.edge": "rim"}


def add(verbs: Any) -> None:
    """Add both verbs and their options."""
    identify = verbs.add_parser("identify", help="fit fabric parameters to recorded episodes")
    identify.add_argument("episodes", nargs="+", metavar="EPISODE", help="folder of a recording")
    identify.add_argument(
        "--out", type=output_path, required=True, metavar="DIR", help="folder for the result and pictures"
    )
    identify.set_defaults(run=_identify, stopped=resume_hint)
    _add_options(identify)
    demo = verbs.add_parser("demo", help="identify the shipped example")
    demo.add_argument("--out", type=output_path, default=Path("out/demo"), metavar="DIR", help="default out/demo")
    demo.set_defaults(run=_demo, stopped=resume_hint)
    _add_options(demo)


def _add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--model", metavar="MODEL", help="a .tcm file of `diagnose` to start from")
    parser.add_argument(
        "--fit",
        nargs="+",
        metavar="NAME",
        help="parameters to fit (default: those of the fabric, and the first one of each effect)",
    )
    parser.add_argument(
        "--start",
        nargs="+",
        action="extend",
        default=[],
        metavar="NAME=VALUE",
        help="start values in SI units, e.g. youngs_modulus=2e5",
    )
    parser.add_argument(
        "--method",
        choices=["gauss-newton", "lbfgs", "adam", "gradient-descent"],
        default="gauss-newton",
        help="default: gauss-newton. adam and gradient-descent minimise the DiffCP paper's Chamfer distance alone, "
        "without priors; they are there for comparison",
    )
    parser.add_argument(
        "--stop",
        choices=["converged", "paper"],
        default="converged",
        help="default: converged. paper stops at a Chamfer distance below 1.5 cm",
    )
    parser.add_argument(
        "--iterations",
        type=int,
        default=35,
        metavar="N",
        help="most iterations on all frames (default: 35). Up to 10 on early frames come before them. Where "
        "derivatives are of no use, a search takes up to 20 in each stage",
    )
    parser.add_argument(
        "--use",
        nargs="+",
        choices=["points", "markers", "force"],
        help="kinds of data to compare with (default: all that an episode has)",
    )
    parser.add_argument(
        "--nuisance",
        nargs="+",
        action="extend",
        default=[],
        metavar="NAME[=STD]",
        help="unknowns of each episode: clock, jitter, camera, rim, grasp, grasp_turn, grip, shape, tare; STD is the "
        "prior's standard deviation, e.g. clock=0.02, and 0 leaves one out",
    )
    parser.add_argument(
        "--exact-bench",
        action="store_true",
        help="take stamps, camera, grips and first shape as exact, as in a simulation of one's own; else their errors "
        "are unknowns",
    )
    parser.add_argument(
        "--prior",
        nargs="+",
        action="extend",
        default=[],
        metavar="NAME=VALUE,SPREAD",
        help="prior of a parameter; SPREAD is a factor for positive parameters, a standard deviation for others",
    )
    parser.add_argument(
        "--contact",
        type=float,
        metavar="SPACING",
        help="spacing of the contact grid between layers [m] (default: as cloth.layer_gap of the episode says)",
    )
    parser.add_argument("--dt", type=float, metavar="SECONDS", help="largest substep (default: the stable one)")
    parser.add_argument(
        "--engine",
        choices=["auto", "reference", "fused"],
        default="auto",
        help="default: auto, which takes the fused engine if it supports the model",
    )
    parser.add_argument(
        "--starts",
        type=int,
        default=1,
        metavar="N",
        help="number of start values, spread over two decades (default: 1)",
    )
    parser.add_argument(
        "--profile", nargs="+", default=[], metavar="NAME", help="find the interval by profile likelihood"
    )
    add_checks_option(parser)
    add_network_option(parser)
    parser.add_argument(
        "--refine",
        action=argparse.BooleanOptionalAction,
        help="correct for the coarseness of the mesh by one run on a mesh twice as fine (default: yes, but not with "
        "--profile, nor where --method or --stop follow the paper)",
    )
    parser.add_argument("--resume", action="store_true", help="resume a fit into DIR that was stopped")
    identify_fields.add(parser)


def _demo(options: argparse.Namespace) -> int:
    with resources.as_file(resources.files("torchcloth") / "examples" / DEMO_EPISODE) as folder:
        options.episodes, options.exact_bench = [str(folder)], True  # MuJoCo recorded it, without a bench's errors
        return _identify(options)


def _identify(options: argparse.Namespace) -> int:
    import torch

    from .. import recordings
    from ..identification import Identification
    from ..recordings.consistency import merge_scene

    torch.set_default_dtype(torch.float64)  # sensitivities lose digits over thousands of substeps in float32
    torch.set_num_threads(1)  # on meshes of a thousand triangles a second thread costs more than it gains
    check_outside_episodes(options.out, *options.episodes)
    check_output_folder(options.out)
    identify_fields.check(options, _default_options())
    episodes = [recordings.read(path) for path in options.episodes]
    cloth, notes = _cloth(options, merge_scene(episodes))
    for note in notes:
        print(f"note: {note}")
    episodes, shape_std = estimate_first_shapes(options, cloth, episodes)
    if shape_std is not None and "shape" not in parse_nuisances(options.nuisance):
        options.nuisance.append(f"shape={shape_std}")
    size = f"{len(episodes)} episode(s), {len(cloth.mesh.faces)} triangles"
    seconds, step = sum(float(e.points.t[-1] - e.points.t[0]) for e in episodes if e.points), cloth.stable_step()
    substeps_text = f", {seconds / step:.2g} in all frames" if seconds else ""
    print(f"{size}, stable substep {step:.3g} s with the start values{substeps_text}")
    if options.fields:
        identify_fields.make_fields(cloth, options.fields)
    fit = _fit(options, cloth, episodes)
    if isinstance(fit, Identification):
        fit = replace(fit, warnings=[*fit.warnings, *notes])
        return _report(options, fit, cloth)
    return identify_fields.report(options.out, fit, cloth)


def _default_options() -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    _add_options(parser)
    return parser.parse_args([])


def _cloth(options: argparse.Namespace, recording: Recording) -> tuple[Cloth, list[str]]:
    """Return the cloth at its start values, and notes on parts of the model that it cannot hold."""
    from ..dynamics.contact import Contact
    from ..episodes.unknowns import find_scalar_parameters
    from ..identification import build_cloth

    if options.model is not None:
        cloth, notes = _cloth_from_model(options, recording)
    else:
        contact = None if options.contact is None else Contact(options.contact)
        cloth, notes = build_cloth(recording, contact=contact), []
    cloth.engine = options.engine
    names = find_scalar_parameters(cloth)
    for name, value in parse_assignments(options.start).items():
        if name not in names:
            raise InvalidInput("--start", got=repr(name), expected=f"one of {', '.join(sorted(names))}")
        cloth.get_submodule(names[name]).set(value)  # type: ignore[operator]
    return cloth, notes


def _cloth_from_model(options: argparse.Namespace, recording: Recording) -> tuple[Cloth, list[str]]:
    """Return the extended cloth of a diagnosis in the episode's scene, and notes on what it cannot hold."""
    from .. import diagnosis

    if options.contact is not None:
        raise InvalidInput("--contact", got="it and --model", expected="one of them")
    file = diagnosis.read_model(options.model, recording)
    return file.model.build_world().cloth.require_default_gradients_(), describe_causes_outside_cloth(file.model)


def describe_causes_outside_cloth(model: WorldModel) -> list[str]:
    """Return notes on causes of a model that belong to robot or camera, which a cloth cannot hold."""
    from .. import diagnosis

    notes = []
    for name, amplitude in diagnosis.list_causes_outside_cloth(model).items():
        allowed = NUISANCE_OF_CAUSE.get(name.partition("[")[0])
        remedy = f"--nuisance {allowed} allows for it" if allowed else "no option allows for it"
        notes.append(f"{name} = {amplitude:.4g} of the model belongs to robot or camera, not to the cloth: {remedy}")
    return notes


def parse_assignments(pairs: Sequence[str], option: str = "--start") -> dict[str, float]:
    """Parse the NAME=NUMBER pairs of an option.

    Raises:
        InvalidInput: a pair that is none, or a name twice.
    """
    _check_unique(pairs, option)
    parsed = {}
    for pair in pairs:
        name, _, value = pair.partition("=")
        try:
            parsed[name] = float(value)
        except ValueError:
            raise InvalidInput(option, got=repr(pair), expected="NAME=NUMBER in SI units") from None
    return parsed


def parse_nuisances(options: Sequence[str]) -> dict[str, float | None]:
    """Parse NAME or NAME=STD of ``--nuisance``; the value is None if no standard deviation is given.

    Raises:
        InvalidInput: a standard deviation that is no number, or a name twice.
    """
    _check_unique(options, "--nuisance")
    plain = dict.fromkeys(name for name in options if "=" not in name)
    return plain | parse_assignments([pair for pair in options if "=" in pair], "--nuisance")


def _check_unique(pairs: Sequence[str], option: str) -> None:
    """Refuse a name that is given twice, because one of its values would be ignored."""
    names = [pair.partition("=")[0] for pair in pairs]
    for k, name in enumerate(names):
        if name in names[:k]:
            raise InvalidInput(option, got=f"{name!r} twice", expected="each name once")


def _parse_priors(pairs: Sequence[str]) -> dict[str, tuple[float, float]]:
    _check_unique(pairs, "--prior")
    parsed = {}
    for pair in pairs:
        name, _, numbers = pair.partition("=")
        try:
            value, spread = (float(number) for number in numbers.split(","))
        except ValueError:
            raise InvalidInput("--prior", got=repr(pair), expected="NAME=VALUE,SPREAD") from None
        parsed[name] = (value, spread)
    return parsed


def _fit(options: argparse.Namespace, cloth: Cloth, episodes: list[Recording]) -> Identification | FieldFit:
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    from ..identification import identify

    columns = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("{task.description}"))
    with Progress(*columns, refresh_per_second=2, disable=not sys.stdout.isatty()) as progress:
        task = progress.add_task("simulating with the start values", total=None)
        timer = IterationTimer(options.iterations)

        def advance(iteration: int, chamfer: float, values: dict[str, float], share: float) -> None:
            shown = ", ".join(f"{name} {value:.4g}" for name, value in list(values.items())[:2])
            used = "all frames" if share == 1 else f"first {100 * share:.0f} % of frames"
            text = shown if math.isnan(chamfer) else f"Chamfer {1e3 * chamfer:.2f} mm, {shown}"
            text = ", ".join(filter(None, (used, text, timer.describe(iteration, share))))
            progress.update(task, completed=iteration, description=text)
            if not progress.console.is_terminal:  # in a log file the bar would appear only once, at the end
                print_line(f"iteration {iteration}: {text}")

        if options.fields:
            return identify_fields.fit(options, cloth, episodes, options.out / PROGRESS_FOLDER_NAME, advance)
        return identify(
            cloth,
            episodes,
            options.fit,
            method=options.method,
            stop=options.stop,
            iterations=options.iterations,
            starts=options.starts,
            profile=options.profile,
            journal=options.out / PROGRESS_FOLDER_NAME,
            resume=options.resume or None,  # None: refuse to discard the progress of a stopped fit
            dt=options.dt,
            use=options.use,
            nuisances=parse_nuisances(options.nuisance),
            priors=_parse_priors(options.prior),
            on_progress=advance,
            refine=_should_refine(options),
            checks=options.checks,
            exact_bench=options.exact_bench,
        )


def _should_refine(options: argparse.Namespace) -> bool:
    """Whether to correct for the mesh: as asked for; else if the search ends at an optimum and nothing is profiled."""
    if options.refine is not None:
        return options.refine
    return options.method in ("gauss-newton", "lbfgs") and options.stop == "converged" and not options.profile


def _report(options: argparse.Namespace, fit: Identification, cloth: Cloth) -> int:
    from .._utils.resume import clear_store
    from ..identification import build_episode
    from ..identification.pictures import save_fit_pictures
    from ..identification.result import IDENTIFICATION_FILE_NAME
    from ..identification.tables import print_fit
    from ..identification.verdict import describe_verdict

    folder = options.out
    note = replacement_note(folder / IDENTIFICATION_FILE_NAME)
    path = fit.save(folder, options.model)
    episodes = [build_episode(cloth, recording) for recording in fit.recordings]
    pictures = save_fit_pictures(fit, episodes, cloth.mesh.faces, folder)
    clear_store(folder / PROGRESS_FOLDER_NAME)
    print_fit(fit)
    print(f"result:   {path}{note}")
    print("pictures: " + ", ".join(str(p) for p in pictures))
    print(f"verdict:  {describe_verdict(fit)}")
    return 0
