"""``torchcloth simulate``: generate synthetic recordings of a robot that moves garments."""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .._utils.files import write_atomically
from ..errors import InvalidInput, TorchclothError
from .output_paths import check_output_folder, output_path, print_line

if TYPE_CHECKING:
    from ..recordings import Recording
    from ..synthesis import EpisodeSpec

STOPPED_HINT = "; the same command continues, finished episodes remain"
OVERVIEW_FILE = "overview.png"
GIF_RATE_HZ = 10.0


def add(verbs: Any) -> None:
    """Add the verb and its options."""
    from ..synthesis.episode_spec import CAMERAS, MOTIONS, EpisodeSpec

    parser = verbs.add_parser(
        "simulate",
        help="generate synthetic recordings: two arms move a garment in front of a depth camera",
        epilog="Each garment is combined with each motion. Finished episodes in DIR are skipped. A fit to these "
        "episodes uses the model that generated them (an inverse crime). They therefore test a method, not the model.",
    )
    option = parser.add_argument
    option("--garment", nargs="+", required=True, metavar="NAME", help="shirt, trousers, dress, sheet")
    option("--motion", nargs="+", required=True, metavar="NAME", help=", ".join(MOTIONS))
    option(
        "--out", type=output_path, required=True, metavar="DIR", help="folder for episodes, their GIFs and an overview"
    )
    option("--fabric", metavar="PRESET", help="a published fabric (default: that of the garment)")
    option(
        "--seed",
        type=int,
        default=EpisodeSpec.seed,
        metavar="N",
        help="seed of sensor errors and cloth placement (default: 0)",
    )
    option(
        "--triangles",
        type=int,
        default=EpisodeSpec.triangles,
        metavar="N",
        help="approximate number of triangles (default: 800)",
    )
    option("--camera", choices=CAMERAS, default=EpisodeSpec.camera, help="depth camera (default: azure_kinect)")
    option("--rate", type=float, default=EpisodeSpec.rate, metavar="HZ", help="frames per second (default: 15)")
    option(
        "--speed", type=float, default=EpisodeSpec.speed, metavar="M_S", help="largest gripper speed [m/s] (default: 1)"
    )
    option("--grippers-only", action="store_true", help="move free grippers instead of two Rizon 4 arms")
    option("--no-pictures", action="store_true", help="write episodes only")
    parser.set_defaults(run=_simulate, stopped=STOPPED_HINT)


def _simulate(options: argparse.Namespace) -> int:
    import torch

    torch.set_default_dtype(torch.float64)
    torch.set_num_threads(1)  # on meshes of a thousand triangles a second thread costs more than it gains
    out: Path = options.out
    check_output_folder(out)
    specs = _episode_specs(options)
    finished = {spec.name: _is_finished(out / spec.name, spec) for spec in specs}
    rows = []
    for spec in specs:
        started = time.process_time()
        if not finished[spec.name]:
            _make(out, spec)
        rows.append((spec, None if finished[spec.name] else time.process_time() - started))
    if not options.no_pictures:
        _draw(out, specs)
    _print(out, rows)
    return 0


def _episode_specs(options: argparse.Namespace) -> list[EpisodeSpec]:
    from ..synthesis import EpisodeSpec

    pairs = dict.fromkeys(product(options.garment, options.motion))
    return [
        EpisodeSpec(
            garment,
            motion,
            fabric=options.fabric,
            seed=options.seed,
            triangles=options.triangles,
            camera=options.camera,
            arms=not options.grippers_only,
            rate=options.rate,
            speed=options.speed,
        )
        for garment, motion in pairs
    ]


def _is_finished(folder: Path, spec: EpisodeSpec) -> bool:
    """Whether the episode exists; refuses an episode with another specification."""
    try:
        stored = json.loads((folder / "episode.json").read_text(encoding="utf-8")).get("order")
    except FileNotFoundError:
        if not folder.exists():
            return False
        stored = None
    except (OSError, ValueError, AttributeError):
        stored = None
    if stored != spec.as_dict():
        stored_spec, requested = stored if isinstance(stored, dict) else {}, spec.as_dict()
        changed = [key for key, value in requested.items() if stored_spec.get(key) != value]
        raise InvalidInput(
            f"{folder}",
            got=f"an episode with {_format_items(stored_spec, changed)}"
            if stored_spec
            else "no episode of this command",
            expected=_format_items(requested, changed) if stored_spec else "none, or one",
            remedy="choose another --out, or remove it",
        )
    return True


