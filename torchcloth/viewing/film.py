"""Scene description for all viewers: named shapes over common times, in world coordinates, SI units, z up.

Names with a slash form groups that are switched together: "arms/left/link1" belongs to the group "arms".
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sized
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from ..errors import InvalidInput
from ..recordings import Camera
from .geometry import Array, nearest_indices

Colour = tuple[int, int, int]  # sRGB, 0 to 255
DISTANCE_CURVE = "distance"  # name of the curve of the sheets' values, which GIF and PNG draw below the scene

CLOTH_COLOUR, TRUTH_COLOUR, POINT_COLOUR, MARKER_COLOUR = (158, 184, 206), (126, 168, 110), (30, 34, 40), (200, 40, 120)
GRID_CELL_M = 0.1  # of the grid on a plane or floor
GRIPPER_AXES_LENGTH_M = 0.05
FLOOR_COLOUR = (255, 255, 255)
MIN_CLOTH_EXTENT_M = 0.01  # of the bounds, if cloth or points are shown
MIN_SCENE_EXTENT_M = 0.3  # of the bounds otherwise, because a gripper that stands still has no size
ARM_COLOUR, COLLIDER_COLOUR, PATH_COLOUR = (206, 210, 215), (206, 196, 180), (70, 110, 190)


@dataclass(frozen=True, eq=False)
class ClothSurface:
    """A moving cloth.

    Attributes:
        vertices: [T, V, 3] m.
        faces: [F, 3].
        values: [T, V] in the film's unit, NaN where unknown; None: the cloth has a plain colour.
        colour: sRGB.
        outline: show the boundary edges only (all edges if there is no boundary), so that it hides no other cloth.
    """

    vertices: Array
    faces: Array
    values: Array | None = None
    colour: Colour = CLOTH_COLOUR
    outline: bool = False


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points, a different set in every frame.

    Attributes:
        frames: T arrays [N, 3] m; N may be 0.
        colour: sRGB.
    """

    frames: tuple[Array, ...]
    colour: Colour = POINT_COLOUR


@dataclass(frozen=True, eq=False)
class GroundPlane:
    """A square of a half-space's surface.

    Attributes:
        corners: [4, 3] m, counterclockwise as seen from the side of the cloth.
        colour: sRGB.
    """

    corners: Array
    colour: Colour = COLLIDER_COLOUR

    FACES = np.array([[0, 1, 2], [0, 2, 3]])


@dataclass(frozen=True, eq=False)
class RigidBody:
    """A closed rigid body.

    Attributes:
        vertices: [V, 3] m, in the body's frame.
        faces: [F, 3], counterclockwise from outside.
        poses: [T, 4, 4] from the body's frame to the world, or [1, 4, 4] if it stands still.
        colour: sRGB.
    """

    vertices: Array
    faces: Array
    poses: Array
    colour: Colour = ARM_COLOUR


@dataclass(frozen=True, eq=False)
class GripperPath:
    """Path of a gripper, and its pose in each frame.

    Attributes:
        points: [K, 3] m, the whole path.
        poses: [T, 4, 4] in the world.
        colour: sRGB.
    """

    points: Array
    poses: Array
    colour: Colour = PATH_COLOUR


@dataclass(frozen=True, eq=False)
class CameraView:
    """A recorded camera and its depth images.

    Attributes:
        camera: the recorded camera.
        index: [T] int64, the depth image that belongs to each frame; -1: none.
    """

    camera: Camera
    index: Array

    def depth_image(self, frame: int) -> Array | None:
        """Return the depth image of a frame, uint16 [H, W] in units of ``camera.depth_scale``, 0 where invalid.

        None if the frame has no depth image.
        """
        if self.camera.depth is None or self.index[frame] < 0:
            return None
        return self.camera.depth.load(int(self.index[frame]))


@dataclass(frozen=True, eq=False)
class Curve:
    """A quantity over time.

    Attributes:
        t: [K] s on the motion clock.
        values: [K].
        unit: of the values.
    """

    t: Array
    values: Array
    unit: str


