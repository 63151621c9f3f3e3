"""An episode from the files of a bench; what no file states is estimated or guessed, and said."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ..episodes.recorded_cloth import DEFAULT_MEMBRANE_STIFFNESS_N_PER_M, DEFAULT_POISSON_RATIO, build_cloth
from ..errors import InvalidInput
from ..inspection.camera_from_arm import describe_pose_errors, find_camera_pose_from_arms
from ..meshes.mesh import MAX_AREAL_DENSITY_KG_PER_M2
from ..pose import PoseEstimator, estimate_first_shape
from ..recordings import ClothInfo, JointMotion, Recording, RobotInfo, write
from ..recordings.checks import MAX_SCENE_EXTENT_M
from ..recordings.formats.imported import to_seconds
from ..recordings.formats.joint_log import AngleUnit
from ..recordings.formats.tables import TimeUnit
from ..recordings.scene import DEFAULT_THICKNESS_M
from ..robots.paths import GripperPath, holding_paths  # pyright: ignore[reportMissingImports] - mapped from robots/
from . import clock
from .bench_files import ArmFiles, BenchArm, BenchCamera, CameraFiles, depth_stream, load_depth, read_arms, read_camera
from .cut_cloth import ClothCutter, farthest_corner
from .first_shape import SheetGrip, lay_first_shape, make_grip
from .new_episode_figure import draw

CAMERA_NAME = "cam0"
PICTURE_FILE = "new.png"  # in the episode's folder
PICTURE_DPI = 110
DEFAULT_GRIP_RADIUS_M = 0.012  # of pads of 24 mm
GUESSED_AREAL_DENSITY_KG_PER_M2, GUESSED_AREAL_DENSITY_STD_KG_PER_M2 = 0.2, 0.1  # of a sheet that nobody weighed
START_BENDING_STIFFNESS_N_M = 5e-5  # stiffer than most: softer sheets ripple, and a search loses its way
SCALE_STD_KG = 1e-3  # of a kitchen scale
WEIGHED_STD_FRACTION = 0.02  # of a ruler, and of what hangs of a cut edge
ROOM_AIR_DENSITY_KG_PER_M3 = 1.204  # at 20 degrees Celsius
MOTION_MARGIN_S = 1.0  # of the joints before the first and after the last image
MAX_SILENT_DURATION_S = 10.0  # a fit of a longer episode is slow, and light cloth is chaotic
MAX_SPEED_AT_REST_M_PER_S = 0.02  # of a gripper at the first image
SPEED_INTERVAL_S = 0.05
MIN_COMMON_FRACTION = 0.5  # of the images, during which joints on the same clock were recorded


@dataclass(frozen=True, eq=False)
class NewEpisode:
    """An episode that was put together from files.

    Attributes:
        recording: not yet written.
        notes: what was guessed or estimated, in sentences.
        picture: PNG file of the first image with arm and cloth, and of the sheet with what holds it.
    """

    recording: Recording
    notes: list[str]
    picture: bytes = field(repr=False)

    def write(
        self, folder: str | Path, *, overwrite: bool = False, on_image: Callable[[], None] = lambda: None
    ) -> Path:
        """Write the episode atomically, with its picture as new.png.

        Raises:
            RecordingError: the folder exists, or the recording would be refused by a reader.
        """
        files = {PICTURE_FILE: self.picture}
        return write(self.recording, folder, overwrite=overwrite, on_image=on_image, attachments=files)


def new_episode(
    arms: Sequence[ArmFiles],
    camera: CameraFiles,
    sheet: tuple[float, float],
    *,
    mass: float | None = None,
    grip_radius: float | None = None,
    angle_unit: AngleUnit | None = None,
    time_unit: TimeUnit | None = None,
    network: PoseEstimator | None = None,
    motion: str | None = None,
    provenance: str = "measured",
    on_images: Callable[[int], Callable[[], None]] = lambda count: lambda: None,
) -> NewEpisode:
    """Put an episode together from joint angles, depth images and a calibration.

    Args:
        arms: one or several, each with the place of the sheet that it holds.
        camera: that sees the sheet.
        sheet: (width, height) m, along the pattern's u and v.
        mass: kg, of the sheet; None: 0.2 ± 0.1 kg/m^2.
        grip_radius: m, material that a gripper holds around its place, or a bar below its edge; None: 12 mm.
        angle_unit: of the joints; None: as a header says, or guessed.
        time_unit: of all times; None: as headers say, or guessed from the intervals.
        network: estimates the first shape; None: the sheet is laid onto the first cloud.
        motion: name of the motion, which episodes that repeat it share.
        provenance: "measured", or "synthetic: GENERATOR".
        on_images: called with the number of images; returns what is called after each one.

    Raises:
        TorchclothError: a file cannot be used, or the files do not fit each other.
    """
    if not (np.shape(sheet) == (2,) and np.isfinite(sheet).all() and min(sheet) > 0):
        raise InvalidInput("sheet", got=sheet, expected="width and height > 0 in m")
    if max(sheet) > MAX_SCENE_EXTENT_M:
        expected = f"width and height in m, at most {MAX_SCENE_EXTENT_M:g}"
        raise InvalidInput("sheet", got=sheet, expected=expected, remedy="convert mm or cm to m")
    radius = DEFAULT_GRIP_RADIUS_M if grip_radius is None else grip_radius
    bench, notes = read_arms(arms, angle_unit, time_unit)
    grips = {n: make_grip(sheet, one.files.grip, one.files.is_bar, radius) for n, one in bench.items()}
    notes += [f"{name}: holds {_describe_hold(one.files)}" for name, one in bench.items()]
    seen, camera_notes = read_camera(camera, time_unit)
    cloth, cloth_notes = _describe_cloth(sheet, mass, radius if grip_radius is None else None)
    recording, is_one_clock = _assemble(bench, seen, cloth, grips)
    recording = replace(recording, split={} if motion is None else {"motion": motion}, provenance=provenance)
    notes += camera_notes
    if camera.pose is None:
        recording, pose_note = _find_camera_pose(recording, is_one_clock)
        notes.append(pose_note)
    reach = {name: farthest_corner(sheet, grip.place) for name, grip in grips.items()}
    recording, paths, view_notes = _set_camera_and_clock(recording, reach, is_one_clock)
    cutter = ClothCutter(recording, {name: one.arm for name, one in bench.items()}, reach)
    recording = replace(recording, colliders=cutter.find_table())
    points = cutter.cut(on_images(len(cutter.times)))
    recording, first_time = replace(recording, points=points), float(points.t[0])
    solids, places = cutter.bodies_at(first_time)
    recording, shape_note = _set_first_shape(recording, list(grips.values()), places, network)
    notes += [*view_notes, *cutter.notes, shape_note, *_describe_start(recording, paths, first_time), *cloth_notes]
    recording = replace(recording, extra={"source": {"format": "bench files", "notes": notes}})
    picture = io.BytesIO()
    figure = draw(
        recording, load_depth(cutter.camera, int(np.searchsorted(cutter.times, first_time))), cutter.arms, solids, notes
    )
    figure.savefig(picture, dpi=PICTURE_DPI, bbox_inches="tight")
    return NewEpisode(recording, notes, picture.getvalue())


def _describe_hold(files: ArmFiles) -> str:
    u, v = files.grip
    if files.is_bar:
        return f"the whole edge at ({u:g}, {v:g}) m of the sheet, on a bar"
    return f"the sheet at ({u:g}, {v:g}) m alone (a bar along an edge: --bar)"


def _describe_cloth(
    sheet: tuple[float, float], mass: float | None, guessed_radius: float | None
) -> tuple[ClothInfo, list[str]]:
    """Return the sheet with a start of the fit, and notes on what nobody measured."""
    density, std, notes = GUESSED_AREAL_DENSITY_KG_PER_M2, GUESSED_AREAL_DENSITY_STD_KG_PER_M2, []
    if mass is not None:
        if not (np.isfinite(mass) and mass > 0):
            raise InvalidInput("mass", got=mass, expected="a number > 0 in kg")
        density = mass / (sheet[0] * sheet[1])
        if density > MAX_AREAL_DENSITY_KG_PER_M2:
            got = f"{mass:g} kg, which is {density:.3g} kg/m^2"
            raise InvalidInput(
                "mass", got=got, expected=f"at most {MAX_AREAL_DENSITY_KG_PER_M2:g} kg/m^2", remedy="convert g to kg"
            )
        std = density * float(np.hypot(WEIGHED_STD_FRACTION, SCALE_STD_KG / mass))
        notes.append(f"areal density: {density:.3g} ± {std:.2g} kg/m^2, from the mass on a scale of 1 g")
    else:
        notes.append(
            f"areal density: {density:g} ± {std:g} kg/m^2, a guess; weigh the sheet and give --mass, as every "
            "stiffness is in proportion to it"
        )
    if guessed_radius is not None:
        notes.append(f"grip: {1e3 * guessed_radius:.0f} mm around its place (else give --grip-radius)")
    nominal = {
        "membrane_stiffness": DEFAULT_MEMBRANE_STIFFNESS_N_PER_M,
        "poisson_ratio": DEFAULT_POISSON_RATIO,
        "bending_stiffness": START_BENDING_STIFFNESS_N_M,
    }
    notes.append(
        f"start of a fit: membrane {DEFAULT_MEMBRANE_STIFFNESS_N_PER_M:g} N/m, bending "
        f"{START_BENDING_STIFFNESS_N_M:g} N m, thickness "
        f"{1e3 * DEFAULT_THICKNESS_M:g} mm, air of {ROOM_AIR_DENSITY_KG_PER_M3:g} kg/m^3"
    )
    info = ClothInfo(
        areal_density=density, areal_density_std=std, thickness=DEFAULT_THICKNESS_M, sheet=sheet, nominal=nominal
    )
    return info, notes


def _assemble(
    bench: dict[str, BenchArm], seen: BenchCamera, cloth: ClothInfo, grips: dict[str, SheetGrip]
) -> tuple[Recording, bool]:
    """Return the recording without points, and whether joints and images are on one clock."""
    start = max(int(one.log.ns[0]) for one in bench.values())
    end = min(int(one.log.ns[-1]) for one in bench.values())
    if start >= end:
        got, remedy = "logs of joints without a common time", "record all arms on one clock"
        raise InvalidInput("joints", got=got, remedy=remedy)
    is_one_clock = bool(((seen.ns >= start) & (seen.ns <= end)).mean() >= MIN_COMMON_FRACTION)
    origin = int(seen.ns[0]) if is_one_clock else start
    joints = {}
    for name, one in bench.items():
        closed = np.ones(len(one.log.ns), dtype=bool) if one.log.closed is None else one.log.closed
        joints[name] = JointMotion(to_seconds(one.log.ns, origin), one.log.q, closed)
    recording = Recording(
        cloth=cloth,
        provenance="measured",
        grasps={name: grip.grasp for name, grip in grips.items()},
        joints=joints,
        robots={n: RobotInfo(one.arm.model, one.arm.base.numpy(), one.arm.frame) for n, one in bench.items()},
        cameras={CAMERA_NAME: seen.camera},
        air_density=ROOM_AIR_DENSITY_KG_PER_M3,
    )
    return recording, is_one_clock


def _find_camera_pose(recording: Recording, is_one_clock: bool) -> tuple[Recording, str]:
    """Return the recording with the camera's pose from the arms in its view, and a note on its error."""
    remedy = "give --camera-pose"
    if not is_one_clock:
        got = "no pose, and images on another clock than the joints"
        raise InvalidInput("camera", got=got, expected="images at known postures, which show the pose", remedy=remedy)
    pose = find_camera_pose_from_arms(recording, CAMERA_NAME)
    if not pose.is_determined:
        raise InvalidInput(
            "camera", got="no pose, and images that do not show it", expected="the arm in view", remedy=remedy
        )
    camera = replace(recording.cameras[CAMERA_NAME], T_world_camera=pose.T_world_camera)
    note = f"camera: {describe_pose_errors(pose)} (else {remedy})"
    return replace(recording, cameras={CAMERA_NAME: camera}), note


