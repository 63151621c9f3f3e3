"""What one episode holds: small frozen bags of numpy arrays. SI units, right-handed, z up, quaternions wxyz.

Numbers are float64 whatever the file stored. ``extra`` keeps the keys that this version does not know; they are
written back.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InvalidInput, RecordingError
from .images import ImageStream


@dataclass(frozen=True, eq=False, kw_only=True)
class ClothInfo:
    """The cloth at rest: a mesh with pattern coordinates, or a plain rectangle; what is known of its weight."""

    areal_density: float  # kg/m^2
    areal_density_std: float | None = None  # kg/m^2, one standard deviation
    thickness: float | None = None  # m
    sheet: tuple[float, float] | None = None  # m, (width, height) of a rectangle with pattern corner (0, 0)
    vertices: np.ndarray | None = None  # [V, 3] m, rest mesh
    faces: np.ndarray | None = None  # [F, 3] vertex indices
    uv: np.ndarray | None = None  # m, pattern coordinates (u warp, v weft): [V, 2], or [F, 3, 2] of sewn panels
    # m, world, at the first frame; measured, with error: [V, 3], or [M, N, 3] of a regular grid on a sheet without a
    initial_vertices: np.ndarray | None = None  # mesh, from pattern corner to corner, along the width first
    nominal: dict[str, Any] = field(default_factory=dict)  # data-sheet values: a start for fits, possibly wrong
    extra: dict[str, Any] = field(default_factory=dict)

    @property
    def weighed(self) -> tuple[float, float] | None:
        """kg/m^2, areal density and its standard deviation; None where that is not known."""
        return (self.areal_density, self.areal_density_std) if self.areal_density_std else None

    def pattern_box(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Lower and upper corner, each [2] m, of the pattern; None for a mesh without pattern coordinates."""
        if self.uv is not None:
            points = self.uv.reshape(-1, 2)
            return points.min(axis=0), points.max(axis=0)
        return None if self.sheet is None else (np.zeros(2), np.asarray(self.sheet, dtype=float))

    def initial_at(self, uv: np.ndarray) -> np.ndarray:
        """Positions [N, 3] m at the first frame of the points ``uv`` [N, 2] m of a sheet, bilinear on its grid.

        Raises:
            RecordingError: no sheet with a grid of initial positions, or points outside it.
        """
        grid = self.initial_vertices
        if self.sheet is None or grid is None or grid.ndim != 3:
            raise RecordingError("cloth has no initial grid", expected="a sheet with initial_vertices [M, N, 3]")
        place = np.asarray(uv) / self.sheet
        if not (place.min() >= -1e-9 and place.max() <= 1 + 1e-9):
            raise RecordingError("uv is not on the sheet", got=f"{place.min():g} to {place.max():g} of its sides")
        cells = np.array(grid.shape[:2]) - 1
        lower = np.clip((place * cells).astype(int), 0, cells - 1)
        (a, b), (i, j) = (place * cells - lower).T[..., None], lower.T
        low = (1 - a) * grid[i, j] + a * grid[i + 1, j]
        return (1 - b) * low + b * ((1 - a) * grid[i, j + 1] + a * grid[i + 1, j + 1])


@dataclass(frozen=True, eq=False)
class GraspInfo:
    """Where a gripper holds: all material within ``radius`` of any of the pattern points, or vertices of the mesh."""

    uv: np.ndarray | None = None  # [G, 2] m, pattern coordinates
    radius: float = 0.0  # m, around uv; of no use with vertices
    extra: dict[str, Any] = field(default_factory=dict)
    vertices: np.ndarray | None = None  # [N] indices, instead of uv