@dataclass(frozen=True, eq=False, kw_only=True)
class Film:
    """One scene over T frames. All parts but title and times may be missing.

    Viewers show times as seconds from the first frame.

    Attributes:
        title: content of the film in a few words.
        times: [T] s on the motion clock, increasing.
        sheets, clouds, solids, planes, traces, views, curves: the parts, by name.
        unit: of the sheets' values.
        colour_limit: value at the end of the colour bar.
        legend: meaning of the values, for the colour bar.
        grey_label: meaning of grey, where the value is unknown.
        notes: what could not be shown, and why.

    Raises:
        InvalidInput: a part has another number of frames than ``times``, or a sheet is not finite.
    """

    title: str
    times: Array
    sheets: Mapping[str, ClothSurface] = field(default_factory=dict)
    clouds: Mapping[str, Cloud] = field(default_factory=dict)
    solids: Mapping[str, RigidBody] = field(default_factory=dict)
    planes: Mapping[str, GroundPlane] = field(default_factory=dict)
    traces: Mapping[str, GripperPath] = field(default_factory=dict)
    views: Mapping[str, CameraView] = field(default_factory=dict)
    curves: Mapping[str, Curve] = field(default_factory=dict)
    unit: str = "mm"
    colour_limit: float = 1.0
    legend: str = ""
    grey_label: str = ""
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.times.ndim != 1 or len(self.times) == 0 or not (np.diff(self.times) > 0).all():
            raise InvalidInput("times", got=f"shape {self.times.shape}", expected="increasing seconds, at least one")
        for name, frames in self._frames():
            if len(frames) != len(self.times) and not (name in self.solids and len(frames) == 1):
                raise InvalidInput(f"{name!r}", got=f"{len(frames)} frames", expected=f"{len(self.times)}, as times")
        for name, sheet in self.sheets.items():
            if (bad := ~np.isfinite(sheet.vertices).all((1, 2))).any():
                got, remedy = f"a position that is not finite in frame {bad.argmax()}", "take the frames before"
                raise InvalidInput(f"vertices of {name!r}", got=got, expected="metres", remedy=remedy)

    def __len__(self) -> int:
        return len(self.times)

    def seconds(self, frame: int) -> float:
        """Return the time of a frame in seconds from the first frame."""
        return float(self.times[frame] - self.times[0])

    @property
    def has_values(self) -> bool:
        """Whether a sheet has values, so that a colour bar is needed."""
        return any(sheet.values is not None for sheet in self.sheets.values())

    @cached_property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper corner [3] m of cloth, points and gripper paths; of the bodies if there are none of these."""
        content = [sheet.vertices.reshape(-1, 3) for sheet in self.sheets.values()]
        content += [frame for cloud in self.clouds.values() for frame in cloud.frames]
        content += [trace.points for trace in self.traces.values()]
        if not any(len(part) for part in content):
            content = [posed_vertices(solid, frame) for solid in self.solids.values() for frame in range(len(self))]
        if not content:
            return np.full(3, -0.5), np.full(3, 0.5)
        points = np.concatenate(content)
        low, high = points.min(axis=0), points.max(axis=0)
        cloth = bool(self.sheets) or any(len(frame) for cloud in self.clouds.values() for frame in cloud.frames)
        min_extent = MIN_CLOTH_EXTENT_M if cloth else MIN_SCENE_EXTENT_M
        if (high - low).max() < min_extent:  # a gripper that stands still has no size
            low, high = (low + high - min_extent) / 2, (low + high + min_extent) / 2
        return low, high

    def select_frames(self, index: Array) -> Film:
        """Return a film of the frames with these indices [N], in their order."""
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

    def limit_rate(self, rate: float) -> Film:
        """Return the film with at most ``rate`` frames per second; others are left out."""
        if len(self) < 2:
            return self
        count = np.floor((self.times[-1] - self.times[0]) * rate + 1e-6) + 1
        if count >= len(self):
            return self
        wanted = self.times[0] + np.arange(count) / rate
        return self.select_frames(np.unique(nearest_indices(self.times, wanted)))

    def _frames(self) -> Iterator[tuple[str, Sized]]:
        yield from ((name, s.vertices) for name, s in self.sheets.items())
        yield from ((name, s.values) for name, s in self.sheets.items() if s.values is not None)
        yield from ((name, c.frames) for name, c in self.clouds.items())
        yield from ((name, s.poses) for name, s in self.solids.items())
        yield from ((name, t.poses) for name, t in self.traces.items())
        yield from ((name, v.index) for name, v in self.views.items())


def posed_vertices(solid: RigidBody, frame: int) -> Array:
    """Return the vertices [V, 3] m of a body in the world at a frame."""
    pose = solid.poses[frame if len(solid.poses) > 1 else 0]
    return solid.vertices @ pose[:3, :3].T + pose[:3, 3]


def ground_planes(film: Film) -> list[GroundPlane]:
    """Return the film's planes, or a level floor under the whole scene if it has none."""
    if film.planes:
        return list(film.planes.values())
    low, high = film.bounds
    lowest = [low[2], *(posed_vertices(solid, 0)[:, 2].min() for solid in film.solids.values())]
    height, half = min(lowest), float(np.linalg.norm(high - low))
    middle = np.round((low + high)[:2] / 2 / GRID_CELL_M) * GRID_CELL_M
    half = np.ceil(half / GRID_CELL_M) * GRID_CELL_M
    corners = middle + half * np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]])
    return [GroundPlane(np.column_stack([corners, np.full(4, height)]), FLOOR_COLOUR)]
