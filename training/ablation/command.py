"""The paper's ablation and energy-contribution experiments: ``python -m torchcloth.training.ablation --out DIR``.

Three garments are flung, dragged and covered in simulation with each parameter at 25 to 175 % of its reference. Printed
beside the paper's tables: how far the final shapes differ, and how much of the elastic energy each parameter carries.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from torchcloth.errors import InvalidInput

from ..resumable import guarded
from .runs import Name, Study, Task, missing, simulate
from .scenes import ACTIONS, ASSUMED, GARMENTS, LEVELS, Scene, Setup, Variant, variants

FAST = {"triangles": 150, "pace": 3.0, "levels": [25, 175]}


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code (0 done, 2 wrong input, 130 interrupted)."""
    options = _parser().parse_args(arguments)
    return guarded("ablation", "finished runs", lambda: _run(options))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m torchcloth.training.ablation",
        description=(__doc__ or "").partition("\n\n")[2],
        epilog="The full study is 243 runs of 1500 triangles: hours on one core. Every finished run is kept in "
        "DIR and never repeated: stop it at will, run the same command to go on, add garments, actions or levels.",
    )
    add = parser.add_argument
    add("--out", type=Path, required=True, metavar="DIR", help="folder for the runs, the result and the pictures")
    add("--fast", action="store_true", help="150 triangles, three times the pace, levels 25 and 175: minutes")
    add("--garments", nargs="+", choices=list(GARMENTS), default=list(GARMENTS), metavar="NAME", help=_list(GARMENTS))
    add("--actions", nargs="+", choices=ACTIONS, default=list(ACTIONS), metavar="NAME", help=_list(ACTIONS))
    add("--levels", nargs="+", type=int, choices=LEVELS, metavar="PERCENT", help=_list(LEVELS))
    add("--triangles", type=int, metavar="N", help="of each garment, about (1500, the paper's)")
    add("--scale", type=float, default=0.5, metavar="X", help="of all lengths; the clock stays (0.5, the paper's)")
    add("--spacing", type=float, metavar="M", help="contact grid [m] (the widest for one contact point per triangle)")
    add("--pace", type=float, metavar="X", help="of the grippers; 1: 1 m/s and 5 m/s^2 at most, at full scale (1)")
    add("--everywhere", action="store_true", help="contact at all triangles always, as in MPM: slower, k stiffens all")
    add("--jobs", type=int, default=1, metavar="N", help="processes (1)")
    add("--batch", type=int, metavar="N", help="runs that one process simulates together (6000 triangles' worth)")
    add("--report", action="store_true", help="only report on the runs that are finished")
    return parser


def _list(names: Sequence | dict) -> str:
    return f"among {', '.join(map(str, names))} (all)"


def _run(options: argparse.Namespace) -> None:
    from .report import report

    for name in ("jobs", "batch"):
        if getattr(options, name) is not None and getattr(options, name) < 1:
            raise InvalidInput(f"--{name}", got=getattr(options, name), expected="1 or more")
    preset = FAST if options.fast else {"triangles": 1500, "pace": 1.0, "levels": list(LEVELS)}
    chosen = {key: getattr(options, key) if getattr(options, key) is not None else preset[key] for key in preset}
    setup = Setup(chosen["triangles"], options.scale, options.spacing, chosen["pace"], options.everywhere)
    study = Study(options.out, setup)
    study.check()
    scenes = [(garment, action) for action in options.actions for garment in options.garments]
    wanted = variants(tuple(sorted(set(chosen["levels"]))))
    if not options.report:
        tasks = missing(study, scenes, wanted, options.batch)
        _announce(study, scenes, wanted, tasks)
        if tasks:
            _simulate(study, tasks, options.jobs)
    report(study, scenes, wanted)


def _announce(study: Study, scenes: list[Name], wanted: list[Variant], tasks: list[Task]) -> None:
    """Refuses what no garment can be made of, before anything is written."""
    made = {garment: Scene(study.setup, garment, action) for garment, action in scenes}
    for garment, scene in made.items():
        shape = f"{len(scene.mesh.faces)} triangles, contact grid {1e3 * scene.spacing:.1f} mm"
        print(f"{garment}: {shape}, substep {1e6 * scene.step():.0f} us")
    left = sum(len(task.variants) for task in tasks)
    total = len(scenes) * len(wanted)
    print(f"{len(scenes)} scenes at scale {study.setup.scale:g}, {total} runs, {total - left} finished")
    print(f"assumed, as the paper gives none: {ASSUMED}, {study.setup.areal_density:g} kg/m^2", flush=True)


def _simulate(study: Study, tasks: list[Task], jobs: int) -> None:
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    begun, told = time.monotonic(), 0
    columns = (BarColumn(), TextColumn("{task.percentage:.1f} %"), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(
        *columns, TextColumn("{task.description}"), refresh_per_second=2, disable=not sys.stdout.isatty()
    ) as bar:
        shown = bar.add_task("first runs", total=len(tasks))

        def advance(done: float, task: Task) -> None:
            nonlocal told
            text = f"{' '.join(task.scene)} ({len(task.variants)} runs)"
            bar.update(shown, completed=done, description=text)
            if not bar.console.is_terminal and int(done) > told:  # a log file shows a bar once, at the end
                told = int(done)
                left = (time.monotonic() - begun) * (len(tasks) / done - 1)
                print(f"{told}/{len(tasks)} batches, about {left / 60:.1f} min left: {text}", flush=True)

        simulate(study, tasks, jobs, advance)