def _format_items(items: dict[str, Any], keys: list[str]) -> str:
    return ", ".join(f"{key} {items.get(key)}" for key in keys)


def _make(out: Path, spec: EpisodeSpec) -> None:
    from .. import recordings, synthesis

    with tempfile.TemporaryDirectory(prefix="torchcloth-") as images, _progress(spec.name) as advance:
        try:
            recording = synthesis.make_episode(spec, Path(images), advance)
        except TorchclothError as error:
            error.args = (f"{spec.name}: {error}",)
            raise
        advance("writing", 0, 1)
        if _is_finished(out / spec.name, spec):
            return  # another process has written it meanwhile
        recordings.write(recording, out / spec.name)
        (out / f"{spec.name}.gif").unlink(missing_ok=True)  # it may show an episode that was removed


@contextmanager
def _progress(name: str) -> Iterator[Callable[[str, int, int], None]]:
    """Show a progress bar on a terminal, or print one line for each stage in a log."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    stages: list[str] = []
    with Progress(*columns, refresh_per_second=4, disable=not sys.stdout.isatty(), transient=True) as progress:
        task = progress.add_task(name, total=None)

        def advance(stage: str, done: int, of: int) -> None:
            progress.update(task, description=f"{name}: {stage}", completed=done, total=of)
            if not progress.console.is_terminal and stage not in stages:
                print_line(f"{name}: {stage}")
                stages.append(stage)

        yield advance


def _draw(out: Path, specs: list[EpisodeSpec]) -> None:
    """Write a GIF of each episode that has none, and one overview with a row of frames for each episode."""
    from PIL import Image

    from .. import recordings, viewing

    with tempfile.TemporaryDirectory(prefix="torchcloth-") as folder:
        rows = []
        for spec in specs:
            strip, gif = Path(folder) / f"{spec.name}.png", out / f"{spec.name}.gif"
            film = viewing.film_from_recording(recordings.read(out / spec.name, with_truth=True), truth=True)
            if not gif.exists():
                with _progress(spec.name) as advance:
                    viewing.write_gif(film, gif, rate=GIF_RATE_HZ, on_frame=lambda i, n, a=advance: a("drawing", i, n))
            viewing.write_png(film, strip, size=(320, 280))
            rows.append(Image.open(strip).convert("RGB"))
        sheet = Image.new("RGB", (max(r.width for r in rows), sum(r.height for r in rows)), "white")
        for i, row in enumerate(rows):
            sheet.paste(row, (0, sum(r.height for r in rows[:i])))
        with write_atomically(out / OVERVIEW_FILE) as part:
            sheet.save(part, optimize=True)


def _print(out: Path, rows: list[tuple[EpisodeSpec, float | None]]) -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    from .. import recordings

    headings = ("episode", "frames", "duration, s", "slowed down", "limited by", "clearance", "CPU time")
    table = Table(*headings, title=escape(str(out)))
    for spec, cpu_seconds in rows:
        recording = recordings.read(out / spec.name)
        table.add_row(
            spec.name, *_summary_cells(recording), "existed" if cpu_seconds is None else f"{cpu_seconds:.0f} s"
        )
    Console().print(table)


def _summary_cells(recording: Recording) -> tuple[str, ...]:
    motion = next(iter({**recording.grippers, **recording.joints}.values()))
    frames, seconds = str(len(recording.require("depth")["cam0"])), f"{motion.t[-1]:.2f}"
    plan = recording.extra.get("plan")
    if plan is None:
        return frames, seconds, "-", "-", "-"
    return frames, seconds, f"{plan['slower']:.2f} x", plan["limiting"], f"{1e3 * plan['nearest']['distance']:.0f} mm"
