"""The command line: ``torchcloth identify | demo | doctor | bench``. Wrong input: one line on stderr, exit code 2."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from importlib import metadata, resources
from pathlib import Path
from typing import TYPE_CHECKING

from .errors import InvalidInput, RecordingError, TorchclothError

if TYPE_CHECKING:
    from .cloth import Cloth
    from .identification import Identification
    from .recordings import Recording

DEMO = "bimanual_swing"


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code (0 done, 2 wrong input, 130 interrupted)."""
    parser = _parser()
    options = parser.parse_args(arguments)
    try:
        return options.run(options)
    except TorchclothError as error:
        print(f"torchcloth: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"torchcloth: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("torchcloth: stopped; `--resume` continues from the last iteration", file=sys.stderr)
        return 130


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="torchcloth", description="Differentiable cloth for robotics.")
    parser.add_argument("--version", action="version", version=metadata.version("torchcloth"))
    verbs = parser.add_subparsers(required=True, metavar="VERB")
    identify = verbs.add_parser("identify", help="fit fabric parameters to recorded episodes")
    identify.add_argument("episodes", nargs="+", metavar="EPISODE", help="folder of a recording")
    identify.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the result and pictures")
    identify.set_defaults(run=_identify)
    _add_fit_options(identify)
    demo = verbs.add_parser("demo", help="identify the shipped example")
    demo.add_argument("--out", type=Path, default=Path("out/demo"), metavar="DIR", help="default out/demo")
    demo.set_defaults(run=_demo)
    _add_fit_options(demo)
    doctor = verbs.add_parser("doctor", help="say what is installed and what works")
    doctor.set_defaults(run=_doctor)
    bench = verbs.add_parser("bench", help="measure speed and memory, also beside other simulators")
    bench.add_argument("--peers", action="store_true", help="beside Taichi, Warp, Newton, MuJoCo, where installed")
    bench.add_argument("--json", action="store_true", help="one JSON object on stdout instead of tables")
    bench.add_argument("--out", type=Path, metavar="DIR", help="folder for bench.json and a plot of cost by size")
    bench.add_argument("--fast", action="store_true", help="tiny scenes: whether it works, not how fast it is")
    bench.add_argument("--threads", type=int, metavar="N", help="of each contestant that can use them (all cores)")
    bench.set_defaults(run=_bench)
    return parser


def _add_fit_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--fit", nargs="+", metavar="NAME", help="parameters to fit (default: all of the model)")
    parser.add_argument(
        "--start", nargs="+", default=[], metavar="NAME=VALUE", help="start values, SI units, e.g. youngs_modulus=2e5"
    )
    parser.add_argument(
        "--method",
        choices=["gauss-newton", "adam"],
        default="gauss-newton",
        help="default gauss-newton; adam: the paper's descent",
    )
    parser.add_argument(
        "--stop", choices=["converged", "paper"], default="converged", help="paper: Chamfer below 1.5 cm"
    )
    parser.add_argument(
        "--iterations",
        type=int,
        default=35,
        metavar="N",
        help="at most N on all frames, after up to 10 on early ones (35)",
    )
    parser.add_argument("--contact", type=float, metavar="SPACING", help="contact grid [m]; left out: no contact")
    parser.add_argument("--dt", type=float, metavar="SECONDS", help="largest substep (default: the stable one)")
    parser.add_argument(
        "--engine", choices=["auto", "reference", "fused"], default="auto", help="default auto: fused where it can be"
    )
    parser.add_argument("--resume", action="store_true", help="continue from DIR/progress.json")


def _demo(options: argparse.Namespace) -> int:
    with resources.as_file(resources.files("torchcloth") / "examples" / DEMO) as folder:
        options.episodes = [str(folder)]
        return _identify(options)


def _identify(options: argparse.Namespace) -> int:
    import torch

    from . import recordings

    torch.set_default_dtype(torch.float64)  # sensitivities lose digits over thousands of substeps in float32
    torch.set_num_threads(1)  # meshes of a thousand triangles: a second thread costs more than it gives
    if options.out.exists() and not options.out.is_dir():
        raise InvalidInput("--out", got=f"{options.out}, a file", expected="a folder, new or existing")
    episodes = [recordings.read(path) for path in options.episodes]
    cloth = _cloth(options, episodes[0])
    guess = _resume(options.out) if options.resume else None
    size = f"{len(episodes)} episode(s), {len(cloth.mesh.faces)} triangles"
    print(f"{size}, stable substep {cloth.stable_step():.3g} s with the start values")
    fit = _fit(options, cloth, episodes, guess)
    return _report(options.out, fit, cloth, episodes)


