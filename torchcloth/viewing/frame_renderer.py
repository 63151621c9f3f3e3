"""Render a film's frames with matplotlib; parts that do not move are drawn once."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ..errors import InvalidInput
from ..observe import DepthCamera
from .colours import get_colour_map
from .film import DISTANCE_CURVE, GRID_CELL_M, Film, GroundPlane, ground_planes
from .geometry import Array
from .projection import clip_to_camera, fit_camera, project_polygons

TEXT_COLOUR, MUTED_TEXT_COLOUR, PAPER_COLOUR = "#22262b", "#6d747c", "#ffffff"
SHADOW_BRIGHTNESS = 0.86  # of the plane's colour
PIXELS_PER_INCH = 100
CURVE_HEIGHT_FRACTION = 0.14  # of the image's height
COLOUR_BAR_WIDTH_FRACTION = 0.13  # of the image's width
MIN_IMAGE_SIDE_PX, MAX_IMAGE_SIDE_PX = 120, 4096
CURVE_LABEL_HEIGHT_PX = 32  # below the curve
MIN_CURVE_HEIGHT_PX = 16


class FrameRenderer:
    """Renders single frames of a film.

    Args:
        film: what to show.
        size: (width, height) pixels.
        eye_direction_deg: (azimuth, elevation) of the eye [degrees]; None: chosen from the film.
        camera: a camera of this size that another renderer made; None: one that fits the film.

    Raises:
        InvalidInput: the size is too small or too large.
    """

    def __init__(
        self,
        film: Film,
        size: tuple[int, int],
        eye_direction_deg: tuple[float, float] | None = None,
        camera: DepthCamera | None = None,
    ) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        self.film, (width, height) = film, check_image_size(size)
        self.figure = Figure(
            figsize=(width / PIXELS_PER_INCH, height / PIXELS_PER_INCH), dpi=PIXELS_PER_INCH, facecolor=PAPER_COLOUR
        )
        self.canvas: Any = FigureCanvasAgg(self.figure)
        strip = (
            max(CURVE_HEIGHT_FRACTION, (CURVE_LABEL_HEIGHT_PX + MIN_CURVE_HEIGHT_PX) / height)
            if DISTANCE_CURVE in film.curves
            else 0.0
        )
        bar = COLOUR_BAR_WIDTH_FRACTION if film.has_values else 0.0
        self.axes = self.figure.add_axes((0, strip, 1 - bar, 1 - strip))
        inner = (round(width * (1 - bar)), round(height * (1 - strip)))
        self.camera = camera or fit_camera(film, inner, eye_direction_deg)
        self.axes.set(xlim=(-0.5, inner[0] - 0.5), ylim=(inner[1] - 0.5, -0.5))
        self.axes.axis("off")
        self.ground = ground_planes(film)
        self._scenery()
        self.moving = [self._shadow(), self._bodies(), self._clock()]
        if film.has_values:
            self._colour_bar(strip)
        if strip:
            self.moving.append(self._strip(strip))
        self.canvas.draw()
        self.background = self.canvas.copy_from_bbox(self.figure.bbox)

    def pixels(self, frame: int, titled: bool = True) -> Array:
        """Render a frame to sRGB pixels, uint8 [H, W, 3]."""
        self.canvas.restore_region(self.background)
        for draw in self.moving:
            draw(frame)
        if titled:
            self.axes.draw_artist(self.title)
        return np.asarray(self.canvas.buffer_rgba())[..., :3].copy()

    @property
    def scene_width(self) -> int:
        """Number of columns of ``pixels`` that show the scene; the colour bar follows them."""
        return round(
            self.figure.get_size_inches()[0]
            * PIXELS_PER_INCH
            * (1 - (COLOUR_BAR_WIDTH_FRACTION if self.film.has_values else 0.0))
        )

    def _project(self, points: Array) -> Array:
        return self.camera.project(points)[0]

    def _scenery(self) -> None:
        """Draw planes with a grid, and gripper paths."""
        from matplotlib.collections import LineCollection
        from matplotlib.patches import Polygon

        for plane in self.ground:
            if not _faces_eye(plane, self.camera.T_world_camera[:3, 3]):
                continue
            colour = np.array(plane.colour) / 255
            corners = clip_to_camera(plane.corners, self.camera)
            if len(corners) < 3:
                continue
            self.axes.add_patch(Polygon(self._project(corners), facecolor=colour, edgecolor="none"))
            seen = (clip_to_camera(line, self.camera, closed=False) for line in _grid(plane))
            lines = [self._project(line) for line in seen if len(line) == 2]
            self.axes.add_collection(LineCollection(lines, colors=[0.9 * colour], linewidths=0.6))
        for trace in self.film.traces.values():
            self.axes.plot(*self._project(trace.points).T, color=np.array(trace.colour) / 255, linewidth=1, alpha=0.6)

    def _shadow(self) -> Callable[[int], None]:
        """Draw the cloths' vertical projections on the planes, which show their height."""
        from matplotlib.collections import PolyCollection

        shade: Any = PolyCollection([], edgecolors="face", linewidths=0.5)
        shade.set_animated(True)
        self.axes.add_collection(shade, autolim=False)
        planes = [p for p in self.ground if _faces_eye(p, self.camera.T_world_camera[:3, 3])]

        def draw(frame: int) -> None:
            for plane in planes:
                for sheet in self.film.sheets.values():
                    x = sheet.vertices[frame].astype(float)
                    normal = _normal(plane)
                    below = x - ((x - plane.corners[0]) @ normal)[:, None] * normal
                    shade.set_verts(self._project(below)[sheet.faces])
                    shade.set_facecolor([tuple(SHADOW_BRIGHTNESS * np.array(plane.colour) / 255)])
                    self.axes.draw_artist(shade)

        return draw

    def _bodies(self) -> Callable[[int], None]:
        from matplotlib.collections import PolyCollection

        bodies: Any = PolyCollection([], edgecolors="face", linewidths=0.7)
        bodies.set_animated(True)
        self.axes.add_collection(bodies, autolim=False)

        def draw(frame: int) -> None:
            shown = project_polygons(self.film, frame, self.camera)
            bodies.set_verts(shown.corners)
            bodies.set_facecolor(shown.colours)
            self.axes.draw_artist(bodies)

        return draw

    def _clock(self) -> Callable[[int], None]:
        """Draw title and time with a white outline, legible over any background."""
        from matplotlib.patheffects import withStroke

        common: dict[str, Any] = {
            "transform": self.axes.transAxes,
            "va": "top",
            "color": TEXT_COLOUR,
            "animated": True,
            "path_effects": [withStroke(linewidth=3, foreground=PAPER_COLOUR)],
        }
        self.title = self.axes.text(0.02, 0.975, self.film.title, fontsize=9, parse_math=False, **common)
        clock = self.axes.text(0.02, 0.02, "", fontsize=9, **{**common, "va": "bottom"})

        def draw(frame: int) -> None:
            clock.set_text(f"{self.film.seconds(frame):.2f} s from the first frame")
            self.axes.draw_artist(clock)

        return draw

    def _colour_bar(self, strip: float) -> None:
        from matplotlib.cm import ScalarMappable
        from matplotlib.colors import Normalize

        place = self.figure.add_axes((1 - COLOUR_BAR_WIDTH_FRACTION + 0.025, strip + 0.1, 0.022, 0.78 - strip))
        scale = ScalarMappable(Normalize(0, self.film.colour_limit), get_colour_map())
        bar = self.figure.colorbar(scale, cax=place, extend="max")
        bar.ax.tick_params(labelsize=8, colors=TEXT_COLOUR)
        bar.outline.set_visible(False)
        bar.ax.set_title(self.film.unit, fontsize=8, color=TEXT_COLOUR)
        place.set_ylabel(self.film.legend, fontsize=8, color=MUTED_TEXT_COLOUR)

    def _strip(self, strip: float) -> Callable[[int], None]:
        """Draw a curve over time, with a mark at the present frame."""
        curve = self.film.curves[DISTANCE_CURVE]
        width, height = self.figure.get_size_inches() * PIXELS_PER_INCH
        left, low = 52 / width, CURVE_LABEL_HEIGHT_PX / height
        place = self.figure.add_axes(
            (left, low, 0.97 - left - (COLOUR_BAR_WIDTH_FRACTION if self.film.has_values else 0), strip - low)
        )
        known = np.isfinite(curve.values)
        t, values = curve.t[known] - self.film.times[0], curve.values[known]
        place.plot(t, values, color=TEXT_COLOUR, linewidth=1)
        place.set(xlim=(0.0, self.film.seconds(-1) or 1.0), ylim=(0, 1.15 * float(np.nanmax(curve.values))))
        place.set_xlabel("seconds from the first frame", fontsize=7, color=MUTED_TEXT_COLOUR, labelpad=1)
        place.tick_params(labelsize=7, colors=MUTED_TEXT_COLOUR, length=2)
        place.locator_params(axis="y", nbins=2)
        place.spines[["top", "right"]].set_visible(False)
        place.set_ylabel(f"mean\n{curve.unit}", fontsize=7, color=MUTED_TEXT_COLOUR)
        (mark,) = place.plot([], [], "o", color="#bd0026", markersize=4, animated=True, clip_on=False)

        def draw(frame: int) -> None:
            now = self.film.seconds(frame)
            mark.set_data([now], [np.interp(now, t, values)])
            place.draw_artist(mark)

        return draw