@dataclass(frozen=True, eq=False)
class GripperMotion:
    """The path of one gripper's origin; the same name may also have a `JointMotion` on the same knots."""

    t: np.ndarray  # [K] s
    position: np.ndarray  # [K, 3] m, world
    quat_wxyz: np.ndarray  # [K, 4] unit
    closed: np.ndarray  # [K] bool, holds from this knot until the next
    force: np.ndarray | None = None  # [K, 3] N, world
    torque: np.ndarray | None = None  # [K, 3] N m, world
    extra: dict[str, np.ndarray] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class JointMotion:
    """The path of one arm in joint space; ``Recording.robots`` says which arm and where it stands."""

    t: np.ndarray  # [K] s
    q: np.ndarray  # [K, J] rad
    closed: np.ndarray | None = None  # [K] bool
    width: np.ndarray | None = None  # [K] m, opening of the fingers
    force: np.ndarray | None = None  # [K, 3] N, world
    torque: np.ndarray | None = None  # [K, 3] N m, world
    extra: dict[str, np.ndarray] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class PointClouds:
    """Segmented cloth points of T frames, one after the other."""

    t: np.ndarray  # [T] s
    xyz: np.ndarray  # [sum(counts), 3] m, world
    counts: np.ndarray  # [T] points of each frame, at least one
    extra: dict[str, np.ndarray] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.t)

    def frame(self, i: int) -> np.ndarray:
        """The points [counts[i], 3] m of frame ``i`` (a view)."""
        end = int(np.cumsum(self.counts)[i])
        return self.xyz[end - int(self.counts[i]) : end]

    def only(self, frames: np.ndarray | Sequence[int] | slice) -> PointClouds:
        """Those of some frames, by mask [T], indices or a slice, without ``extra``."""
        mask = np.zeros(len(self.t), dtype=bool)
        mask[frames] = True
        return PointClouds(self.t[mask], self.xyz[np.repeat(mask, self.counts)], self.counts[mask])


@dataclass(frozen=True, eq=False)
class Markers:
    """Tracked points, NaN where unseen; with ``uv`` they are known material points."""

    t: np.ndarray  # [T] s
    xyz: np.ndarray  # [T, M, 3] m, world
    uv: np.ndarray | None = None  # [M, 2] m, pattern coordinates
    extra: dict[str, np.ndarray] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class RobotInfo:
    """Which arm moved, where it stands, and which frame of it is the gripper."""

    model: str
    T_world_base: np.ndarray  # [4, 4]
    tool_frame: str | None = None
    extra: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, eq=False, kw_only=True)
class Camera:
    """A calibrated camera (OpenCV convention) and its images, where kept."""

    width: int  # pixels
    height: int  # pixels
    K: np.ndarray  # [3, 3] pixels
    T_world_camera: np.ndarray  # [4, 4]
    distortion: np.ndarray = field(default_factory=lambda: np.zeros(0))  # [N] OpenCV order
    depth_scale: float | None = None  # m per unit of the depth image
    depth: ImageStream | None = None
    color: ImageStream | None = None
    mask: ImageStream | None = None
    extra: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Collider:
    """A half-space that the cloth cannot enter."""

    point: np.ndarray  # [3] m, on the plane
    normal: np.ndarray  # [3] unit, out of the solid
    friction: float | None = None  # Coulomb coefficient
    extra: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Truth:
    """The true motion of a synthetic episode; only for scoring, never for identify or diagnose."""

    t: np.ndarray  # [T] s
    vertices: np.ndarray  # [T, V, 3] m, world
    faces: np.ndarray  # [F, 3]
    extra: dict[str, np.ndarray] = field(default_factory=dict)


