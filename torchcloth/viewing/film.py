"""What can be looked at, whatever shows it: shapes by name over common times, in the world, SI units, z up.

Names with a slash form groups that are switched together: "arms/left/link1" belongs to "arms".
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sized
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from ..errors import InvalidInput
from ..recordings import Camera
from .geometry import Array, nearest

Colour = tuple[int, int, int]  # sRGB, 0 to 255
DISTANCE = "distance"  # name of the curve that belongs to the sheets' values; pictures draw it below

CLOTH, TRUTH, POINTS, MARKERS = (158, 184, 206), (126, 168, 110), (30, 34, 40), (200, 40, 120)
CELL = 0.1  # m, of the grid on a plane or floor
FLOOR = (255, 255, 255)
SMALLEST, ALONE = 0.01, 0.3  # m, what a film is about is at least so large; where no cloth and no points are to be seen
ARM, COLLIDER, PATH = (206, 210, 215), (206, 196, 180), (70, 110, 190)


@dataclass(frozen=True, eq=False)
class Sheet:
    """A cloth that moves."""

    vertices: Array  # [T, V, 3] m
    faces: Array  # [F, 3]
    values: Array | None = None  # [T, V] in the film's unit, NaN where unknown; None: plain colour
    colour: Colour = CLOTH
    net: bool = False  # show its hems or edges only, so that another sheet can be seen behind


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points, another set in every frame."""

    frames: tuple[Array, ...]  # T times [N, 3] m; N may be 0
    colour: Colour = POINTS


@dataclass(frozen=True, eq=False)
class Plane:
    """A square of a half-space's surface; all else lies on the side from which its corners run counterclockwise."""

    corners: Array  # [4, 3] m
    colour: Colour = COLLIDER

    FACES = np.array([[0, 1, 2], [0, 2, 3]])


@dataclass(frozen=True, eq=False)
class Solid:
    """A closed rigid body."""

    vertices: Array  # [V, 3] m, in its own frame
    faces: Array  # [F, 3], counterclockwise from outside
    poses: Array  # [T, 4, 4] of its frame in the world, or [1, 4, 4] when it stands still
    colour: Colour = ARM


@dataclass(frozen=True, eq=False)
class Trace:
    """The way of a gripper, and where it is in each frame."""

    points: Array  # [K, 3] m, the whole way
    poses: Array  # [T, 4, 4]
    colour: Colour = PATH


@dataclass(frozen=True, eq=False)
class View:
    """A recorded camera, and which of its depth images belongs to each frame (-1: none)."""

    camera: Camera
    index: Array  # [T] int64

    def raw(self, frame: int) -> Array | None:
        """The depth image uint16 [H, W] of a film's frame, 0 where invalid; None where there is none.

        Times ``camera.depth_scale`` it is in metres.
        """
        if self.camera.depth is None or self.index[frame] < 0:
            return None
        return self.camera.depth.load(int(self.index[frame]))


@dataclass(frozen=True, eq=False)
class Curve:
    """A number over time."""

    t: Array  # [K] s
    values: Array  # [K]
    unit: str


