"""Write a film as a GIF in real time, or as a PNG of some frames. Needs matplotlib and Pillow only."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from .._utils.files import write_atomically
from ..errors import InvalidInput
from .film import Film
from .frame_renderer import FrameRenderer
from .geometry import Array

DEFAULT_GIF_RATE_HZ = 25.0
MAX_GIF_RATE_HZ = 50.0  # browsers slow down a faster GIF
GIF_COLOURS = 96
MAX_GIF_FRAME_CS = 65535  # hundredths of a second, the largest 16-bit number
GIF_SIZE_PX, PNG_PANEL_SIZE_PX = (560, 420), (480, 420)
PNG_PANELS = 4


def write_gif(
    film: Film,
    path: str | Path,
    *,
    size: tuple[int, int] | None = None,
    rate: float = DEFAULT_GIF_RATE_HZ,
    eye_direction_deg: tuple[float, float] | None = None,
    on_frame: Callable[[int, int], None] | None = None,
    left: Film | None = None,
) -> Path:
    """Write a film as a GIF that plays in real time.

    Args:
        film: what to show, e.g. ``film_from_recording(recording)``.
        path: the file; it is written atomically.
        size: (width, height) pixels; None: 560 x 420.
        rate: most frames per second, up to 50.
        eye_direction_deg: (azimuth, elevation) of the eye [degrees]; None: chosen from the film.
        on_frame: called with (frames done, all frames).
        left: another film of the same frames, shown on the left from the same eye with the same colours, for example
            the simulation before a fit.

    Returns:
        ``path``.

    Raises:
        InvalidInput: a rate that no GIF can have, a size that is too small or too large, or films of other times.
    """
    from PIL import Image

    check_gif_rate(rate)
    if left is not None and not np.array_equal(left.times, film.times):
        raise InvalidInput("left", got=f"{len(left)} frames at other times", expected="the times of the film")
    film, left = film.limit_rate(rate), None if left is None else left.limit_rate(rate)
    right = FrameRenderer(film, size or GIF_SIZE_PX, eye_direction_deg)
    renderers = [right]
    if left is not None:
        left = replace(left, colour_limit=film.colour_limit)
        renderers.insert(0, FrameRenderer(left, size or GIF_SIZE_PX, eye_direction_deg, right.camera))
    palette = _palette(renderers)
    images = []
    for frame in range(len(film)):
        pixels = Image.fromarray(np.concatenate([renderer.pixels(frame) for renderer in renderers], axis=1))
        images.append(pixels.quantize(palette=palette, dither=Image.Dither.NONE))
        if on_frame is not None:
            on_frame(frame + 1, len(film))
    steps = _durations(film.times)
    with write_atomically(Path(path)) as file:
        images[0].save(
            file, format="GIF", save_all=True, append_images=images[1:], duration=steps, loop=0, optimize=True
        )
    return Path(path)


def check_gif_rate(rate: float) -> None:
    """Check that a GIF can have this rate [1/s].

    Raises:
        InvalidInput: the rate is not above 0 or exceeds 50 frames per second.
    """
    if not 0 < rate <= MAX_GIF_RATE_HZ:
        raise InvalidInput("rate", got=rate, expected=f"up to {MAX_GIF_RATE_HZ:g} frames a second, what a GIF can hold")


def write_png(
    film: Film,
    path: str | Path,
    *,
    size: tuple[int, int] | None = None,
    eye_direction_deg: tuple[float, float] | None = None,
) -> Path:
    """Write a PNG with four frames of the film, from the first to the last, side by side.

    The title is above the first frame, the colour bar beside the last.

    Args:
        film: what to show.
        path: the file; it is written atomically.
        size: (width, height) pixels of one frame with its colour bar; None: 480 x 420.
        eye_direction_deg: see ``write_gif``.

    Returns:
        ``path``.
    """
    from PIL import Image

    shown = np.unique(np.linspace(0, len(film) - 1, PNG_PANELS).round().astype(int))
    renderer = FrameRenderer(film, size or PNG_PANEL_SIZE_PX, eye_direction_deg)
    panels = [renderer.pixels(int(frame), titled=frame == shown[0]) for frame in shown]
    row = np.concatenate([*(panel[:, : renderer.scene_width] for panel in panels[:-1]), panels[-1]], axis=1)
    with write_atomically(Path(path)) as file:
        Image.fromarray(row).save(file, format="PNG", optimize=True)
    return Path(path)


def _palette(renderers: Sequence[FrameRenderer]) -> Any:
    """Return one palette for all frames, from three of them; parts that do not move then take no space."""
    from PIL import Image

    shown = np.unique(np.linspace(0, len(renderers[0].film) - 1, 3).round().astype(int))
    samples = np.concatenate([renderer.pixels(int(frame)) for renderer in renderers for frame in shown])
    return Image.fromarray(samples).quantize(GIF_COLOURS, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)


def _durations(times: Array) -> list[int]:
    """Return the duration of each frame [ms], rounded to the hundredths of a second of a GIF without accumulating."""
    if len(times) == 1:
        return [1000]
    ends = np.append(times[1:], 2 * times[-1] - times[-2]) - times[0]
    shown = [0]
    for end in np.round(100 * ends).astype(int).tolist():
        shown.append(max(end, shown[-1] + 2))  # the next frames make up for a frame that is too long
    if (longest := int(np.diff(shown).max())) > MAX_GIF_FRAME_CS:
        expected = f"at most {MAX_GIF_FRAME_CS / 100:.0f} s, which a GIF can say"
        raise InvalidInput(
            "frames", got=f"{longest / 100:.0f} s between two", expected=expected, remedy=".png or .html"
        )
    return (10 * np.diff(shown)).tolist()
