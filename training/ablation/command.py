"""The paper's ablation and energy-contribution experiments: ``python -m torchcloth.training.ablation --out DIR``.

Three garments are flung, dragged and covered in simulation, with each parameter at 25 to 175 % of its reference. The
tables compare two quantities with the paper: the distance between final shapes, and the fraction of the elastic energy
that each parameter carries.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from torchcloth.errors import InvalidInput

from ..resumable import run_study_command
from .runs import AblationStudy, Batch, SceneName, plan_batches, simulate_batches
from .scenes import ACTIONS, ASSUMPTIONS, GARMENTS, LEVELS, Scene, Setup, Variant, list_variants

FAST_PRESET = {"triangles": 150, "pace": 3.0, "levels": [25, 175]}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit code (0 done, 2 wrong input, 130 interrupted)."""
    options = _parser().parse_args(arguments)
    return run_study_command("ablation", "finished runs", lambda: _run(options))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m torchcloth.training.ablation",
        description=(__doc__ or "").partition("\n\n")[2],
        epilog="The full study has 243 runs of 1500 triangles and takes hours on one core. Finished runs stay in DIR "
        "and are not repeated. The same command resumes a stopped study. You may add garments, actions and levels.",
    )
    add = parser.add_argument
    add("--out", type=Path, required=True, metavar="DIR", help="folder for the runs, the result and the pictures")
    add("--fast", action="store_true", help="150 triangles, three times the pace, levels 25 and 175; takes minutes")
    add(
        "--garments", nargs="+", choices=list(GARMENTS), default=list(GARMENTS), metavar="NAME", help=_choices(GARMENTS)
    )
    add("--actions", nargs="+", choices=ACTIONS, default=list(ACTIONS), metavar="NAME", help=_choices(ACTIONS))
    add("--levels", nargs="+", type=int, choices=LEVELS, metavar="PERCENT", help=_choices(LEVELS))
    add(
        "--triangles",
        type=int,
        metavar="N",
        help="approximate number for each garment (default: 1500, as in the paper)",
    )
    add(
        "--scale",
        type=float,
        default=0.5,
        metavar="X",
        help="scale of lengths, not of time (default: 0.5, as the paper)",
    )
    add(
        "--spacing",
        type=float,
        metavar="M",
        help="spacing of the contact grid [m] (default: the widest for one contact point per triangle)",
    )
    add(
        "--pace",
        type=float,
        metavar="X",
        help="pace of the grippers (default: 1, which is at most 1 m/s and 5 m/s^2 at full scale)",
    )
    add(
        "--everywhere",
        action="store_true",
        help="apply contact to all triangles at all times, as in MPM; this is slower, and k stiffens single sheets",
    )
    add("--jobs", type=int, default=1, metavar="N", help="number of processes (default: 1)")
    add(
        "--batch", type=int, metavar="N", help="runs that a process simulates together (default: 6000 triangles in all)"
    )
    add("--report", action="store_true", help="only report on finished runs")
    return parser


def _choices(names: Sequence | dict) -> str:
    return f"one or more of {', '.join(map(str, names))} (default: all)"


def _run(options: argparse.Namespace) -> None:
    from .report import report  # late: matplotlib and scipy are not needed to parse options

    for name in ("jobs", "batch"):
        if getattr(options, name) is not None and getattr(options, name) < 1:
            raise InvalidInput(f"--{name}", got=getattr(options, name), expected="1 or more")
    preset = FAST_PRESET if options.fast else {"triangles": 1500, "pace": 1.0, "levels": list(LEVELS)}
    chosen = {key: getattr(options, key) if getattr(options, key) is not None else preset[key] for key in preset}
    setup = Setup(chosen["triangles"], options.scale, options.spacing, chosen["pace"], options.everywhere)
    study = AblationStudy(options.out, setup)
    scenes = [(garment, action) for action in options.actions for garment in options.garments]
    variants = list_variants(tuple(sorted(set(chosen["levels"]))))
    if not options.report:
        batches = plan_batches(study, scenes, variants, options.batch)
        _announce(study, scenes, variants, batches)
        if batches:
            _simulate(study, batches, options.jobs)
    report(study, scenes, variants)


def _announce(study: AblationStudy, scenes: list[SceneName], variants: list[Variant], batches: list[Batch]) -> None:
    """Print the plan; meshes that cannot be built are refused before anything is written."""
    built = {garment: Scene(study.setup, garment, action) for garment, action in scenes}
    for garment, scene in built.items():
        shape = f"{len(scene.mesh.faces)} triangles, contact grid {1e3 * scene.spacing:.1f} mm"
        print(f"{garment}: {shape}, substep {1e6 * scene.stable_step_of_all():.0f} us")
    missing = sum(len(batch.variants) for batch in batches)
    total = len(scenes) * len(variants)
    print(f"{len(scenes)} scenes at scale {study.setup.scale:g}, {total} runs, {total - missing} finished")
    print(f"assumed, not given in the paper: {ASSUMPTIONS}, {study.setup.areal_density:g} kg/m^2", flush=True)


def _simulate(study: AblationStudy, batches: list[Batch], jobs: int) -> None:
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    started, printed = time.monotonic(), 0
    columns = (BarColumn(), TextColumn("{task.percentage:.1f} %"), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(
        *columns, TextColumn("{task.description}"), refresh_per_second=2, disable=not sys.stdout.isatty()
    ) as bar:
        shown = bar.add_task("first runs", total=len(batches))

        def advance(done: float, batch: Batch) -> None:
            nonlocal printed
            text = f"{' '.join(batch.scene)} ({len(batch.variants)} runs)"
            bar.update(shown, completed=done, description=text)
            if (
                not bar.console.is_terminal and int(done) > printed
            ):  # in a log file the bar would appear only once, at the end
                printed = int(done)
                missing = (time.monotonic() - started) * (len(batches) / done - 1)
                print(f"{printed}/{len(batches)} batches, about {missing / 60:.1f} min left: {text}", flush=True)

        simulate_batches(study, batches, jobs, advance)
