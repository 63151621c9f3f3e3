"""``torchcloth identify | demo``: fits fabric parameters to recorded episodes."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .._utils.files import PROGRESS
from ..errors import InvalidInput
from . import fields
from .folders import check_apart, check_folder, how_to_go_on, place, replaces, say

if TYPE_CHECKING:
    from ..cloth import Cloth
    from ..diagnosis import Model
    from ..identification import Identification
    from ..identification.fields import FieldFit
    from ..recordings import Recording

DEMO = "bimanual_swing"
NUISANCES = {"obs.clock": "clock", "obs.extrinsic": "camera", "obs.rotation": "camera", "obs.edge": "rim"}  # by cause


def add(verbs: Any) -> None:
    """The verbs and their options."""
    identify = verbs.add_parser("identify", help="fit fabric parameters to recorded episodes")
    identify.add_argument("episodes", nargs="+", metavar="EPISODE", help="folder of a recording")
    identify.add_argument("--out", type=place, required=True, metavar="DIR", help="folder for the result and pictures")
    identify.set_defaults(run=_identify, stopped=how_to_go_on)
    _add_options(identify)
    demo = verbs.add_parser("demo", help="identify the shipped example")
    demo.add_argument("--out", type=place, default=Path("out/demo"), metavar="DIR", help="default out/demo")
    demo.set_defaults(run=_demo, stopped=how_to_go_on)
    _add_options(demo)


def _add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--model", metavar="MODEL", help="a .tcm file of `diagnose` to start from")
    parser.add_argument(
        "--fit", nargs="+", metavar="NAME", help="parameters to fit (default: of the fabric, and each effect's first)"
    )
    parser.add_argument(
        "--start",
        nargs="+",
        action="extend",
        default=[],
        metavar="NAME=VALUE",
        help="start values, SI units, e.g. youngs_modulus=2e5",
    )
    parser.add_argument(
        "--method",
        choices=["gauss-newton", "lbfgs", "adam", "gradient-descent"],
        default="gauss-newton",
        help="default gauss-newton; the last two: on the paper's Chamfer distance alone, without priors, to compare",
    )
    parser.add_argument(
        "--stop", choices=["converged", "paper"], default="converged", help="paper: Chamfer below 1.5 cm"
    )
    parser.add_argument(
        "--iterations",
        type=int,
        default=35,
        metavar="N",
        help="at most N on all frames, after up to 10 on early ones (35); what is sought where derivatives "
        "fail takes up to 20 a stage",
    )
    parser.add_argument(
        "--use", nargs="+", choices=["points", "markers", "force"], help="kinds of data (default: all of an episode)"
    )
    parser.add_argument(
        "--nuisance",
        nargs="+",
        action="extend",
        default=[],
        metavar="NAME[=STD]",
        help="of each episode: clock, camera, grasp, shape, tare, rim; with the prior's deviation, e.g. clock=0.02",
    )
    parser.add_argument(
        "--prior",
        nargs="+",
        action="extend",
        default=[],
        metavar="NAME=VALUE,SPREAD",
        help="SPREAD: a factor for positive parameters, a standard deviation for others",
    )
    parser.add_argument("--contact", type=float, metavar="SPACING", help="contact grid [m]; left out: no contact")
    parser.add_argument("--dt", type=float, metavar="SECONDS", help="largest substep (default: the stable one)")
    parser.add_argument(
        "--engine", choices=["auto", "reference", "fused"], default="auto", help="default auto: fused where it can be"
    )
    parser.add_argument("--starts", type=int, default=1, metavar="N", help="starts over two decades (1)")
    parser.add_argument(
        "--profile", nargs="+", default=[], metavar="NAME", help="seek the interval by fitting the others beside it"
    )
    parser.add_argument(
        "--refine",
        action=argparse.BooleanOptionalAction,
        help="correct for the coarseness of the mesh by one run on a mesh twice as fine (default; not with --profile, "
        "or where --method or --stop follow the paper)",
    )
    parser.add_argument("--resume", action="store_true", help="go on where a stopped fit into DIR was")
    fields.add(parser)


def _demo(options: argparse.Namespace) -> int:
    with resources.as_file(resources.files("torchcloth") / "examples" / DEMO) as folder:
        options.episodes = [str(folder)]
        return _identify(options)


def _identify(options: argparse.Namespace) -> int:
    import torch

    from .. import recordings
    from ..identification import Identification
    from ..recordings.consistency import together

    torch.set_default_dtype(torch.float64)  # sensitivities lose digits over thousands of substeps in float32
    torch.set_num_threads(1)  # meshes of a thousand triangles: a second thread costs more than it gives
    check_apart(options.out, *options.episodes)
    check_folder(options.out)
    fields.check(options, _defaults())
    episodes = [recordings.read(path) for path in options.episodes]
    cloth, notes = _cloth(options, together(episodes))
    for note in notes:
        print(f"note: {note}")
    size = f"{len(episodes)} episode(s), {len(cloth.mesh.faces)} triangles"
    seconds, step = sum(float(e.points.t[-1] - e.points.t[0]) for e in episodes if e.points), cloth.stable_step()
    many = f", {seconds / step:.2g} in all frames" if seconds else ""
    print(f"{size}, stable substep {step:.3g} s with the start values{many}")
    if options.fields:
        fields.spread_out(cloth, options.fields)
    fit = _fit(options, cloth, episodes)
    if isinstance(fit, Identification):
        fit = replace(fit, warnings=[*fit.warnings, *notes])
        return _report(options, fit, cloth, episodes)
    return fields.report(options.out, fit, cloth)


def _defaults() -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    _add_options(parser)
    return parser.parse_args([])


def _cloth(options: argparse.Namespace, recording: Recording) -> tuple[Cloth, list[str]]:
    """The cloth at its start values, and what of its model it has not."""
    from ..dynamics.contact import Contact
    from ..episodes.unknowns import available
    from ..identification import cloth_from

    if options.model is not None:
        cloth, notes = _of_model(options, recording)
    else:
        contact = None if options.contact is None else Contact(options.contact)
        cloth, notes = cloth_from(recording, contact=contact), []
    cloth.engine = options.engine
    names = available(cloth)
    for name, value in assignments(options.start).items():
        if name not in names:
            raise InvalidInput("--start", got=repr(name), expected=f"one of {', '.join(sorted(names))}")
        cloth.get_submodule(names[name]).set(value)  # type: ignore[operator]
    return cloth, notes


def _of_model(options: argparse.Namespace, recording: Recording) -> tuple[Cloth, list[str]]:
    """The extended cloth of a diagnosis, in the episode's scene."""
    from .. import diagnosis

    if options.contact is not None:
        raise InvalidInput("--contact", got="it beside --model", expected="one of them")
    file = diagnosis.read_model(options.model, recording)
    return file.model.world().cloth.requires_grad_(True), what_is_beside(file.model)