def _set_camera_and_clock(
    recording: Recording, reach: dict[str, float], is_one_clock: bool
) -> tuple[Recording, dict[str, GripperPath], list[str]]:
    """Check the camera's pose, set the clock of the images, and leave out images and joints that no image needs."""
    paths = holding_paths(recording)
    low = np.min([path.position.min(0) - reach[name] for name, path in paths.items()], axis=0)
    high = np.max([path.position.max(0) + reach[name] for name, path in paths.items()], axis=0)
    camera, view, notes = clock.check_camera_pose(recording.cameras[CAMERA_NAME], paths, low, high)
    recording, clock_notes = clock.set_clock(
        replace(recording, cameras={CAMERA_NAME: camera}), paths, view, is_one_clock
    )
    depth = depth_stream(camera)
    t = depth.t + recording.clock_offset
    start, end = max(path.t[0] for path in paths.values()), min(path.t[-1] for path in paths.values())
    use = (t >= start) & (t <= end)
    if use.sum() < 2:
        got = f"{int(use.sum())} of {len(t)} images"
        raise InvalidInput("joints", got=f"a log that covers {got}", expected="one that covers the images")
    notes += clock_notes
    if not use.all():
        notes.append(f"images: {int((~use).sum())} of {len(t)} come before or after the joints and are left out")
        paths_used = tuple(path for path, is_used in zip(depth.paths, use, strict=True) if is_used)
        depth = replace(depth, frames=np.arange(int(use.sum())), t=depth.t[use], paths=paths_used)
    if depth.t[-1] - depth.t[0] > MAX_SILENT_DURATION_S:
        span = f"{depth.t[-1] - depth.t[0]:.0f} s"
        notes.append(f"episode: {span} long, and a fit needs one motion of 1 to 3 s: choose it by --span")
    first, last = t[use][0] - MOTION_MARGIN_S, t[use][-1] + MOTION_MARGIN_S
    joints = {name: _select_knots(motion, first, last) for name, motion in recording.joints.items()}
    recording = replace(recording, joints=joints, cameras={CAMERA_NAME: replace(camera, depth=depth)})
    return recording, holding_paths(recording), notes


