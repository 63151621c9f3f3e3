"""A film as a GIF that plays in real time, or as a PNG of some of its moments. Needs matplotlib and pillow only."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from .._utils.files import write_atomically
from ..errors import InvalidInput
from .film import Film
from .frame_renderer import Stage
from .geometry import Array

RATE, FASTEST = 25.0, 50.0  # 1/s; browsers slow a faster GIF down
COLOURS = 96  # of a GIF
LONGEST = 65535  # hundredths of a second, of a frame: what 16 bits hold
GIF, MOMENT = (560, 420), (480, 420)  # pixels
PANELS = 4  # moments on a PNG


def animate(
    film: Film,
    path: str | Path,
    *,
    size: tuple[int, int] | None = None,
    rate: float = RATE,
    look: tuple[float, float] | None = None,
    on_frame: Callable[[int, int], None] | None = None,
) -> Path:
    """Write a film as a GIF, in real time.

    Args:
        film: what to show, e.g. ``film_of(recording)``.
        path: the file; it only ever holds a whole GIF.
        size: (width, height) pixels; None: 560 x 420.
        rate: at most so many frames a second, up to 50.
        look: (azimuth, elevation) degrees of the eye; None: chosen by the film.
        on_frame: called with (frames done, frames in all).

    Returns:
        ``path``.

    Raises:
        InvalidInput: a rate that no GIF has, or a size too small or too large.
    """
    from PIL import Image

    check_rate(rate)
    film = film.at_most(rate)
    stage = Stage(film, size or GIF, look)
    palette = _palette(stage)
    images = []
    for frame in range(len(film)):
        pixels = Image.fromarray(stage.pixels(frame))
        images.append(pixels.quantize(palette=palette, dither=Image.Dither.NONE))
        if on_frame is not None:
            on_frame(frame + 1, len(film))
    steps = _durations(film.times)
    with write_atomically(Path(path)) as part:
        images[0].save(
            part, format="GIF", save_all=True, append_images=images[1:], duration=steps, loop=0, optimize=True
        )
    return Path(path)


def check_rate(rate: float) -> None:
    """Refuse a rate that no GIF has.

    Raises:
        InvalidInput: it is not above 0 and at most 50 frames a second.
    """
    if not 0 < rate <= FASTEST:
        raise InvalidInput("rate", got=rate, expected=f"up to {FASTEST:g} frames a second, what a GIF can hold")


def picture(
    film: Film, path: str | Path, *, size: tuple[int, int] | None = None, look: tuple[float, float] | None = None
) -> Path:
    """Write a PNG with four moments of the film, from the first frame to the last, side by side.

    The title is over the first, the colour bar beside the last.

    Args:
        film: what to show.
        path: the file; it only ever holds a whole PNG.
        size: (width, height) pixels of one moment with its colour bar; None: 480 x 420.
        look: as of ``animate``.

    Returns:
        ``path``.
    """
    from PIL import Image

    shown = np.unique(np.linspace(0, len(film) - 1, PANELS).round().astype(int))
    stage = Stage(film, size or MOMENT, look)
    moments = [stage.pixels(int(frame), titled=frame == shown[0]) for frame in shown]
    row = np.concatenate([*(moment[:, : stage.scene] for moment in moments[:-1]), moments[-1]], axis=1)
    with write_atomically(Path(path)) as part:
        Image.fromarray(row).save(part, format="PNG", optimize=True)
    return Path(path)


def _palette(stage: Stage) -> Any:
    """One palette for all frames, from three of them: the parts that do not move then cost nothing."""
    from PIL import Image

    shown = np.unique(np.linspace(0, len(stage.film) - 1, 3).round().astype(int))
    together = np.concatenate([stage.pixels(int(frame)) for frame in shown])
    return Image.fromarray(together).quantize(COLOURS, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)


def _durations(times: Array) -> list[int]:
    """Milliseconds of each frame, in the hundredths of a second that a GIF knows; their sum is right."""
    if len(times) == 1:
        return [1000]
    ends = np.append(times[1:], 2 * times[-1] - times[-2]) - times[0]
    shown = [0]
    for end in np.round(100 * ends).astype(int).tolist():
        shown.append(max(end, shown[-1] + 2))  # what one frame is too long, the next are shorter
    if (longest := int(np.diff(shown).max())) > LONGEST:
        expected = f"at most {LONGEST / 100:.0f} s, which a GIF can say"
        raise InvalidInput(
            "frames", got=f"{longest / 100:.0f} s between two", expected=expected, remedy=".png or .html"
        )
    return (10 * np.diff(shown)).tolist()
