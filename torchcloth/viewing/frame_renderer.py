"""A film's frames as pixels, drawn by matplotlib: what stands still is drawn once, the rest over it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ..errors import InvalidInput
from .colours import colour_map
from .film import CELL, DISTANCE, Film, Plane, ground_of
from .geometry import Array
from .projection import ahead, camera_for, polygons

INK, FAINT, GRID, SHADE, PAPER = "#22262b", "#6d747c", "#dfe2e6", 0.86, "#ffffff"
DPI = 100
STRIP, BAR = 0.14, 0.13  # of the height, of the width, for the curve and the colour bar
SMALLEST, LARGEST = 120, 4096  # pixels each way
LABELS, CURVE = 24, 16  # pixels that the curve's labels take, and that it needs at least itself


class Stage:
    """Draws single frames of a film.

    Args:
        film: what to show.
        size: (width, height) pixels.
        look: (azimuth, elevation) degrees of the eye; None: chosen by the film.

    Raises:
        InvalidInput: a size that is too small or too large.
    """

    def __init__(self, film: Film, size: tuple[int, int], look: tuple[float, float] | None = None) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        self.film, (width, height) = film, check_size(size)
        self.figure = Figure(figsize=(width / DPI, height / DPI), dpi=DPI, facecolor=PAPER)
        self.canvas: Any = FigureCanvasAgg(self.figure)
        strip = max(STRIP, (LABELS + CURVE) / height) if DISTANCE in film.curves else 0.0
        bar = BAR if film.measured else 0.0
        self.axes = self.figure.add_axes((0, strip, 1 - bar, 1 - strip))
        inner = (round(width * (1 - bar)), round(height * (1 - strip)))
        self.camera = camera_for(film, inner, look)
        self.axes.set(xlim=(-0.5, inner[0] - 0.5), ylim=(inner[1] - 0.5, -0.5))
        self.axes.axis("off")
        self.ground = ground_of(film)
        self._scenery()
        self.moving = [self._shadow(), self._bodies(), self._clock()]
        if film.measured:
            self._colour_bar(strip)
        if strip:
            self.moving.append(self._strip(strip))
        self.canvas.draw()
        self.background = self.canvas.copy_from_bbox(self.figure.bbox)

    def pixels(self, frame: int, titled: bool = True) -> Array:
        """The frame's picture, sRGB uint8 [H, W, 3]."""
        self.canvas.restore_region(self.background)
        for draw in self.moving:
            draw(frame)
        if titled:
            self.axes.draw_artist(self.title)
        return np.asarray(self.canvas.buffer_rgba())[..., :3].copy()

    @property
    def scene(self) -> int:
        """Columns of ``pixels`` that show the scene; what follows is the colour bar."""
        return round(self.figure.get_size_inches()[0] * DPI * (1 - (BAR if self.film.measured else 0.0)))

    def _project(self, points: Array) -> Array:
        return self.camera.project(points)[0]

    def _scenery(self) -> None:
        """Planes with a grid, grippers' paths."""
        from matplotlib.collections import LineCollection
        from matplotlib.patches import Polygon

        for plane in self.ground:
            if not _from_above(plane, self.camera.T_world_camera[:3, 3]):
                continue
            colour = np.array(plane.colour) / 255
            corners = ahead(plane.corners, self.camera)
            if len(corners) < 3:
                continue
            self.axes.add_patch(Polygon(self._project(corners), facecolor=colour, edgecolor="none"))
            seen = (ahead(line, self.camera, closed=False) for line in _grid(plane))
            lines = [self._project(line) for line in seen if len(line) == 2]
            self.axes.add_collection(LineCollection(lines, colors=[0.9 * colour], linewidths=0.6))
        for trace in self.film.traces.values():
            self.axes.plot(*self._project(trace.points).T, color=np.array(trace.colour) / 255, linewidth=1, alpha=0.6)

    def _shadow(self) -> Callable[[int], None]:
        """What the cloths hide of a plane from straight above it: says how high they are."""
        from matplotlib.collections import PolyCollection

        shade: Any = PolyCollection([], edgecolors="face", linewidths=0.5)
        shade.set_animated(True)
        self.axes.add_collection(shade, autolim=False)
        planes = [p for p in self.ground if _from_above(p, self.camera.T_world_camera[:3, 3])]

        def draw(frame: int) -> None:
            for plane in planes:
                for sheet in self.film.sheets.values():
                    x = sheet.vertices[frame].astype(float)
                    normal = _normal(plane)
                    below = x - ((x - plane.corners[0]) @ normal)[:, None] * normal
                    shade.set_verts(self._project(below)[sheet.faces])
                    shade.set_facecolor([tuple(SHADE * np.array(plane.colour) / 255)])
                    self.axes.draw_artist(shade)

        return draw

    def _bodies(self) -> Callable[[int], None]:
        from matplotlib.collections import PolyCollection

        bodies: Any = PolyCollection([], edgecolors="face", linewidths=0.7)
        bodies.set_animated(True)
        self.axes.add_collection(bodies, autolim=False)

        def draw(frame: int) -> None:
            shown = polygons(self.film, frame, self.camera)
            bodies.set_verts(shown.corners)
            bodies.set_facecolor(shown.colours)
            self.axes.draw_artist(bodies)

        return draw

    def _clock(self) -> Callable[[int], None]:
        """Title and time, legible over whatever is behind them."""
        from matplotlib.patheffects import withStroke

        common: dict[str, Any] = {
            "transform": self.axes.transAxes,
            "va": "top",
            "color": INK,
            "animated": True,
            "path_effects": [withStroke(linewidth=3, foreground=PAPER)],
        }
        self.title = self.axes.text(0.02, 0.975, self.film.title, fontsize=9, parse_math=False, **common)
        clock = self.axes.text(0.98, 0.975, "", ha="right", fontsize=10, **common)

        def draw(frame: int) -> None:
            clock.set_text(f"{self.film.times[frame]:.2f} s")
            self.axes.draw_artist(clock)

        return draw

    def _colour_bar(self, strip: float) -> None:
        from matplotlib.cm import ScalarMappable
        from matplotlib.colors import Normalize

        place = self.figure.add_axes((1 - BAR + 0.025, strip + 0.1, 0.022, 0.78 - strip))
        scale = ScalarMappable(Normalize(0, self.film.worst), colour_map())
        bar = self.figure.colorbar(scale, cax=place, extend="max")
        bar.ax.tick_params(labelsize=8, colors=INK)
        bar.outline.set_visible(False)
        bar.ax.set_title(self.film.unit, fontsize=8, color=INK)
        place.set_ylabel(self.film.legend, fontsize=8, color=FAINT)

    def _strip(self, strip: float) -> Callable[[int], None]:
        """A curve over the film's time, with a mark that runs along it."""
        curve = self.film.curves[DISTANCE]
        width, height = self.figure.get_size_inches() * DPI
        left, low = 52 / width, LABELS / height
        place = self.figure.add_axes((left, low, 0.97 - left - (BAR if self.film.measured else 0), strip - low))
        known = np.isfinite(curve.values)
        place.plot(curve.t[known], curve.values[known], color=INK, linewidth=1)
        first, last = self.film.times[[0, -1]]
        place.set(xlim=(first, last if last > first else first + 1.0), ylim=(0, 1.15 * float(np.nanmax(curve.values))))
        place.tick_params(labelsize=7, colors=FAINT, length=2)
        place.locator_params(axis="y", nbins=2)
        place.spines[["top", "right"]].set_visible(False)
        place.set_ylabel(f"mean\n{curve.unit}", fontsize=7, color=FAINT)
        (mark,) = place.plot([], [], "o", color="#bd0026", markersize=4, animated=True, clip_on=False)

        def draw(frame: int) -> None:
            now = self.film.times[frame]
            mark.set_data([now], [np.interp(now, curve.t[known], curve.values[known])])
            place.draw_artist(mark)

        return draw