def _select_knots(motion: JointMotion, first: float, last: float) -> JointMotion:
    use = (motion.t >= first) & (motion.t <= last)
    return JointMotion(motion.t[use], motion.q[use], None if motion.closed is None else motion.closed[use])


def _set_first_shape(
    recording: Recording, grips: list[SheetGrip], places: np.ndarray, network: PoseEstimator | None
) -> tuple[Recording, str]:
    if network is None:
        return lay_first_shape(recording, grips, places)
    shape = estimate_first_shape(build_cloth(recording), recording, network)
    return shape.apply(recording), f"first shape: by the network, standard error {1e3 * shape.std_rms:.0f} mm"


def _describe_start(recording: Recording, paths: dict[str, GripperPath], time: float) -> list[str]:
    """Return a note on a gripper that moves at the first cloud, where the cloth is taken to be at rest."""
    if recording.cloth.initial_velocities is not None:
        return []
    now = time + recording.clock_offset + np.array([-SPEED_INTERVAL_S, SPEED_INTERVAL_S])
    speed = max(float(np.linalg.norm(np.diff(path.at(now)[0], axis=0))) for path in paths.values())
    speed /= 2 * SPEED_INTERVAL_S
    if speed <= MAX_SPEED_AT_REST_M_PER_S:
        return ["first image: the cloth hangs at rest, as the grippers do"]
    return [
        f"first image: the cloth is taken to be at rest, but a gripper moves at {speed:.2f} m/s: begin earlier "
        "(--span), or give the first shape and its velocities by --network"
    ]