def _cloth(options: argparse.Namespace, recording: Recording) -> Cloth:
    from .identification import cloth_from
    from .identification.unknowns import available
    from .transfer import Contact

    cloth = cloth_from(recording, contact=None if options.contact is None else Contact(options.contact))
    cloth.engine = options.engine
    names = available(cloth)
    for name, value in _assignments(options.start).items():
        if name not in names:
            raise InvalidInput("--start", got=repr(name), expected=f"one of {', '.join(sorted(names))}")
        cloth.get_submodule(names[name]).set(value)  # type: ignore[operator]
    return cloth


def _assignments(pairs: Sequence[str]) -> dict[str, float]:
    out = {}
    for pair in pairs:
        name, _, value = pair.partition("=")
        try:
            out[name] = float(value)
        except ValueError:
            raise InvalidInput("--start", got=repr(pair), expected="NAME=NUMBER in SI units") from None
    return out


def _fit(options: argparse.Namespace, cloth: Cloth, episodes: list[Recording], guess: dict | None) -> Identification:
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    from .identification import identify
    from .identification.result import write_atomically

    columns = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("{task.description}"))
    with Progress(*columns, refresh_per_second=2, disable=not sys.stdout.isatty()) as progress:
        task = progress.add_task("simulating with the start values", total=None)

        def advance(iteration: int, chamfer: float, values: dict[str, float]) -> None:
            options.out.mkdir(parents=True, exist_ok=True)  # not before the arguments were found good
            write_atomically(options.out / "progress.json", json.dumps(values) + "\n")
            shown = ", ".join(f"{name} {value:.4g}" for name, value in list(values.items())[:3])
            text = f"Chamfer {1e3 * chamfer:.2f} mm, {shown}"
            progress.update(task, completed=iteration, description=text)
            if not progress.console.is_terminal:  # a log file shows a bar once, at the end
                print(f"iteration {iteration}: {text}", flush=True)

        return identify(
            cloth,
            episodes,
            options.fit,
            method=options.method,
            stop=options.stop,
            iterations=options.iterations,
            guess=guess,
            warm_start=guess is not None,
            dt=options.dt,
            on_progress=advance,
        )


def _resume(folder: Path) -> dict[str, float]:
    path = folder / "progress.json"
    try:
        values = json.loads(path.read_text())
        return {str(name): float(value) for name, value in values.items()}
    except FileNotFoundError:
        raise InvalidInput("--resume", got=f"no {path}", expected="an interrupted fit in DIR") from None
    except (ValueError, TypeError, AttributeError):
        raise RecordingError(f"{path}: unreadable", remedy="delete it and start again without --resume") from None


def _report(folder: Path, fit: Identification, cloth: Cloth, recordings: list[Recording]) -> int:
    from .identification import episode
    from .identification.pictures import draw
    from .identification.tables import print_fit

    path = fit.save(folder)
    (folder / "progress.json").unlink(missing_ok=True)
    pictures = draw(fit, [episode(cloth, r) for r in recordings], cloth.mesh.faces, folder)
    print_fit(fit)
    print(f"result:   {path}")
    print("pictures: " + ", ".join(str(p) for p in pictures))
    return 0


def _bench(options: argparse.Namespace) -> int:
    from .benchmarks import command  # pyright: ignore[reportMissingImports] - mapped from benchmarks/ at installation

    return command.run(options)


def _doctor(options: argparse.Namespace) -> int:
    from importlib.util import find_spec

    import torch

    from .engine import library

    print(f"torchcloth {metadata.version('torchcloth')}, torch {torch.__version__}, CUDA {torch.cuda.is_available()}")
    print(f"{'engine':20s} {library.status()}")
    packages = {
        "pytorch_kinematics": "robots",
        "yourdfpy": "robots",
        "trimesh": "robots",
        "open3d": "observe",
        "lightning": "training",
    }
    for name, extra in packages.items():
        state = "installed" if find_spec(name) else f'missing: pip install "torchcloth[{extra}]"'
        print(f"{name:20s} {state}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