def check_size(size: tuple[int, int]) -> tuple[int, int]:
    """The size in pixels, if pictures can have it.

    Raises:
        InvalidInput: too small for what is written on them, or larger than any screen.
    """
    if not SMALLEST <= min(size) <= max(size) <= LARGEST:
        raise InvalidInput(
            "size", got=f"{size[0]}x{size[1]}", expected=f"at least {SMALLEST} and at most {LARGEST} pixels each way"
        )
    return size


def _grid(plane: Plane) -> list[Array]:
    """Lines [2, 3] m, one every ``CELL``, through the middle of the plane."""
    a, b, c, d = plane.corners
    count = int(np.linalg.norm(b - a) / 2 / CELL)
    share = 0.5 + np.arange(-count, count + 1)[:, None] * CELL / np.linalg.norm(b - a)
    across = zip(a + share * (b - a), d + share * (c - d), strict=True)
    along = zip(a + share * (d - a), b + share * (c - b), strict=True)
    return [np.stack(line) for line in (*across, *along)]


def _normal(plane: Plane) -> Array:
    a, b, c, _ = plane.corners
    normal = np.cross(b - a, c - a)
    return normal / np.linalg.norm(normal)


def _from_above(plane: Plane, eye: Array) -> bool:
    return float((eye - plane.corners[0]) @ _normal(plane)) > 0
