"""Recorded episodes as tensors: the motion of the grippers, frame times, points, markers and forces."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np
import torch
from torch import Tensor

from .._utils.linalg import EXACT_CDIST_MODE, find_last_knot
from ..boundaries import Grasp
from ..boundaries.motion import interpolate_poses
from ..cloth import Cloth
from ..errors import InvalidInput, RecordingError
from ..losses import ClosestPoints
from ..recordings import Camera, Recording
from ..recordings.consistency import as_list, check_same_cloth, merge_scene
from ..recordings.fingerprints import reject_duplicates
from ..recordings.size_checks import check_size
from ..robots import list_closing_grippers, replay  # pyright: ignore[reportMissingImports] - mapped from robots/ at installation
from ..types import Trajectory
from . import streams
from .recorded_cloth import compute_initial_velocities, compute_initial_vertices

DEFAULT_FRAME_RATE_HZ = 20.0  # of episodes without measurements
MIN_FRAMES_OF_PART = 4  # of the beginning of an episode
MAX_FIRST_CLOUD_OFFSET_FRACTION = 0.15  # median distance of the first cloud from the cloth, in the cloth's diagonals
MAX_SILENTLY_DROPPED_READINGS_PER_FRAME = 0.1  # force readings after the last frame, above which there is a warning
MIN_EXCHANGE_GAIN_M, MIN_EXCHANGE_RATIO = 0.05, 2.0  # by which exchanged grippers are nearer, both together
MAX_PATCH_TO_GRIPPER_M = 0.2  # distance of a held patch from its gripper's origin at the first frame
TIME_TOLERANCE_S = 1e-6  # by which a frame may lie outside of the motion
TIME_AFTER_KNOT_S = 1e-9  # added to a time, so that a knot at that time counts as passed


@dataclass(frozen=True, eq=False)
class Episode:
    """One recording, as tensors.

    Attributes:
        name: in messages and pictures.
        motion: grippers' trajectories by name.
        times: [T] s, frame times on the motion's clock.
        clouds: T tensors [N_t, 3] m, empty where there are no points.
        initial: [V, 3] m, vertex positions at the first frame.
        needs_settling: whether ``initial`` was measured, so that its noise is damped out before the first frame.
        noise_std: standard deviation of one point [m], or None when unknown.
        markers: [T, M, 3] m, material points, NaN where hidden; or None.
        marker_places: where the markers are on the mesh.
        wrenches: gripper -> [T, 6] N, N m, exerted by the cloth on the gripper about its origin: mean over the interval
            that ends at the frame, NaN where not measured.
        unobserved_count: number of frames at the end that are simulated and not observed.
        camera_position: [3] m; None without a camera, or with more than one.
        frames_after_motion: number of frames after the motion's end, which are not simulated.
        readings_after_last_frame: number of force readings after the last frame with points or markers, which are not
            simulated either.
        idle_grippers: names of grippers that close and hold nothing: the cloth has no grasp of their name.
        initial_velocity: [V, 3] m/s, of the vertices at the first frame; None: the cloth is at rest there.
    """

    name: str
    motion: Mapping[str, Trajectory]
    times: Tensor
    clouds: list[Tensor]
    initial: Tensor
    needs_settling: bool
    noise_std: float | None
    markers: Tensor | None = None
    marker_places: ClosestPoints | None = None
    wrenches: Mapping[str, Tensor] = field(default_factory=dict)
    unobserved_count: int = 0
    camera_position: Tensor | None = None
    frames_after_motion: int = 0
    readings_after_last_frame: int = 0
    idle_grippers: tuple[str, ...] = ()
    initial_velocity: Tensor | None = None

    def fingerprint_parts(self) -> list[object]:
        """List everything that simulations of it, and their comparison with the data, depend on."""
        data = [
            self.times,
            self.initial,
            self.initial_velocity,
            self.needs_settling,
            *self.clouds,
            self.markers,
            *(self.marker_places or ()),
            self.noise_std,
        ]
        motion = [part for name, m in self.motion.items() for part in (name, m.t, m.pose, m.closed)]
        return [*data, self.camera_position, *motion, *(part for pair in self.wrenches.items() for part in pair)]

    @property
    def observed_count(self) -> int:
        """Number of frames that may have data."""
        return len(self.times) - self.unobserved_count

    @property
    def is_first_shape_measured(self) -> bool:
        """Whether ``initial`` has the errors of a measurement."""
        return self.needs_settling or self.initial_velocity is not None

    @property
    def lookahead(self) -> float:
        """Duration of the frames that are simulated after the last observed one [s]."""
        return float(self.times[-1] - self.times[self.observed_count - 1])

    def data_warnings(self) -> list[str]:
        """List what a reader should know of the data, in sentences."""
        warnings = []
        if self.frames_after_motion:
            count = self.observed_count + self.frames_after_motion
            warnings.append(
                f"{self.name}: {self.frames_after_motion} of {count} frames come after the motion's end and were left "
                "out: record the motion as long, or check clock_offset"
            )
        if self.readings_after_last_frame > MAX_SILENTLY_DROPPED_READINGS_PER_FRAME * self.observed_count:
            warnings.append(
                f"{self.name}: {self.readings_after_last_frame} force readings come after the last frame with points "
                "or markers and were left out: leave points and markers out of the recording to use forces alone"
            )
        if self.motion and not any(bool(m.closed.any()) for m in self.motion.values()):
            warnings.append(f"{self.name}: no gripper is ever closed: a simulation lets the cloth go")
        if self.idle_grippers:
            names = ", ".join(self.idle_grippers)
            warnings.append(f"{self.name}: no grasp is called {names}: no simulation holds the cloth there")
        if self._is_far_from_first_cloud():
            offset = (self.clouds[0].mean(0) - self.initial.mean(0)).tolist()
            text = ", ".join(f"{1e3 * x:+.0f}" for x in offset)
            warnings.append(
                f"{self.name}: the points of the first frame lie ({text}) mm from the cloth: check T_world_camera, the "
                "grasps' poses and initial_vertices"
            )
        return warnings

    def _is_far_from_first_cloud(self) -> bool:
        """Whether most points of the first frame are far from the cloth."""
        if not self.clouds or not len(self.clouds[0]):
            return False
        distance = torch.cdist(self.clouds[0], self.initial, compute_mode=EXACT_CDIST_MODE).amin(1)
        diagonal = float((self.initial.amax(0) - self.initial.amin(0)).norm())
        return float(distance.median()) > MAX_FIRST_CLOUD_OFFSET_FRACTION * diagonal

    def with_lookahead(self, duration: float) -> Episode:
        """Add frames after the last one, for ``duration`` [s] or until the motion ends: a late clock sees them."""
        step = float(self.times.diff().median())
        end = min((float(m.t[-1]) for m in self.motion.values()), default=torch.inf)
        last = min(float(self.times[-1]) + duration, end)
        steps = torch.arange(1, 1 + int((last - float(self.times[-1])) / step + 1e-6), dtype=self.times.dtype)
        times = torch.cat([self.times, self.times[-1] + step * steps])
        if last - float(times[-1]) > streams.SAME_TIME_S:
            times = torch.cat([times, times.new_tensor([last])])
        extra = len(times) - len(self.times)

        def pad(data: Tensor) -> Tensor:
            return torch.cat([data, data.new_full((extra, *data.shape[1:]), torch.nan)])

        return replace(
            self,
            times=times,
            clouds=[*self.clouds, *(self.initial.new_zeros(0, 3) for _ in range(extra))],
            markers=None if self.markers is None else pad(self.markers),
            wrenches={name: pad(wrench) for name, wrench in self.wrenches.items()},
            unobserved_count=self.unobserved_count + extra,
        )

    def without_observations_after(self, end: float) -> Episode:
        """Remove points and markers later than ``end`` [s]; forces stay."""
        is_late = self.times > end + streams.SAME_TIME_S
        markers = self.markers
        if markers is not None:
            markers = markers.where(~is_late[:, None, None], torch.nan)
        clouds = [c[:0] if late else c for c, late in zip(self.clouds, is_late.tolist(), strict=True)]
        return replace(self, clouds=clouds, markers=markers)

    def with_thinned_clouds(self, points_per_frame: int) -> Episode:
        """Return the episode with about so many points in a frame: every n-th one of the order in the cloud."""
        return replace(self, clouds=[cloud[:: max(1, len(cloud) // points_per_frame)] for cloud in self.clouds])

    def first_fraction(self, fraction: float) -> Episode:
        """Return the first ``fraction`` of the frames, at least four."""
        count = min(self.observed_count, max(MIN_FRAMES_OF_PART, round(fraction * self.observed_count)))
        return replace(
            self,
            times=self.times[:count],
            clouds=self.clouds[:count],
            markers=None if self.markers is None else self.markers[:count],
            wrenches={name: wrench[:count] for name, wrench in self.wrenches.items()},
            unobserved_count=0,
        )

    def observed_points(self, frame: int) -> Tensor:
        """Return the cloud [N, 3] m of a frame, or its visible markers where the episode has no cloud at all."""
        if self.markers is None or any(len(cloud) for cloud in self.clouds):
            return self.clouds[frame]
        markers = self.markers[frame]
        return markers[markers.isfinite().all(-1)]


def check_recordings(recordings: Recording | Sequence[Recording]) -> list[Recording]:
    """Check that recordings can be fitted together, and return them as a list.

    Raises:
        InvalidInput: none, one twice, different cloths or tables, or something that is no recording.
        RecordingError: one that is in another unit than metres, or in which nothing holds the cloth.
    """
    checked = as_list(recordings)
    if not checked:
        raise InvalidInput("recordings", got="none", expected="at least one episode")
    check_same_cloth(checked)
    reject_duplicates(checked)
    for recording in checked:
        check_size(recording)
        check_is_held(recording)
    merge_scene(checked)  # tables that contradict each other are refused now, and not with the result
    return checked


def check_is_held(recording: Recording) -> None:
    """Check that something holds the cloth, for a fit: cloth that falls freely tells of little but the air.

    Raises:
        RecordingError: no gripper is ever closed, and there is no collider.
    """
    if recording.colliders or list_closing_grippers(recording):
        return
    names = ", ".join([*recording.grippers, *recording.joints]) or "none"
    raise RecordingError(
        f"{recording.path}: nothing holds the cloth",
        got=f"grippers that are never closed ({names}), and no collider",
        expected="a gripper that closes, or a collider on which the cloth lies",
        remedy="write closed (or width) in motion.npz: it is true while the gripper holds the cloth",
    )


def require_cpu(cloth: Cloth) -> None:
    """Check that a cloth is on the CPU: episodes are read into memory that the fused engine works on.

    Raises:
        InvalidInput: the cloth is on another device.
    """
    if (device := cloth.areal_density.raw.device).type != "cpu":
        raise InvalidInput("cloth", got=f"on {device}", expected="a cloth on the CPU", remedy="cloth.cpu()")


def build_episode(
    cloth: Cloth, recording: Recording, rate: float | None = None, has_first_shape: bool = True
) -> Episode:
    """Check a recording against a cloth and turn it into tensors of the cloth's dtype.

    Args:
        cloth: with a grasp for each gripper that holds it.
        recording: of the cloth.
        rate: frame rate along the motion of an episode without measurements [Hz]; None refuses such an episode.
        has_first_shape: whether the cloth is where the recording or the mesh says at the first frame. Else the shape is
            to be estimated, and grippers may be far from it.

    Raises:
        RecordingError: no measurements, or no motion for one of the cloth's grasps.
        InvalidInput: initial vertices that do not belong to the cloth's mesh.
    """
    recording = streams.drop_duplicate_markers(recording)
    name = recording.path.name if recording.path else "recording"
    dtype = cloth.state(torch.as_tensor(cloth.mesh.vertices)).x.dtype
    grasps = [key for key, boundary in cloth.boundaries.items() if boundary.is_prescribed]
    motion = replay(recording, dtype, grasps)
    missing = [key for key in grasps if key not in motion]
    if missing:
        got = f"motion of {sorted({*recording.grippers, *recording.joints})}"
        raise RecordingError(f"{name}: no motion for grasp {missing[0]!r}", got=got)
    times, frames_after_motion = _frame_times(name, recording, motion, grasps, rate)
    initial = compute_initial_vertices(name, cloth, recording).to(dtype)
    velocity = compute_initial_velocities(cloth, recording)
    if has_first_shape:
        places = _gripper_places(cloth, motion, initial, times[0])
        _check_not_exchanged(name, places)
        _check_gripper_distance(name, places)
    markers = streams.gather_markers(recording, times, dtype)
    camera, uv = find_depth_camera(recording), None if recording.markers is None else recording.markers.uv
    is_late_reading = streams.find_force_times(recording, grasps) > times[-1] + float(np.diff(times).max())
    return Episode(
        name=name,
        motion={key: motion[key] for key in grasps},
        times=torch.as_tensor(times),
        clouds=streams.gather_clouds(recording, times, dtype),
        initial=initial,
        needs_settling=recording.cloth.initial_vertices is not None and velocity is None,
        noise_std=recording.observation_noise_std,
        markers=markers,
        marker_places=None if markers is None or uv is None else streams.locate_on_pattern(cloth.mesh, uv),
        wrenches=streams.average_wrenches(recording, grasps, times, dtype),
        camera_position=None if camera is None else torch.as_tensor(camera.T_world_camera[:3, 3], dtype=dtype),
        frames_after_motion=frames_after_motion,
        idle_grippers=tuple(key for key in list_closing_grippers(recording) if key not in grasps),
        readings_after_last_frame=int(is_late_reading.sum()),
        initial_velocity=None if velocity is None else velocity.to(dtype),
    )


def find_depth_camera(recording: Recording) -> Camera | None:
    """Return the camera that measures depth; of a single camera, that one; None if there is no such choice."""
    cameras = list(recording.cameras.values())
    with_depth = [c for c in cameras if c.depth is not None or c.depth_scale is not None]
    candidates = with_depth or cameras
    return candidates[0] if len(candidates) == 1 else None


def _frame_times(
    name: str, recording: Recording, motion: Mapping[str, Trajectory], grasps: list[str], rate: float | None
) -> tuple[np.ndarray, int]:
    """(times, number of frames that come after the motion's end and are left out).

    The times are those of points and markers, from the first frame of the points on. Without these they are times of
    force readings, and without any measurement those of frames at ``rate`` [Hz] along the motion.
    """
    streams_with_frames = [s for s in (recording.points, recording.markers) if s is not None]
    frame_times = [s.t + recording.clock_offset for s in streams_with_frames]
    if not frame_times:
        force_times = streams.find_force_times(recording, grasps)
        begin = max((float(motion[key].t[0]) for key in grasps), default=0.0)
        if not len(force_times) and grasps and rate is not None:
            duration = min(float(motion[key].t[-1]) for key in grasps) - begin
            if duration < 1 / rate:
                got, expected = f"{max(duration, 0):g} s of all grippers together", f"at least {1 / rate:g} s"
                raise RecordingError(f"{name}: motion", got=got, expected=expected, remedy="record all of it")
            return begin + np.arange(int(duration * rate + 1e-6) + 1) / rate, 0
        if not len(force_times):
            recording.require("points", by="a fit")
        return _times_within_motion(force_times[force_times >= begin - streams.SAME_TIME_S], motion, grasps)
    first_stream = frame_times[0]
    if len(first_stream) < 2:
        stream = "points" if recording.points is not None else "markers"
        raise RecordingError(f"{name}: {stream}", got=f"{len(first_stream)} frame(s)", expected="at least two")
    times = streams.merge_times(frame_times)
    return _times_within_motion(times[times >= first_stream[0] - streams.SAME_TIME_S], motion, grasps)


def _gripper_places(
    cloth: Cloth, motion: Mapping[str, Trajectory], x: Tensor, start: float
) -> dict[str, tuple[Tensor, Tensor]]:
    """Places [3] m of each gripper and of the patch that it holds at the first frame, of those that are closed then.

    A gripper that is open comes for the cloth later.
    """
    time, places = torch.tensor([start], dtype=torch.float64), {}
    for key, boundary in cloth.boundaries.items():
        if isinstance(boundary, Grasp):
            knot = int(find_last_knot(motion[key].t.double(), time + TIME_AFTER_KNOT_S))
            if motion[key].closed[max(knot, 0)]:
                places[key] = interpolate_poses(motion[key], time)[0, :3, 3], x[boundary.index].mean(0)
    return places


def _check_not_exchanged(name: str, places: Mapping[str, tuple[Tensor, Tensor]]) -> None:
    """Refuse grippers that are each much nearer to the other's patch than to their own."""
    for a, b in combinations(places, 2):
        (hand_a, patch_a), (hand_b, patch_b) = places[a], places[b]
        usual = float((hand_a - patch_a).norm() + (hand_b - patch_b).norm())
        exchanged = float((hand_a - patch_b).norm() + (hand_b - patch_a).norm())
        if usual > exchanged + MIN_EXCHANGE_GAIN_M and usual > MIN_EXCHANGE_RATIO * exchanged:
            raise InvalidInput(
                f"{name}: grasps {a!r} and {b!r}",
                got=f"grippers {500 * usual:.0f} mm from their own patches, {500 * exchanged:.0f} mm from each other's",
                expected="each gripper at its own patch",
                remedy="exchange the names of the grippers, or of the grasps",
            )


def _check_gripper_distance(name: str, places: Mapping[str, tuple[Tensor, Tensor]]) -> None:
    """Refuse a cloth that is far from its grippers: only their increments move it, so nothing else would show."""
    for key, (hand, patch) in places.items():
        distance = float((patch - hand).norm())
        if distance > MAX_PATCH_TO_GRIPPER_M:
            raise InvalidInput(
                f"{name}: grasp {key!r}",
                got=f"the held patch {distance:.2f} m from its gripper at the first frame",
                expected=f"within {MAX_PATCH_TO_GRIPPER_M:g} m",
                remedy="give cloth.initial_vertices in world coordinates (--network estimates them), or check "
                "the gripper's path and frame",
            )


def _times_within_motion(
    times: np.ndarray, motion: Mapping[str, Trajectory], grasps: list[str]
) -> tuple[np.ndarray, int]:
    """(times that the motion covers, number of others); it must cover the first one, where the cloth is known."""
    start = max((float(motion[key].t[0]) for key in grasps), default=-np.inf)
    end = min((float(motion[key].t[-1]) for key in grasps), default=np.inf)
    inside = np.flatnonzero((times >= start - TIME_TOLERANCE_S) & (times <= end + TIME_TOLERANCE_S))
    if len(inside) < 2 or inside[0] != 0:
        frames = f"frames in [{times[0]:g}, {times[-1]:g}] s" if len(times) else "no frames"
        raise RecordingError(
            "points and motion",
            got=f"{frames}, motion in [{start:g}, {end:g}] s",
            expected="motion that covers the first frame",
            remedy="check clock_offset",
        )
    return times[inside], len(times) - len(inside)