@dataclass(frozen=True, eq=False, kw_only=True)
class Recording:
    """One episode. Streams that were not recorded are None or empty; `require` turns that into a message.

    Motion and truth run on the motion clock; points, markers and images on the observation clock:
    t_motion = t_observation + clock_offset.
    """

    cloth: ClothInfo
    provenance: str  # "measured" or "synthetic: <generator>"
    grasps: dict[str, GraspInfo] = field(default_factory=dict)
    grippers: dict[str, GripperMotion] = field(default_factory=dict)
    joints: dict[str, JointMotion] = field(default_factory=dict)
    robots: dict[str, RobotInfo] = field(default_factory=dict)
    cameras: dict[str, Camera] = field(default_factory=dict)
    colliders: dict[str, Collider] = field(default_factory=dict)
    points: PointClouds | None = None
    markers: Markers | None = None
    truth: Truth | None = None
    observation_noise_std: float | None = None  # m
    clock_offset: float = 0.0  # s
    gravity: np.ndarray = field(default_factory=lambda: np.array([0.0, 0.0, -9.81]))  # [3] m/s^2
    air_density: float | None = None  # kg/m^3, a fact about the room
    split: dict[str, Any] = field(default_factory=dict)  # motion: group for held-out tests; replicate_of: episode
    licence: str | None = None
    path: Path | None = None  # where it was read from; None while only in memory
    extra: dict[str, Any] = field(default_factory=dict)

    def require(self, stream: str, *, by: str = "this call") -> Any:
        """Return a stream that the caller cannot do without.

        Args:
            stream: one of the names in ``STREAMS``, for example "points" or "force".
            by: who needs it, for the message.

        Returns:
            The attribute of that name; "force", "torque", "depth", "color" and "mask" give a dict by name.

        Raises:
            RecordingError: the episode does not hold it.
            InvalidInput: no stream has this name.
        """
        if stream not in STREAMS:
            raise InvalidInput("stream is unknown", got=repr(stream), expected=f"one of {', '.join(STREAMS)}")
        find, remedy = STREAMS[stream]
        value = find(self)
        if value is None or (isinstance(value, dict) and not value):
            raise RecordingError(f"{self.path or 'this recording'} has no {stream}, which {by} needs", remedy=remedy)
        return value


def _of_motions(key: str) -> Callable[[Recording], dict[str, np.ndarray]]:
    def find(recording: Recording) -> dict[str, np.ndarray]:
        motions = {**recording.joints, **recording.grippers}
        return {name: getattr(m, key) for name, m in motions.items() if getattr(m, key) is not None}

    return find


def _of_cameras(key: str) -> Callable[[Recording], dict[str, ImageStream]]:
    def find(recording: Recording) -> dict[str, ImageStream]:
        return {name: getattr(c, key) for name, c in recording.cameras.items() if getattr(c, key) is not None}

    return find


def _of_recording(key: str) -> Callable[[Recording], Any]:
    return lambda recording: getattr(recording, key)


# What can be required, where it is found, and what to do when it is not there.
STREAMS: dict[str, tuple[Callable[[Recording], Any], str]] = {
    "points": (
        _of_recording("points"),
        "record segmented cloth points into points.npz, or cut them out of the depth images (docs/formats.md)",
    ),
    "markers": (_of_recording("markers"), "record tracked points into markers.npz"),
    "truth": (_of_recording("truth"), "only synthetic episodes have it; in Python read(path, with_truth=True)"),
    "grippers": (_of_recording("grippers"), "write NAME/position, NAME/quat_wxyz and NAME/closed into motion.npz"),
    "joints": (_of_recording("joints"), "write NAME/t and NAME/q into motion.npz"),
    "force": (_of_motions("force"), "write NAME/force [K, 3] in N, world axes, into motion.npz"),
    "torque": (_of_motions("torque"), "write NAME/torque [K, 3] in N m, world axes, into motion.npz"),
    "robots": (_of_recording("robots"), "name the arm and its base under robots in episode.json"),
    "grasps": (_of_recording("grasps"), "say where each gripper holds under grasps in episode.json"),
    "cameras": (_of_recording("cameras"), "give the calibration under cameras in episode.json"),
    "depth": (_of_cameras("depth"), "keep the depth images in CAMERA/depth/%06d.png"),
    "color": (_of_cameras("color"), "keep the colour images in CAMERA/color/%06d.jpg"),
    "mask": (_of_cameras("mask"), "keep the cloth masks in CAMERA/mask/%06d.png"),
    "initial_vertices": (lambda r: r.cloth.initial_vertices, "store [V, 3] as cloth.initial_vertices"),
    "observation_noise_std": (_of_recording("observation_noise_std"), "set observation_noise.std in episode.json"),
    "air_density": (_of_recording("air_density"), "set air.density in episode.json"),
}
