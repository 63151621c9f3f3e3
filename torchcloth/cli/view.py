"""``torchcloth view``: show an episode, and a fit beside it, in a browser or as a file."""

from __future__ import annotations

import argparse
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import InvalidInput
from .output_paths import check_output_file, check_outside_episodes, output_path, replacement_note

if TYPE_CHECKING:
    from ..viewing import Film

IMAGE_SUFFIXES, VIEWER_SUFFIXES = (".gif", ".png"), (".rrd", ".viser", ".html")
DEFAULT_PORT = 8080


def add(verbs: Any) -> None:
    """Add the verb and its options."""
    view = verbs.add_parser("view", help="show an episode, and a fit beside it")
    view.add_argument("episode", metavar="EPISODE", help="folder of a recording")
    view.add_argument(
        "--fit",
        type=Path,
        metavar="RESULT",
        help="also simulate the cloth of identification.json, of its folder or of a .tcm file",
    )
    view.add_argument(
        "--out",
        type=output_path,
        metavar="FILE",
        help="a .gif, .png, .rrd (rerun), .html or .viser file (default: serve the scene to a browser)",
    )
    view.add_argument(
        "--before",
        action="store_true",
        help="with --fit and a .gif: also show the simulation with the start values, on the left",
    )
    view.add_argument("--truth", action="store_true", help="also show the true cloth of a synthetic episode")
    view.add_argument("--port", type=int, metavar="N", help=f"port of the local server (default: {DEFAULT_PORT})")
    view.add_argument("--fps", type=float, metavar="N", help="most frames per second (default: all; 25 in a GIF)")
    view.add_argument("--size", metavar="WxH", help="pixels of a GIF, or of each frame in a PNG")
    view.set_defaults(run=_view)


def _view(options: argparse.Namespace) -> int:
    size = _check_options(options)
    film = _film(options)
    for note in film.notes:
        print(f"note: {note}", file=sys.stderr)
    if options.out is None:
        return _serve(film, options.port or DEFAULT_PORT)
    note = replacement_note(options.out)
    _write(film, options.out, size, options.fps, _film(options, at_start=True) if options.before else None)
    print(f"{options.out}: {options.out.stat().st_size / 1e3:.0f} kB{note}")
    return 0


def _check_options(options: argparse.Namespace) -> tuple[int, int] | None:
    """Check the options before anything is computed; return the size of pictures in pixels."""
    out: Path | None = options.out
    suffix = None if out is None else out.suffix.lower()
    if out is not None and suffix not in IMAGE_SUFFIXES + VIEWER_SUFFIXES:
        raise InvalidInput(
            "--out", got=repr(out.name), expected=f"a name with {', '.join(IMAGE_SUFFIXES + VIEWER_SUFFIXES)}"
        )
    if out is not None:
        check_outside_episodes(out, options.episode)
        check_output_file(out)
    if options.port is not None and (out is not None or not 0 < options.port < 65536):
        raise InvalidInput("--port", got=options.port, expected="1 to 65535, without --out")
    if options.fps is not None and not 0 < options.fps < float("inf"):
        raise InvalidInput("--fps", got=options.fps, expected="a number > 0")
    if options.before and (options.fit is None or suffix != ".gif"):
        raise InvalidInput("--before", got="no --fit, or no .gif", expected="--fit RESULT and --out FILE.gif")
    if options.fps is not None and suffix == ".gif":
        from ..viewing.image_files import check_gif_rate

        check_gif_rate(options.fps)
    if options.size is None:
        return None
    match = re.fullmatch(r"(\d{2,4})x(\d{2,4})", options.size)
    if match is None or suffix not in IMAGE_SUFFIXES:
        raise InvalidInput(
            "--size",
            got=repr(options.size),
            expected="WIDTHxHEIGHT in pixels, of two to four digits, with a GIF or PNG",
        )
    from ..viewing.frame_renderer import check_image_size

    return check_image_size((int(match[1]), int(match[2])))


def _film(options: argparse.Namespace, at_start: bool = False) -> Film:
    import torch

    from .. import recordings, viewing

    torch.set_default_dtype(torch.float64)  # the precision of the fit
    torch.set_num_threads(1)
    recording = recordings.read(options.episode, with_truth=options.truth)
    if options.fit is None:
        film = viewing.film_from_recording(recording, truth=options.truth)
    else:
        film = viewing.film_from_fit(recording, options.fit, truth=options.truth, at_start=at_start)
    return film if options.fps is None else film.limit_rate(options.fps)


def _write(film: Film, out: Path, size: tuple[int, int] | None, fps: float | None, left: Film | None) -> None:
    from rich.progress import Progress

    from .. import viewing

    suffix = out.suffix.lower()
    if suffix == ".gif":
        with Progress(transient=True, disable=not sys.stdout.isatty()) as progress:
            task = progress.add_task("drawing", total=None)
            viewing.write_gif(
                film,
                out,
                size=size,
                rate=fps or viewing.DEFAULT_GIF_RATE_HZ,
                left=left,
                on_frame=lambda done, total: progress.update(task, completed=done, total=total),
            )
    elif suffix == ".png":
        viewing.write_png(film, out, size=size)
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