def what_is_beside(model: Model) -> list[str]:
    """Notes on causes that a cloth cannot carry."""
    from .. import diagnosis

    notes = []
    for name, amplitude in diagnosis.beside_the_cloth(model).items():
        allowed = NUISANCES.get(name.partition("[")[0])
        to_do = f"--nuisance {allowed} allows for it" if allowed else "nothing here allows for it"
        notes.append(f"{name} = {amplitude:.4g} of the model is of robot or camera and not in the cloth: {to_do}")
    return notes


def assignments(pairs: Sequence[str], option: str = "--start") -> dict[str, float]:
    """NAME=NUMBER pairs of an option."""
    _each_once(pairs, option)
    out = {}
    for pair in pairs:
        name, _, value = pair.partition("=")
        try:
            out[name] = float(value)
        except ValueError:
            raise InvalidInput(option, got=repr(pair), expected="NAME=NUMBER in SI units") from None
    return out


def nuisances_of(given: Sequence[str]) -> dict[str, float | None]:
    """NAME or NAME=STD, None where no deviation is given."""
    _each_once(given, "--nuisance")
    plain = dict.fromkeys(name for name in given if "=" not in name)
    return plain | assignments([pair for pair in given if "=" in pair], "--nuisance")


def _each_once(pairs: Sequence[str], option: str) -> None:
    """Of two values for one name either would be ignored."""
    names = [pair.partition("=")[0] for pair in pairs]
    for k, name in enumerate(names):
        if name in names[:k]:
            raise InvalidInput(option, got=f"{name!r} twice", expected="each name once")


def _priors(pairs: Sequence[str]) -> dict[str, tuple[float, float]]:
    _each_once(pairs, "--prior")
    out = {}
    for pair in pairs:
        name, _, numbers = pair.partition("=")
        try:
            value, spread = (float(number) for number in numbers.split(","))
        except ValueError:
            raise InvalidInput("--prior", got=repr(pair), expected="NAME=VALUE,SPREAD") from None
        out[name] = (value, spread)
    return out


def _fit(options: argparse.Namespace, cloth: Cloth, episodes: list[Recording]) -> Identification | FieldFit:
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    from ..identification import identify

    columns = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("{task.description}"))
    with Progress(*columns, refresh_per_second=2, disable=not sys.stdout.isatty()) as progress:
        task = progress.add_task("simulating with the start values", total=None)

        def advance(iteration: int, chamfer: float, values: dict[str, float], share: float) -> None:
            shown = ", ".join(f"{name} {value:.4g}" for name, value in list(values.items())[:3])
            used = "all frames" if share == 1 else f"first {100 * share:.0f} % of the frames"
            text = shown if math.isnan(chamfer) else f"Chamfer {1e3 * chamfer:.2f} mm, {shown}"
            text = f"{used}, {text}"
            progress.update(task, completed=iteration, description=text)
            if not progress.console.is_terminal:  # a log file shows a bar once, at the end
                say(f"iteration {iteration}: {text}")

        if options.fields:
            return fields.fit(options, cloth, episodes, options.out / PROGRESS, advance)
        return identify(
            cloth,
            episodes,
            options.fit,
            method=options.method,
            stop=options.stop,
            iterations=options.iterations,
            starts=options.starts,
            profile=options.profile,
            journal=options.out / PROGRESS,
            resume=options.resume or None,  # work is not thrown away unasked
            dt=options.dt,
            use=options.use,
            nuisances=nuisances_of(options.nuisance),
            priors=_priors(options.prior),
            on_progress=advance,
            refine=_refines(options),
        )


def _refines(options: argparse.Namespace) -> bool:
    """As asked for; else where a search ends at the optimum, which the correction moves, and nothing is profiled."""
    if options.refine is not None:
        return options.refine
    return options.method in ("gauss-newton", "lbfgs") and options.stop == "converged" and not options.profile


def _report(options: argparse.Namespace, fit: Identification, cloth: Cloth, recordings: list[Recording]) -> int:
    from .._utils.resume import clear
    from ..identification import episode
    from ..identification.io.saved_fit import RESULT
    from ..identification.pictures import draw
    from ..identification.tables import print_fit

    folder = options.out
    note = replaces(folder / RESULT)
    path = fit.save(folder, options.model)
    pictures = draw(fit, [episode(cloth, r) for r in recordings], cloth.mesh.faces, folder)
    clear(folder / PROGRESS)
    print_fit(fit)
    print(f"result:   {path}{note}")
    print("pictures: " + ", ".join(str(p) for p in pictures))
    return 0
