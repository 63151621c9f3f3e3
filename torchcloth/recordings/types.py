"""Data classes of one episode: small frozen records of numpy arrays. SI units, right-handed, z up, quaternions wxyz.

Numbers are float64 whatever the file stored. ``extra`` holds the keys that this version does not know; they are written
back.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from .._utils.constants import STANDARD_GRAVITY_M_PER_S2
from ..errors import InvalidInput, RecordingError
from .images import ImageStream


@dataclass(frozen=True, eq=False, kw_only=True)
class ClothInfo:
    """The cloth at rest: a mesh with pattern coordinates, or a plain rectangle, and what is known of its weight.

    Attributes:
        areal_density: kg/m^2.
        areal_density_std: kg/m^2, one standard deviation.
        thickness: m.
        layer_gap: m, from centre to centre of layers that rest on each other; None: layers do not touch.
        sheet: m, (width, height) of a rectangle with pattern corner (0, 0).
        vertices: [V, 3] m, rest mesh.
        faces: [F, 3] vertex indices.
        uv: m, pattern coordinates (u warp, v weft): [V, 2], or [F, 3, 2] of sewn panels.
        initial_vertices: m, world, at the first frame; measured, with error. [V, 3], or [M, N, 3] of a regular grid on
            a sheet without a mesh, from pattern corner to corner, along the width first.
        initial_velocities: [V, 3] m/s, world, of the initial vertices; measured, with error. None: the cloth is at rest
            at the first frame.
        nominal: data-sheet values: a start for fits, possibly wrong.
        extra: unknown keys.
    """

    areal_density: float
    areal_density_std: float | None = None
    thickness: float | None = None
    layer_gap: float | None = None
    sheet: tuple[float, float] | None = None
    vertices: np.ndarray | None = None
    faces: np.ndarray | None = None
    uv: np.ndarray | None = None
    initial_vertices: np.ndarray | None = None
    initial_velocities: np.ndarray | None = None
    nominal: dict[str, Any] = field(default_factory=dict)
    extra: dict[str, Any] = field(default_factory=dict)

    @property
    def measured_areal_density(self) -> tuple[float, float] | None:
        """Areal density and its standard deviation [kg/m^2]; None if the standard deviation is unknown."""
        return (self.areal_density, self.areal_density_std) if self.areal_density_std else None

    def pattern_box(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the lower and upper corner, each [2] m, of the pattern.

        None for a mesh without pattern coordinates.
        """
        if self.uv is not None:
            points = self.uv.reshape(-1, 2)
            return points.min(axis=0), points.max(axis=0)
        return None if self.sheet is None else (np.zeros(2), np.asarray(self.sheet, dtype=float))

    def interpolate_initial_positions(self, uv: np.ndarray) -> np.ndarray:
        """Interpolate positions [N, 3] m at the first frame of the points ``uv`` [N, 2] m of a sheet.

        The interpolation is bilinear on the grid of initial positions.

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
    """Where a gripper holds: all material within ``radius`` of any of the pattern points, or vertices of the mesh.

    Attributes:
        uv: [G, 2] m, pattern coordinates.
        radius: m, around ``uv``; unused with vertices.
        extra: unknown keys.
        vertices: [N] indices, instead of ``uv``.
    """

    uv: np.ndarray | None = None
    radius: float = 0.0
    extra: dict[str, Any] = field(default_factory=dict)
    vertices: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class GripperMotion:
    """The path of one gripper's origin; the same name may also have a ``JointMotion`` on the same knots.

    Attributes:
        t: [K] s.
        position: [K, 3] m, world.
        quat_wxyz: [K, 4], unit quaternions.
        closed: [K] bool, holds from this knot until the next.
        force: [K, 3] N, world.
        torque: [K, 3] N m, world.
        extra: unknown arrays.
    """

    t: np.ndarray
    position: np.ndarray
    quat_wxyz: np.ndarray
    closed: np.ndarray
    force: np.ndarray | None = None
    torque: np.ndarray | None = None
    extra: dict[str, np.ndarray] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class JointMotion:
    """The path of one arm in joint space; ``Recording.robots`` says which arm and where it stands.

    Attributes:
        t: [K] s.
        q: [K, J] rad.
        closed: [K] bool.
        width: [K] m, opening of the fingers.
        force: [K, 3] N, world.
        torque: [K, 3] N m, world.
        extra: unknown arrays.
    """

    t: np.ndarray
    q: np.ndarray
    closed: np.ndarray | None = None
    width: np.ndarray | None = None
    force: np.ndarray | None = None
    torque: np.ndarray | None = None
    extra: dict[str, np.ndarray] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class PointClouds:
    """Segmented cloth points of T frames, one after the other.

    Attributes:
        t: [T] s.
        xyz: [sum(counts), 3] m, world.
        counts: [T], number of points of each frame, at least one.
        extra: unknown arrays.
    """

    t: np.ndarray
    xyz: np.ndarray
    counts: np.ndarray
    extra: dict[str, np.ndarray] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.t)

    def frame(self, i: int) -> np.ndarray:
        """Return the points [counts[i], 3] m of frame ``i`` (a view)."""
        end = int(np.cumsum(self.counts)[i])
        return self.xyz[end - int(self.counts[i]) : end]

    def select(self, frames: np.ndarray | Sequence[int] | slice) -> PointClouds:
        """Return some frames, by mask [T], indices or a slice, without ``extra``."""
        mask = np.zeros(len(self.t), dtype=bool)
        mask[frames] = True
        return PointClouds(self.t[mask], self.xyz[np.repeat(mask, self.counts)], self.counts[mask])


@dataclass(frozen=True, eq=False)
class Markers:
    """Tracked points, NaN where unseen; with ``uv`` they are known material points.

    Attributes:
        t: [T] s.
        xyz: [T, M, 3] m, world.
        uv: [M, 2] m, pattern coordinates.
        extra: unknown arrays.
    """

    t: np.ndarray
    xyz: np.ndarray
    uv: np.ndarray | None = None
    extra: dict[str, np.ndarray] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class RobotInfo:
    """Which arm moved, where it stands, and which frame of it is the gripper.

    Attributes:
        model: name of a shipped arm, or path of a URDF file.
        T_world_base: [4, 4] m, pose of the root link.
        tool_frame: link that is the gripper.
        extra: unknown keys.
    """

    model: str
    T_world_base: np.ndarray
    tool_frame: str | None = None
    extra: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, eq=False, kw_only=True)
class Camera:
    """A calibrated camera (OpenCV convention) and its stored images.

    Attributes:
        width: px.
        height: px.
        K: [3, 3] px, intrinsic matrix.
        T_world_camera: [4, 4] m, camera to world.
        distortion: [N], coefficients in OpenCV's order.
        depth_scale: m per unit of the depth image.
        depth: depth images.
        color: colour images.
        mask: masks of the cloth.
        extra: unknown keys.
    """

    width: int
    height: int
    K: np.ndarray
    T_world_camera: np.ndarray
    distortion: np.ndarray = field(default_factory=lambda: np.zeros(0))
    depth_scale: float | None = None
    depth: ImageStream | None = None
    color: ImageStream | None = None
    mask: ImageStream | None = None
    extra: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Collider:
    """A half-space that the cloth cannot enter.

    Attributes:
        point: [3] m, on the plane.
        normal: [3] unit, out of the solid.
        friction: Coulomb coefficient.
        extra: unknown keys.
    """

    point: np.ndarray
    normal: np.ndarray
    friction: float | None = None
    extra: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Truth:
    """The true motion of a synthetic episode; only for scoring, never for identification or diagnosis.

    Attributes:
        t: [T] s.
        vertices: [T, V, 3] m, world.
        faces: [F, 3].
        extra: unknown arrays.
    """

    t: np.ndarray
    vertices: np.ndarray
    faces: np.ndarray
    extra: dict[str, np.ndarray] = field(default_factory=dict)


@dataclass(frozen=True, eq=False, kw_only=True)
class Recording:
    """One episode. Streams that were not recorded are None or empty; ``require`` turns that into a message.

    Motion and truth run on the motion clock; points, markers and images on the observation clock:
    t_motion = t_observation + clock_offset.

    Attributes:
        cloth: the cloth at rest.
        provenance: "measured" or "synthetic: <generator>".
        grasps: where grippers hold, by gripper.
        grippers: paths by gripper.
        joints: joint paths by arm.
        robots: arms by name.
        cameras: by name.
        colliders: by name.
        points: segmented clouds.
        markers: tracked points.
        truth: true motion.
        observation_noise_std: m.
        clock_offset: s.
        gravity: [3] m/s^2.
        air_density: kg/m^3, of the room.
        split: motion: group for held-out tests; replicate_of: the episode whose motion is repeated.
        licence: of the data.
        path: where it was read from; None while only in memory.
        extra: unknown keys.
    """

    cloth: ClothInfo
    provenance: str
    grasps: dict[str, GraspInfo] = field(default_factory=dict)
    grippers: dict[str, GripperMotion] = field(default_factory=dict)
    joints: dict[str, JointMotion] = field(default_factory=dict)
    robots: dict[str, RobotInfo] = field(default_factory=dict)
    cameras: dict[str, Camera] = field(default_factory=dict)
    colliders: dict[str, Collider] = field(default_factory=dict)
    points: PointClouds | None = None
    markers: Markers | None = None
    truth: Truth | None = None
    observation_noise_std: float | None = None
    clock_offset: float = 0.0
    gravity: np.ndarray = field(default_factory=lambda: np.array([0.0, 0.0, -STANDARD_GRAVITY_M_PER_S2]))
    air_density: float | None = None
    split: dict[str, Any] = field(default_factory=dict)
    licence: str | None = None
    path: Path | None = None
    extra: dict[str, Any] = field(default_factory=dict)

    def require(self, stream: str, *, by: str = "this call") -> Any:
        """Return a stream that the caller cannot do without.

        Args:
            stream: one of the names in ``REQUIRABLE_STREAMS``, for example "points" or "force".
            by: who needs it, for the message.

        Returns:
            The attribute of that name; "force", "torque", "depth", "color" and "mask" give a dict by name.

        Raises:
            RecordingError: the episode does not hold it.
            InvalidInput: no stream has this name.
        """
        if stream not in REQUIRABLE_STREAMS:
            raise InvalidInput(
                "stream is unknown", got=repr(stream), expected=f"one of {', '.join(REQUIRABLE_STREAMS)}"
            )
        find, remedy = REQUIRABLE_STREAMS[stream]
        value = find(self)
        if value is None or (isinstance(value, dict) and not value):
            raise RecordingError(f"{self.path or 'this recording'} has no {stream}, which {by} needs", remedy=remedy)
        return value


def _motion_getter(key: str) -> Callable[[Recording], dict[str, np.ndarray]]:
    def find(recording: Recording) -> dict[str, np.ndarray]:
        motions = {**recording.joints, **recording.grippers}
        return {name: getattr(m, key) for name, m in motions.items() if getattr(m, key) is not None}

    return find


def _camera_getter(key: str) -> Callable[[Recording], dict[str, ImageStream]]:
    def find(recording: Recording) -> dict[str, ImageStream]:
        return {name: getattr(c, key) for name, c in recording.cameras.items() if getattr(c, key) is not None}

    return find


def _recording_getter(key: str) -> Callable[[Recording], Any]:
    return lambda recording: getattr(recording, key)


# Streams by name: a function that gets the stream, and the remedy if it is absent.
REQUIRABLE_STREAMS: dict[str, tuple[Callable[[Recording], Any], str]] = {
    "points": (
        _recording_getter("points"),
        "record segmented cloth points into points.npz, or segment the depth images (docs/how-to/import-recordings.md)",
    ),
    "markers": (_recording_getter("markers"), "record tracked points into markers.npz"),
    "truth": (_recording_getter("truth"), "only synthetic episodes have it; in Python read(path, with_truth=True)"),
    "grippers": (_recording_getter("grippers"), "write NAME/position, NAME/quat_wxyz and NAME/closed into motion.npz"),
    "joints": (_recording_getter("joints"), "write NAME/t and NAME/q into motion.npz"),
    "force": (_motion_getter("force"), "write NAME/force [K, 3] in N, world axes, into motion.npz"),
    "torque": (_motion_getter("torque"), "write NAME/torque [K, 3] in N m, world axes, into motion.npz"),
    "robots": (_recording_getter("robots"), "name the arm and its base under robots in episode.json"),
    "grasps": (_recording_getter("grasps"), "say where each gripper holds under grasps in episode.json"),
    "cameras": (_recording_getter("cameras"), "give the calibration under cameras in episode.json"),
    "depth": (_camera_getter("depth"), "keep the depth images in CAMERA/depth/%06d.png"),
    "color": (_camera_getter("color"), "keep the colour images in CAMERA/color/%06d.jpg"),
    "mask": (_camera_getter("mask"), "keep the cloth masks in CAMERA/mask/%06d.png"),
    "initial_vertices": (lambda r: r.cloth.initial_vertices, "store [V, 3] as cloth.initial_vertices"),
    "observation_noise_std": (_recording_getter("observation_noise_std"), "set observation_noise.std in episode.json"),
    "air_density": (_recording_getter("air_density"), "set air.density in episode.json"),
}
