"""``torchcloth view``: an episode, and a fit beside it, in a browser or as a file."""

from __future__ import annotations

import argparse
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import InvalidInput
from .folders import check_apart, check_file, place, replaces

if TYPE_CHECKING:
    from ..viewing import Film

PICTURES, OTHERS = (".gif", ".png"), (".rrd", ".viser", ".html")
PORT = 8080


def add(verbs: Any) -> None:
    """The verb and its options."""
    view = verbs.add_parser("view", help="look at an episode, and at a fit beside it")
    view.add_argument("episode", metavar="EPISODE", help="folder of a recording")
    view.add_argument(
        "--fit", type=Path, metavar="RESULT", help="identification.json, its folder or a .tcm file: simulate it too"
    )
    view.add_argument(
        "--out",
        type=place,
        metavar="FILE",
        help=".gif, .png, .rrd (rerun), .html or .viser; left out: a server for the browser",
    )
    view.add_argument("--truth", action="store_true", help="show the true cloth of a synthetic episode too")
    view.add_argument("--port", type=int, metavar="N", help=f"of the server, on this machine only ({PORT})")
    view.add_argument("--fps", type=float, metavar="N", help="at most N frames a second (all; of a GIF 25)")
    view.add_argument("--size", metavar="WxH", help="pixels of a GIF, or of each of a PNG's moments")
    view.set_defaults(run=_view)


def _view(options: argparse.Namespace) -> int:
    size = _checked(options)
    film = _film(options)
    for note in film.notes:
        print(f"note: {note}", file=sys.stderr)
    if options.out is None:
        return _serve(film, options.port or PORT)
    note = replaces(options.out)
    _write(film, options.out, size, options.fps)
    print(f"{options.out}: {options.out.stat().st_size / 1e3:.0f} kB{note}")
    return 0


def _checked(options: argparse.Namespace) -> tuple[int, int] | None:
    """Refuse before anything is computed; the size of pictures."""
    out: Path | None = options.out
    suffix = None if out is None else out.suffix.lower()
    if out is not None and suffix not in PICTURES + OTHERS:
        raise InvalidInput("--out", got=repr(out.name), expected=f"a name with {', '.join(PICTURES + OTHERS)}")
    if out is not None:
        check_apart(out, options.episode)
        check_file(out)
    if options.port is not None and (out is not None or not 0 < options.port < 65536):
        raise InvalidInput("--port", got=options.port, expected="1 to 65535, without --out")
    if options.fps is not None and not 0 < options.fps < float("inf"):
        raise InvalidInput("--fps", got=options.fps, expected="a number > 0")
    if options.fps is not None and suffix == ".gif":
        from ..viewing.pictures import check_rate

        check_rate(options.fps)
    if options.size is None:
        return None
    found = re.fullmatch(r"(\d{2,4})x(\d{2,4})", options.size)
    if found is None or suffix not in PICTURES:
        raise InvalidInput(
            "--size",
            got=repr(options.size),
            expected="WIDTHxHEIGHT in pixels, of two to four digits, with a GIF or PNG",
        )
    from ..viewing.stage import check_size

    return check_size((int(found[1]), int(found[2])))


def _film(options: argparse.Namespace) -> Film:
    import torch

    from .. import recordings, viewing

    torch.set_default_dtype(torch.float64)  # as the fit was computed
    torch.set_num_threads(1)
    recording = recordings.read(options.episode, with_truth=options.truth)
    if options.fit is None:
        film = viewing.film_of(recording, truth=options.truth)
    else:
        film = viewing.film_of_fit(recording, options.fit, truth=options.truth)
    return film if options.fps is None else film.at_most(options.fps)


def _write(film: Film, out: Path, size: tuple[int, int] | None, fps: float | None) -> None:
    from rich.progress import Progress

    from .. import viewing

    suffix = out.suffix.lower()
    if suffix == ".gif":
        with Progress(transient=True, disable=not sys.stdout.isatty()) as progress:
            task = progress.add_task("drawing", total=None)
            viewing.animate(
                film,
                out,
                size=size,
                rate=fps or viewing.RATE,
                on_frame=lambda done, total: progress.update(task, completed=done, total=total),
            )
    elif suffix == ".png":
        viewing.picture(film, out, size=size)
    elif suffix == ".rrd":
        viewing.write_rrd(film, out)
    else:
        viewing.write_viser(film, out)


def _serve(film: Film, port: int) -> int:
    from .. import viewing

    viewer = viewing.Viewer(film, port)
    print(f"{film.title}: http://localhost:{viewer.port} (Ctrl-C ends)", flush=True)
    try:
        viewer.run()
    except KeyboardInterrupt:
        pass
    finally:
        viewer.stop()
    return 0