def check_image_size(size: tuple[int, int]) -> tuple[int, int]:
    """Check a picture's size [pixels] and return it.

    Raises:
        InvalidInput: the size is too small for the labels, or larger than any screen.
    """
    if not MIN_IMAGE_SIDE_PX <= min(size) <= max(size) <= MAX_IMAGE_SIDE_PX:
        raise InvalidInput(
            "size",
            got=f"{size[0]}x{size[1]}",
            expected=f"at least {MIN_IMAGE_SIDE_PX} and at most {MAX_IMAGE_SIDE_PX} pixels each way",
        )
    return size


def _grid(plane: GroundPlane) -> list[Array]:
    """Return grid lines [2, 3] m, one every ``GRID_CELL_M``, through the middle of the plane."""
    a, b, c, d = plane.corners
    count = int(np.linalg.norm(b - a) / 2 / GRID_CELL_M)
    share = 0.5 + np.arange(-count, count + 1)[:, None] * GRID_CELL_M / np.linalg.norm(b - a)
    across = zip(a + share * (b - a), d + share * (c - d), strict=True)
    along = zip(a + share * (d - a), b + share * (c - b), strict=True)
    return [np.stack(line) for line in (*across, *along)]


def _normal(plane: GroundPlane) -> Array:
    a, b, c, _ = plane.corners
    normal = np.cross(b - a, c - a)
    return normal / np.linalg.norm(normal)


def _faces_eye(plane: GroundPlane, eye: Array) -> bool:
    return float((eye - plane.corners[0]) @ _normal(plane)) > 0
