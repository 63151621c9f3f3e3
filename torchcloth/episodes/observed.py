"""Recordings as the simulator takes them: a cloth with its boundaries, motion, frame times, what was seen and felt."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .._utils.linalg import EXACT, last_knot
from ..boundaries import Grasp, Plane
from ..boundaries.motion import interpolate
from ..cloth import Cloth
from ..dynamics.contact import Contact
from ..effects import AbstractEffect, AirDrag, Bending, Gravity
from ..errors import InvalidInput, RecordingError
from ..losses import Hits
from ..materials import AEP, AbstractMaterial
from ..meshes import Mesh, rectangle
from ..meshes.patches import Patch
from ..recordings import Camera, Recording
from ..recordings.scene import FRICTION, THICKNESS
from ..robots import closing, replay  # pyright: ignore[reportMissingImports] - mapped from robots/ at installation
from ..simulation.argument_checks import NAME, is_name
from ..types import Trajectory
from . import streams
from .pattern_interpolation import between, carried, with_patches

DEFAULT_STIFFNESS = 300.0  # N/m, a start in the middle of the published fabrics, where an episode names none
DEFAULT_POISSON = 0.2
SHEET_TRIANGLES = 288
RATE = 20.0  # Hz, of frames that nobody has seen
ELSEWHERE = 0.15  # of the cloth's diagonal, that what is seen first lies from it
SAME = 1e-6  # m, on the pattern: one place
FEW = 0.1  # force readings per frame, that may be left out without a word
FARTHEST = 0.2  # m, of a held patch from its gripper's origin at the first frame


@dataclass(frozen=True, eq=False)
class Episode:
    """One recording, as tensors.

    Attributes:
        name: how messages and pictures call it.
        motion: grippers' trajectories by name.
        times: [T] s, frame times on the motion's clock.
        clouds: T tensors [N_t, 3] m, empty where none was seen.
        initial: [V, 3] m, vertex positions at the first frame.
        settles: whether ``initial`` was measured, so that its noise is damped out before the first frame.
        noise: standard deviation of one point [m], or None when unknown.
        markers: [T, M, 3] m, material points, NaN where unseen; or None.
        places: where the markers are on the mesh.
        wrenches: gripper -> [T, 6] N, N m, what the cloth exerts on it about its origin: mean over the interval that
            ends at the frame, NaN where not measured.
        unseen: frames at the end that are simulated and not observed.
        eye: [3] m, where the camera stands; None where there is none, or more than one.
        dropped: frames after the motion's end, which are not simulated.
        unused: force readings after the last frame of what was seen, which are not simulated either.
        idle: grippers that close and hold nothing: the cloth has no grasp of their name.
    """

    name: str
    motion: Mapping[str, Trajectory]
    times: Tensor
    clouds: list[Tensor]
    initial: Tensor
    settles: bool
    noise: float | None
    markers: Tensor | None = None
    places: Hits | None = None
    wrenches: Mapping[str, Tensor] = field(default_factory=dict)
    unseen: int = 0
    eye: Tensor | None = None
    dropped: int = 0
    unused: int = 0
    idle: tuple[str, ...] = ()

    def identity(self) -> list[object]:
        """What simulations of it, and what is seen of them, depend on."""
        seen = [self.times, self.initial, self.settles, *self.clouds, self.markers, *(self.places or ()), self.noise]
        moved = [part for name, m in self.motion.items() for part in (name, m.t, m.pose, m.closed)]
        return [*seen, self.eye, *moved, *(part for pair in self.wrenches.items() for part in pair)]

    @property
    def observed(self) -> int:
        """Frames of which there may be data."""
        return len(self.times) - self.unseen

    @property
    def lookahead(self) -> float:
        """s, of frames that are simulated after the last observed one."""
        return float(self.times[-1] - self.times[self.observed - 1])

    def doubts(self) -> list[str]:
        """What a reader should know of it, in sentences."""
        out = []
        if self.dropped:
            out.append(
                f"{self.name}: {self.dropped} of {self.observed + self.dropped} frames come after the motion's end and "
                "were left out: record the motion as long, or check clock_offset"
            )
        if self.unused > FEW * self.observed:
            out.append(
                f"{self.name}: {self.unused} force readings come after the last frame that was seen and were left out: "
                "leave points and markers out of the recording to use forces alone"
            )
        if self.motion and not any(bool(m.closed.any()) for m in self.motion.values()):
            out.append(f"{self.name}: no gripper is ever closed: the cloth was simulated as let go")
        if self.idle:
            names = ", ".join(self.idle)
            out.append(f"{self.name}: no grasp is called {names}: the cloth was simulated as not held by it")
        if self._is_elsewhere():
            place = ", ".join(f"{1e3 * x:+.0f}" for x in (self.clouds[0].mean(0) - self.initial.mean(0)).tolist())
            out.append(
                f"{self.name}: what was seen first lies ({place}) mm from the cloth: check T_world_camera, the grasps' "
                "poses and initial_vertices"
            )
        return out

    def _is_elsewhere(self) -> bool:
        """Whether the points of the first frame are far from the cloth, most of them."""
        if not self.clouds or not len(self.clouds[0]):
            return False
        distance = torch.cdist(self.clouds[0], self.initial, compute_mode=EXACT).amin(1)
        return float(distance.median()) > ELSEWHERE * float((self.initial.amax(0) - self.initial.amin(0)).norm())

    def beyond(self, reach: float) -> Episode:
        """With frames after the last, for ``reach`` [s] or as long as the motion goes on: a late clock sees them."""
        step = float(self.times.diff().median())
        end = min((float(m.t[-1]) for m in self.motion.values()), default=torch.inf)
        last = min(float(self.times[-1]) + reach, end)
        more = torch.arange(1, 1 + int((last - float(self.times[-1])) / step + 1e-6), dtype=self.times.dtype)
        times = torch.cat([self.times, self.times[-1] + step * more])
        if last - float(times[-1]) > streams.SAME:
            times = torch.cat([times, times.new_tensor([last])])
        extra = len(times) - len(self.times)

        def padded(data: Tensor) -> Tensor:
            return torch.cat([data, data.new_full((extra, *data.shape[1:]), torch.nan)])

        return replace(
            self,
            times=times,
            clouds=[*self.clouds, *(self.initial.new_zeros(0, 3) for _ in range(extra))],
            markers=None if self.markers is None else padded(self.markers),
            wrenches={name: padded(wrench) for name, wrench in self.wrenches.items()},
            unseen=self.unseen + extra,
        )

    def unseen_after(self, end: float) -> Episode:
        """Without what was seen later than ``end`` [s]; what was felt stays."""
        late = self.times > end + streams.SAME
        markers = self.markers
        if markers is not None:
            markers = markers.where(~late[:, None, None], torch.nan)
        clouds = [c[:0] if gone else c for c, gone in zip(self.clouds, late.tolist(), strict=True)]
        return replace(self, clouds=clouds, markers=markers)

    def until(self, share: float) -> Episode:
        """The first ``share`` of the frames, at least four."""
        count = min(self.observed, max(4, round(share * self.observed)))
        return replace(
            self,
            times=self.times[:count],
            clouds=self.clouds[:count],
            markers=None if self.markers is None else self.markers[:count],
            wrenches={name: wrench[:count] for name, wrench in self.wrenches.items()},
            unseen=0,
        )

    def positions(self, frame: int) -> Tensor:
        """[N, 3] m, all that was seen of the cloth: its cloud; its markers where it has no cloud at all."""
        if self.markers is None or any(len(cloud) for cloud in self.clouds):
            return self.clouds[frame]
        seen = self.markers[frame]
        return seen[seen.isfinite().all(-1)]


def cloth_from(
    recording: Recording,
    material: AbstractMaterial | None = None,
    effects: Mapping[str, AbstractEffect] | None = None,
    contact: Contact | None = None,
) -> Cloth:
    """The cloth that an episode describes, with its grasps and colliders.

    Args:
        recording: names mesh or sheet, density, grasps, colliders, gravity, air.
        material: None: A-EP at the episode's nominal values, or at a start in the middle of published fabrics.
        effects: None: gravity; bending where the episode has a nominal value; air drag where it states a density.
        contact: between layers; None leaves it out.

    Raises:
        RecordingError: the episode has neither mesh nor sheet.
        InvalidInput: parts that do not fit each other.
    """
    mesh = mesh_of(recording)
    if effects is None:
        effects = effects_of(recording)
    if both := recording.colliders.keys() & recording.grasps.keys():
        raise InvalidInput(
            f"{recording.path}: names", got=f"a grasp and a collider {min(both)!r}", expected="a name for each"
        )
    for name in (*recording.colliders, *recording.grasps):
        if not is_name(name):
            raise RecordingError(
                f"{recording.path}: name of a grasp or collider",
                got=repr(name),
                expected=NAME,
                remedy="rename it in episode.json and motion.npz",
            )
    boundaries = {}
    for name, collider in recording.colliders.items():
        friction = FRICTION if collider.friction is None else collider.friction
        boundaries[name] = Plane(collider.point.tolist(), collider.normal.tolist(), friction)
    for name, grasp in recording.grasps.items():
        held = None if grasp.vertices is None else grasp.vertices.tolist()
        boundaries[name] = Grasp(held) if grasp.uv is None else Grasp(uv=grasp.uv, radius=grasp.radius)
    density = recording.cloth.areal_density
    return Cloth(mesh, material or material_of(recording), density, effects, boundaries, contact)


def mesh_of(recording: Recording) -> Mesh:
    """The episode's rest mesh, or its rectangular sheet, its vertices moved to where patches end that have a radius.

    Raises:
        RecordingError: neither is given.
    """
    mesh = _mesh_as_said(recording)
    patches = [Patch(np.atleast_2d(g.uv), g.radius) for g in recording.grasps.values() if g.uv is not None]
    return with_patches(mesh, patches)


def _mesh_as_said(recording: Recording) -> Mesh:
    cloth = recording.cloth
    if cloth.vertices is not None and cloth.faces is not None:
        return Mesh.build(cloth.vertices, cloth.faces, cloth.uv)
    if cloth.sheet is not None:
        return rectangle(*cloth.sheet, triangles=SHEET_TRIANGLES)
    raise RecordingError(
        f"{recording.path}: cloth", got="neither mesh nor sheet", expected="cloth.mesh or cloth.sheet in episode.json"
    )


def on_cpu(cloth: Cloth) -> None:
    """Episodes are read into memory that the fused engine works on.

    Raises:
        InvalidInput: the cloth is on another device.
    """
    if (device := cloth.areal_density.raw.device).type != "cpu":
        raise InvalidInput("cloth", got=f"on {device}", expected="a cloth on the CPU", remedy="cloth.cpu()")


def episode(cloth: Cloth, recording: Recording, rate: float | None = None) -> Episode:
    """Check a recording against a cloth and turn it into tensors of the cloth's dtype.

    Args:
        cloth: with a grasp for each gripper that holds it.
        recording: what was recorded.
        rate: Hz, of frames along the motion of one in which nothing was seen or felt; None refuses it.

    Raises:
        RecordingError: nothing was seen or felt, or no motion for one of the cloth's grasps.
        InvalidInput: initial vertices that do not belong to the cloth's mesh.
    """
    recording = streams.without_doubles(recording)
    name = recording.path.name if recording.path else "recording"
    dtype = cloth.state(torch.as_tensor(cloth.mesh.vertices)).x.dtype
    needed = [key for key, boundary in cloth.boundaries.items() if boundary.driven]
    motion = replay(recording, dtype, needed)
    missing = [key for key in needed if key not in motion]
    if missing:
        got = f"motion of {sorted({*recording.grippers, *recording.joints})}"
        raise RecordingError(f"{name}: no motion for grasp {missing[0]!r}", got=got)
    times, dropped = _frame_times(name, recording, motion, needed, rate)
    initial = first_shape(name, cloth, recording).to(dtype)
    _check_place(name, cloth, motion, initial, times[0])
    markers = streams.markers(recording, times, dtype)
    felt = streams.felt(recording, needed)
    return Episode(
        name=name,
        motion={key: motion[key] for key in needed},
        times=torch.as_tensor(times),
        clouds=streams.clouds(recording, times, dtype),
        initial=initial,
        settles=recording.cloth.initial_vertices is not None,
        noise=recording.observation_noise_std,
        markers=markers,
        places=None if markers is None else streams.on_pattern(cloth.mesh, recording.markers.uv),  # type: ignore
        wrenches=streams.wrenches(recording, needed, times, dtype),
        eye=_eye(recording, dtype),
        dropped=dropped,
        idle=tuple(key for key in closing(recording) if key not in needed),
        unused=int((felt > times[-1] + float(np.diff(times).max())).sum()),
    )


def _eye(recording: Recording, dtype: torch.dtype) -> Tensor | None:
    camera = eye_of(recording)
    return None if camera is None else torch.as_tensor(camera.T_world_camera[:3, 3], dtype=dtype)


def eye_of(recording: Recording) -> Camera | None:
    """The camera that sees how far away things are, where there is one: of several, the one with depth."""
    cameras = list(recording.cameras.values())
    deep = [c for c in cameras if c.depth is not None or c.depth_scale is not None]
    found = deep or cameras
    return found[0] if len(found) == 1 else None


def _frame_times(
    name: str, recording: Recording, motion: Mapping[str, Trajectory], needed: list[str], rate: float | None
) -> tuple[np.ndarray, int]:
    """(times, number of frames after the motion's end, left out) of points and markers, else of force readings.

    Where there are neither, all along the motion at ``rate`` [Hz].

    The first frame is the points' where there are points.
    """
    seen = [s.t + recording.clock_offset for s in (recording.points, recording.markers) if s is not None]
    if not seen:
        felt = streams.felt(recording, needed)
        begin = max((float(motion[key].t[0]) for key in needed), default=0.0)
        if not len(felt) and needed and rate is not None:
            span = min(float(motion[key].t[-1]) for key in needed) - begin
            if span < 1 / rate:
                got, expected = f"{max(span, 0):g} s of all grippers together", f"at least {1 / rate:g} s"
                raise RecordingError(f"{name}: motion", got=got, expected=expected, remedy="record all of it")
            return begin + np.arange(int(span * rate + 1e-6) + 1) / rate, 0
        if not len(felt):
            recording.require("points", by="a fit")
        return _overlap(felt[felt >= begin - streams.SAME], motion, needed)
    first = seen[0]
    if len(first) < 2:
        stream = "points" if recording.points is not None else "markers"
        raise RecordingError(f"{name}: {stream}", got=f"{len(first)} frame(s)", expected="at least two")
    times = streams.joined(seen)
    return _overlap(times[times >= first[0] - streams.SAME], motion, needed)


def first_shape(name: str, cloth: Cloth, recording: Recording) -> Tensor:
    """[V, 3] m, where the vertices are at the first frame.

    Where the cloth has the episode's triangles at other places of the pattern, positions are carried over to these.

    Raises:
        InvalidInput: they do not belong to the cloth's mesh.
    """
    initial = recording.cloth.initial_vertices
    if initial is not None and initial.ndim == 3 and cloth.mesh.uv is not None:
        initial = recording.cloth.initial_at(cloth.mesh.uv)
    vertices = cloth.mesh.vertices if initial is None else initial
    if vertices.shape != cloth.mesh.vertices.shape:
        raise InvalidInput(
            f"{name}: initial_vertices",
            got=f"{len(vertices)} rows",
            expected=f"{len(cloth.mesh.vertices)}, one per vertex",
            remedy="give the mesh that the initial vertices belong to",
        )
    return torch.as_tensor(vertices) if initial is None else on_mesh(cloth.mesh, recording, torch.as_tensor(initial))


def on_mesh(mesh: Mesh, recording: Recording, initial: Tensor) -> Tensor:
    """[V, 3] m, positions of the vertices of an episode's mesh, carried to a mesh with the same triangles elsewhere.

    Raises:
        InvalidInput: its vertices are at other places of the pattern and its triangles are others.
    """
    info = recording.cloth
    if info.vertices is None or info.faces is None or info.uv is None or mesh.uv is None:
        return initial
    if np.allclose(info.uv, mesh.uv, rtol=0, atol=SAME):
        return initial
    own, theirs = (np.unique(np.sort(faces, axis=1), axis=0) for faces in (mesh.faces, info.faces))
    if not np.array_equal(own, theirs):
        raise InvalidInput(
            "initial_vertices",
            got="those of a mesh with other triangles",
            expected="positions of the cloth's vertices, in its order",
            remedy="build the cloth from the episode (cloth_from), or give it the cloth's mesh",
        )
    return carried(between(Mesh.build(info.vertices, info.faces, info.uv), mesh.uv), initial.double())


def _check_place(name: str, cloth: Cloth, motion: Mapping[str, Trajectory], x: Tensor, start: float) -> None:
    """Refuse a cloth that is not where its grippers are: only their increments move it, so nothing else would show."""
    for key, boundary in cloth.boundaries.items():
        if isinstance(boundary, Grasp):
            knot = int(last_knot(motion[key].t.double(), torch.tensor([start + 1e-9], dtype=torch.float64)))
            if not motion[key].closed[max(knot, 0)]:  # it comes for the cloth later
                continue
            pose = interpolate(motion[key], torch.tensor([start], dtype=torch.float64))
            gap = float((x[boundary.index].mean(0) - pose[0, :3, 3]).norm())
            if gap > FARTHEST:
                raise InvalidInput(
                    f"{name}: grasp {key!r}",
                    got=f"the held patch {gap:.2f} m from its gripper at the first frame",
                    expected=f"within {FARTHEST:g} m",
                    remedy="give cloth.initial_vertices in world coordinates, or check the gripper's path and frame",
                )


def _number(nominal: Mapping[str, Any], key: str, default: float) -> float:
    """A data-sheet value; refuses what is not a number."""
    try:
        return float(nominal.get(key, default))
    except (TypeError, ValueError):
        raise RecordingError(f"cloth.nominal.{key}", got=repr(nominal[key]), expected="a number in SI units") from None


def _overlap(times: np.ndarray, motion: Mapping[str, Trajectory], needed: list[str]) -> tuple[np.ndarray, int]:
    """(those that the motion covers, number of others); it must cover the first, where the cloth is known."""
    start = max((float(motion[key].t[0]) for key in needed), default=-np.inf)
    end = min((float(motion[key].t[-1]) for key in needed), default=np.inf)
    inside = np.flatnonzero((times >= start - 1e-6) & (times <= end + 1e-6))
    if len(inside) < 2 or inside[0] != 0:
        seen = f"frames in [{times[0]:g}, {times[-1]:g}] s" if len(times) else "no frames"
        raise RecordingError(
            "points and motion",
            got=f"{seen}, motion in [{start:g}, {end:g}] s",
            expected="motion that covers the first frame",
            remedy="check clock_offset",
        )
    return times[inside], len(times) - len(inside)


def effects_of(recording: Recording) -> dict[str, AbstractEffect]:
    """Weight; bending at its data-sheet value, if there is one; drag of a flat plate, if there is air."""
    effects: dict[str, AbstractEffect] = {"gravity": Gravity(recording.gravity.tolist())}
    nominal = recording.cloth.nominal
    if "bending_stiffness" in nominal:
        damping = _number(nominal, "bending_damping_time", 0.0) or None  # nothing to learn where none is stated
        effects["bending"] = Bending(_number(nominal, "bending_stiffness", 0.0), damping)
    if recording.air_density is not None:
        effects["air"] = AirDrag(normal=AirDrag.amplitudes["normal"].typical, density=recording.air_density)
    return effects


def material_of(recording: Recording) -> AEP:
    """At the episode's nominal values, or at a start in the middle of published fabrics."""
    nominal, h = recording.cloth.nominal, recording.cloth.thickness or THICKNESS
    stiffness = _number(nominal, "membrane_stiffness", DEFAULT_STIFFNESS)
    youngs = _number(nominal, "youngs_modulus", stiffness / h)
    return AEP(youngs, _number(nominal, "poisson_ratio", DEFAULT_POISSON), thickness=h)
