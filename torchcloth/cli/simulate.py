"""``torchcloth simulate``: synthetic recordings of a robot that moves garments."""

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

from .._utils.files import atomically
from ..errors import InvalidInput, TorchclothError
from .folders import check_folder, place, say

if TYPE_CHECKING:
    from ..recordings import Recording
    from ..synthesis import Order

STOPPED = "; the same command goes on, finished episodes are kept"
OVERVIEW = "overview.png"
GIF_RATE = 10.0  # 1/s


def add(verbs: Any) -> None:
    """The verb and its options."""
    from ..synthesis.orders import CAMERAS, MOTIONS, Order

    parser = verbs.add_parser(
        "simulate",
        help="make synthetic recordings: two arms move a garment, a depth camera looks on",
        epilog="Every garment is moved in every way. Finished episodes in DIR are skipped. What a fit finds in them it "
        "finds under the model that made them (an inverse crime): they test a method, not the model.",
    )
    option = parser.add_argument
    option("--garment", nargs="+", required=True, metavar="NAME", help="shirt, trousers, dress, sheet")
    option("--motion", nargs="+", required=True, metavar="NAME", help=", ".join(MOTIONS))
    option("--out", type=place, required=True, metavar="DIR", help="folder for episodes, a GIF of each, an overview")
    option("--fabric", metavar="PRESET", help="a published fabric instead of the garment's own")
    option("--seed", type=int, default=Order.seed, metavar="N", help="of the sensor's errors and the cloth's place (0)")
    option("--triangles", type=int, default=Order.triangles, metavar="N", help="of the cloth, about (800)")
    option("--camera", choices=CAMERAS, default=Order.camera, help="default azure_kinect")
    option("--rate", type=float, default=Order.rate, metavar="HZ", help="frames per second (15)")
    option("--speed", type=float, default=Order.speed, metavar="M_S", help="of the grippers, at most [m/s] (1)")
    option("--grippers-only", action="store_true", help="no arms: grippers fly, as fast as asked (two Rizon 4)")
    option("--no-pictures", action="store_true", help="episodes only")
    parser.set_defaults(run=_simulate, stopped=STOPPED)


def _simulate(options: argparse.Namespace) -> int:
    import torch

    torch.set_default_dtype(torch.float64)
    torch.set_num_threads(1)  # meshes of a thousand triangles: a second thread costs more than it gives
    out: Path = options.out
    check_folder(out)
    orders = _orders(options)
    finished = {order.name: _finished(out / order.name, order) for order in orders}
    rows = []
    for order in orders:
        begun = time.process_time()
        if not finished[order.name]:
            _make(out, order)
        rows.append((order, None if finished[order.name] else time.process_time() - begun))
    if not options.no_pictures:
        _draw(out, orders)
    _print(out, rows)
    return 0


def _orders(options: argparse.Namespace) -> list[Order]:
    from ..synthesis import Order

    pairs = dict.fromkeys(product(options.garment, options.motion))
    return [
        Order(
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


def _finished(folder: Path, order: Order) -> bool:
    """Whether the episode is there; refuses one that was ordered otherwise."""
    try:
        found = json.loads((folder / "episode.json").read_text(encoding="utf-8")).get("order")
    except FileNotFoundError:
        if not folder.exists():
            return False
        found = None
    except (OSError, ValueError, AttributeError):
        found = None
    if found != order.facts():
        known, asked = found if isinstance(found, dict) else {}, order.facts()
        changed = [key for key, value in asked.items() if known.get(key) != value]
        raise InvalidInput(
            f"{folder}",
            got=f"an episode with {_told(known, changed)}" if known else "no episode of this command",
            expected=_told(asked, changed) if known else "none, or one",
            remedy="choose another --out, or remove it",
        )
    return True


def _told(facts: dict[str, Any], keys: list[str]) -> str:
    return ", ".join(f"{key} {facts.get(key)}" for key in keys)


def _make(out: Path, order: Order) -> None:
    from .. import recordings, synthesis

    with tempfile.TemporaryDirectory(prefix="torchcloth-") as images, _progress(order.name) as advance:
        try:
            recording = synthesis.make(order, Path(images), advance)
        except TorchclothError as error:
            error.args = (f"{order.name}: {error}",)
            raise
        advance("writing", 0, 1)
        if _finished(out / order.name, order):
            return  # by another command, meanwhile
        recordings.write(recording, out / order.name)
        (out / f"{order.name}.gif").unlink(missing_ok=True)  # of an episode that is gone


@contextmanager
def _progress(name: str) -> Iterator[Callable[[str, int, int], None]]:
    """A bar on a terminal; a line for each stage in a log."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    stages: list[str] = []
    with Progress(*columns, refresh_per_second=4, disable=not sys.stdout.isatty(), transient=True) as progress:
        task = progress.add_task(name, total=None)

        def advance(stage: str, done: int, of: int) -> None:
            progress.update(task, description=f"{name}: {stage}", completed=done, total=of)
            if not progress.console.is_terminal and stage not in stages:
                say(f"{name}: {stage}")
                stages.append(stage)

        yield advance


def _draw(out: Path, orders: list[Order]) -> None:
    """A GIF of each episode that has none, and one picture of all: a row of moments each."""
    from PIL import Image

    from .. import recordings, viewing

    with tempfile.TemporaryDirectory(prefix="torchcloth-") as folder:
        rows = []
        for order in orders:
            strip, gif = Path(folder) / f"{order.name}.png", out / f"{order.name}.gif"
            film = viewing.film_of(recordings.read(out / order.name, with_truth=True), truth=True)
            if not gif.exists():
                with _progress(order.name) as advance:
                    viewing.animate(film, gif, rate=GIF_RATE, on_frame=lambda i, n, a=advance: a("drawing", i, n))
            viewing.picture(film, strip, size=(320, 280))
            rows.append(Image.open(strip).convert("RGB"))
        sheet = Image.new("RGB", (max(r.width for r in rows), sum(r.height for r in rows)), "white")
        for i, row in enumerate(rows):
            sheet.paste(row, (0, sum(r.height for r in rows[:i])))
        with atomically(out / OVERVIEW) as part:
            sheet.save(part, optimize=True)


def _print(out: Path, rows: list[tuple[Order, float | None]]) -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    from .. import recordings

    table = Table("episode", "frames", "seconds", "slower", "limited by", "nearest", "CPU", title=escape(str(out)))
    for order, spent in rows:
        recording = recordings.read(out / order.name)
        table.add_row(order.name, *_facts(recording), "was there" if spent is None else f"{spent:.0f} s")
    Console().print(table)


def _facts(recording: Recording) -> tuple[str, ...]:
    motion = next(iter({**recording.grippers, **recording.joints}.values()))
    frames, seconds = str(len(recording.require("depth")["cam0"])), f"{motion.t[-1]:.2f}"
    plan = recording.extra.get("plan")
    if plan is None:
        return frames, seconds, "-", "-", "-"
    return frames, seconds, f"{plan['slower']:.2f} x", plan["limiting"], f"{1e3 * plan['nearest']['distance']:.0f} mm"