@dataclass(frozen=True, eq=False, kw_only=True)
class Film:
    """One scene over T frames; every part but title and times may be missing.

    Attributes:
        title: what it shows, in a few words.
        times: [T] s, on the motion clock, increasing.
        sheets, clouds, solids, planes, traces, views, curves: the parts, by name.
        unit, worst: of the sheets' values, and the value at the far end of the colour bar.
        legend: what the values are, for the colour bar.
        grey: of what there are none.
        notes: what could not be shown, and why.

    Raises:
        InvalidInput: a part whose frames are not those of ``times``, or a sheet that is not finite.
    """

    title: str
    times: Array
    sheets: Mapping[str, Sheet] = field(default_factory=dict)
    clouds: Mapping[str, Cloud] = field(default_factory=dict)
    solids: Mapping[str, Solid] = field(default_factory=dict)
    planes: Mapping[str, Plane] = field(default_factory=dict)
    traces: Mapping[str, Trace] = field(default_factory=dict)
    views: Mapping[str, View] = field(default_factory=dict)
    curves: Mapping[str, Curve] = field(default_factory=dict)
    unit: str = "mm"
    worst: float = 1.0
    legend: str = ""
    grey: str = ""
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.times.ndim != 1 or len(self.times) == 0 or not (np.diff(self.times) > 0).all():
            raise InvalidInput("times", got=f"shape {self.times.shape}", expected="increasing seconds, at least one")
        for name, frames in self._frames():
            if len(frames) != len(self.times) and not (name in self.solids and len(frames) == 1):
                raise InvalidInput(f"{name!r}", got=f"{len(frames)} frames", expected=f"{len(self.times)}, as times")
        for name, sheet in self.sheets.items():
            if (bad := ~np.isfinite(sheet.vertices).all((1, 2))).any():
                got, remedy = f"a place that is not finite in frame {bad.argmax()}", "take the frames before"
                raise InvalidInput(f"vertices of {name!r}", got=got, expected="metres", remedy=remedy)

    def __len__(self) -> int:
        return len(self.times)

    @property
    def measured(self) -> bool:
        """Whether a sheet carries values, so that a colour bar is needed."""
        return any(sheet.values is not None for sheet in self.sheets.values())

    @cached_property
    def box(self) -> tuple[Array, Array]:
        """Lower and upper corner, each [3] m, of all that the film is about: cloth, points and grippers; else all."""
        about = [sheet.vertices.reshape(-1, 3) for sheet in self.sheets.values()]
        about += [frame for cloud in self.clouds.values() for frame in cloud.frames]
        about += [trace.points for trace in self.traces.values()]
        if not any(len(part) for part in about):
            about = [placed(solid, frame) for solid in self.solids.values() for frame in range(len(self))]
        if not about:
            return np.full(3, -0.5), np.full(3, 0.5)
        points = np.concatenate(about)
        low, high = points.min(axis=0), points.max(axis=0)
        cloth = bool(self.sheets) or any(len(frame) for cloud in self.clouds.values() for frame in cloud.frames)
        least = SMALLEST if cloth else ALONE
        if (high - low).max() < least:  # a gripper that stands still has no size
            low, high = (low + high - least) / 2, (low + high + least) / 2
        return low, high

    def take(self, index: Array) -> Film:
        """The film of some frames [N], in their order."""
        return replace(
            self,
            times=self.times[index],
            sheets={
                name: replace(s, vertices=s.vertices[index], values=None if s.values is None else s.values[index])
                for name, s in self.sheets.items()
            },
            clouds={name: replace(c, frames=tuple(c.frames[i] for i in index)) for name, c in self.clouds.items()},
            solids={
                name: s if len(s.poses) == 1 else replace(s, poses=s.poses[index]) for name, s in self.solids.items()
            },
            traces={name: replace(t, poses=t.poses[index]) for name, t in self.traces.items()},
            views={name: replace(v, index=v.index[index]) for name, v in self.views.items()},
        )

    def at_most(self, rate: float) -> Film:
        """The film with frames left out, so that it has no more than ``rate`` a second."""
        if len(self) < 2:
            return self
        count = np.floor((self.times[-1] - self.times[0]) * rate + 1e-6) + 1
        if count >= len(self):
            return self
        wanted = self.times[0] + np.arange(count) / rate
        return self.take(np.unique(nearest(self.times, wanted)))

    def _frames(self) -> Iterator[tuple[str, Sized]]:
        yield from ((name, s.vertices) for name, s in self.sheets.items())
        yield from ((name, s.values) for name, s in self.sheets.items() if s.values is not None)
        yield from ((name, c.frames) for name, c in self.clouds.items())
        yield from ((name, s.poses) for name, s in self.solids.items())
        yield from ((name, t.poses) for name, t in self.traces.items())
        yield from ((name, v.index) for name, v in self.views.items())


def placed(solid: Solid, frame: int) -> Array:
    """Vertices [V, 3] m of a solid in the world at a frame."""
    pose = solid.poses[frame if len(solid.poses) > 1 else 0]
    return solid.vertices @ pose[:3, :3].T + pose[:3, 3]


def ground_of(film: Film) -> list[Plane]:
    """The film's planes; without any, a level floor under everything, for orientation."""
    if film.planes:
        return list(film.planes.values())
    low, high = film.box
    lowest = [low[2], *(placed(solid, 0)[:, 2].min() for solid in film.solids.values())]
    height, half = min(lowest), float(np.linalg.norm(high - low))
    middle = np.round((low + high)[:2] / 2 / CELL) * CELL
    half = np.ceil(half / CELL) * CELL
    corners = middle + half * np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]])
    return [Plane(np.column_stack([corners, np.full(4, height)]), FLOOR)]
