"""Twin of the paper's fabric experiment: one clamp pulls a sheet away from another under a depth camera.

Truth and model obey the same law, because no other engine has all parameters of A-EP. They differ in mesh, step, first
shape and assumed density. The data have the errors of sensors.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch

import torchcloth as tc
from torchcloth import recordings as rec
from torchcloth._utils.constants import STANDARD_AIR_DENSITY_KG_PER_M3
from torchcloth.identification import build_cloth
from torchcloth.observe import DepthCamera, DepthNoise, View, capture, look_at
from torchcloth.robots import replay  # pyright: ignore[reportMissingImports] - mapped from robots/ at installation
from torchcloth.types import Rollout

from .synthetic_sheets import interpolate_on_grid, simulate_readings

CLOTH_SIZE_M = np.array([0.30, 0.20])  # along x and y
THICKNESS_M = 1e-3  # of the presets
CLAMP_POINT_RADIUS_M = 1e-3  # around each point of a clamp
INITIAL_STRAIN = 0.01
INITIAL_STRAIN_OBLIQUE = 0.03  # at 45 degrees a sheet with less strain buckles
MAX_PULL_STRAIN = 0.08
MAX_PULL_FORCE_N = 40.0  # of an arm with 4 kg payload
PULL_TIME_S = 0.25
CAMERA_RATE_HZ, FORCE_RATE_HZ = 30.0, 120.0
FORCE_NOISE_N = 0.05  # white, standard deviation of a reading
WEIGHING_ERROR = 0.01  # relative standard deviation
FREE_VERTEX_ERROR_M, CLAMP_ERROR_M = 0.2e-3, 0.5e-3  # standard deviations in the first shape
CAMERA_HEIGHT_M, CAMERA_OFFSET_M = 0.60, 0.05  # above the sheet, and from its middle
BAR_WIDTH_FRACTION, BAR_CENTRE_FRACTION = 0.30, 0.62  # of the sheet's length, hidden by a bar
BAR_HEIGHT_M = 0.05  # above the sheet
POINTS_PER_CLOUD = 250
MARKER_GRID = (21, 15)  # printed on the sheet
BENDING_STIFFNESS_NM, SHEET_DAMPING_TIME_S, PLATE_DRAG_COEFFICIENT = 1e-5, 5e-3, 1.2  # known to the model


class Fabric(NamedTuple):
    """Parameters of a sheet.

    Attributes:
        membrane: Young's modulus times thickness [N/m].
        poisson: Poisson's ratio.
        density: [kg/m^2].
    """

    membrane: float
    poisson: float
    density: float


class Pull(NamedTuple):
    """A trial.

    Attributes:
        direction: of the pull: "x", "y", or "45" for both at once with the clamps along y.
        clamps: positions as fractions of the cloth's length, over the whole width; cloth beyond is rolled up in them.
    """

    direction: str
    clamps: tuple[float, float] = (0.0, 1.0)

    @property
    def axis(self) -> int:
        """Axis of the cloth along which the clamps are opposite."""
        return int(self.direction == "y")

    @property
    def size(self) -> np.ndarray:
        """Size of the cloth between the clamps, [2] m."""
        size = CLOTH_SIZE_M.copy()
        size[self.axis] *= self.clamps[1] - self.clamps[0]
        return size

    @property
    def way(self) -> np.ndarray:
        """Direction of the pull, unit vector [3]."""
        return {"x": np.eye(3)[0], "y": np.eye(3)[1], "45": np.array([1.0, 1.0, 0.0]) / 2**0.5}[self.direction]

    @property
    def taut(self) -> float:
        """Strain at the first frame."""
        return INITIAL_STRAIN_OBLIQUE if self.direction == "45" else INITIAL_STRAIN


class Detail(NamedTuple):
    """Resolution of a twin.

    Attributes:
        cell: edge length of the model's mesh [m]; those of the truth are less than half and do not match it.
        frames: number of frames.
        points: of a cloud.
    """

    cell: float = 0.025
    frames: int = 13
    points: int = POINTS_PER_CLOUD

    def model(self, pull: Pull) -> tuple[int, int]:
        """Return the number of vertices of the model along x and y."""
        across, up = (max(2, round(float(length) / self.cell)) for length in pull.size)
        return across + 1, up + 1

    def truth(self, pull: Pull) -> tuple[int, int]:
        """Return the number of vertices of the truth along x and y."""
        across, up = self.model(pull)
        return 2 * across, 2 * up


def pull_strain(fabric: Fabric, pull: Pull) -> float:
    """Return the strain of the pull, limited by ``MAX_PULL_STRAIN`` and ``MAX_PULL_FORCE_N``."""
    return min(MAX_PULL_STRAIN, MAX_PULL_FORCE_N / (fabric.membrane * float(pull.size[1 - pull.axis])))


def record_trial(fabric: Fabric, pull: Pull, seed: int, detail: Detail) -> rec.Recording:
    """Simulate a trial: clouds, markers, forces, a first shape on the model's mesh, and a weighed density."""
    rng = np.random.default_rng(seed)
    frames = np.arange(detail.frames) / CAMERA_RATE_HZ
    without_data = rec.Recording(
        cloth=_info(fabric.density, pull, detail.truth(pull)),
        provenance="synthetic: torchcloth, the same law on another mesh, with another step",
        grasps=_grasps(pull),
        grippers=_motion(pull, pull_strain(fabric, pull), frames[-1]),
        air_density=STANDARD_AIR_DENSITY_KG_PER_M3,
    )
    out = _simulate(build_sheet(without_data, fabric), without_data, frames, pull)
    x = out.x[np.searchsorted(out.t.numpy(), frames)].numpy()
    weighed = fabric.density * (1 + WEIGHING_ERROR * rng.standard_normal())
    first = _first_shape(x[0], pull, detail, rng)
    points, markers, sigma = _observe(x, frames, pull, detail, rng)
    grippers = {
        name: rec.GripperMotion(
            m.t, m.position, m.quat_wxyz, m.closed, simulate_readings(out, name, m.t, FORCE_NOISE_N, rng)
        )
        for name, m in without_data.grippers.items()
    }
    return rec.Recording(
        cloth=_info(weighed, pull, detail.model(pull), first),
        provenance=without_data.provenance,
        grasps=without_data.grasps,
        grippers=grippers,
        points=points,
        markers=markers,
        observation_noise_std=sigma,
        air_density=STANDARD_AIR_DENSITY_KG_PER_M3,
    )


def build_sheet(
    recording: rec.Recording,
    fabric: Fabric,
    contact: tc.Contact | None = None,
    contact_stiffness: float = 1e6,
    shear_stiffness: float = 2.5e5,
) -> tc.Cloth:
    """Build the recording's cloth from a fabric, with the recording's density; k and gamma [Pa] need contact."""
    effects = {
        "gravity": tc.effects.Gravity(),
        "bending": tc.effects.Bending(BENDING_STIFFNESS_NM, SHEET_DAMPING_TIME_S),
        "air": tc.effects.AirDrag(PLATE_DRAG_COEFFICIENT),
    }
    material = tc.materials.AEP(
        fabric.membrane / THICKNESS_M,
        fabric.poisson,
        contact_stiffness=contact_stiffness,
        shear_stiffness=shear_stiffness,
        thickness=THICKNESS_M,
    )
    return build_cloth(recording, material, effects, contact)


def _info(density: float, pull: Pull, resolution: tuple[int, int], first: np.ndarray | None = None) -> rec.ClothInfo:
    mesh = tc.meshes.rectangle(*pull.size, resolution=resolution)
    return rec.ClothInfo(
        areal_density=density,
        thickness=THICKNESS_M,
        vertices=mesh.vertices,
        faces=mesh.faces,
        uv=mesh.uv,
        initial_vertices=first,
    )


def _grasps(pull: Pull) -> dict[str, rec.GraspInfo]:
    """Return the two clamps as pattern points that are denser than any mesh."""
    out = {}
    for name, place in (("still", 0.0), ("moving", 1.0)):
        share = np.full((601, 2), place)
        share[:, 1 - pull.axis] = np.linspace(0.0, 1.0, 601)
        out[name] = rec.GraspInfo(share * pull.size, CLAMP_POINT_RADIUS_M)
    return out


def _motion(pull: Pull, end_strain: float, duration: float) -> dict[str, rec.GripperMotion]:
    """Return the clamps' motion: taut at first, then pulled and held."""
    t = np.arange(0.0, duration + 1.5 / FORCE_RATE_HZ, 1 / FORCE_RATE_HZ)
    rise = 0.5 * (1 - np.cos(np.pi * np.clip(t / PULL_TIME_S, 0, 1)))[:, None]
    length = pull.size[pull.axis]
    still = np.zeros((len(t), 3))
    still[:, 1 - pull.axis] = 0.5 * pull.size[1 - pull.axis]
    moving = (
        still + (1 + pull.taut) * length * np.eye(3)[pull.axis] + (end_strain - pull.taut) * length * rise * pull.way
    )
    facing, closed = np.tile([1.0, 0, 0, 0], (len(t), 1)), np.ones(len(t), bool)
    return {name: rec.GripperMotion(t, x, facing, closed) for name, x in (("still", still), ("moving", moving))}


@torch.no_grad()
def _simulate(truth: tc.Cloth, recording: rec.Recording, frames: np.ndarray, pull: Pull) -> Rollout:
    """Simulate from the taut sheet at rest, with another step than the model."""
    moves = replay(recording)
    x = torch.as_tensor(truth.mesh.vertices).clone()
    x[:, pull.axis] *= 1 + pull.taut
    state = truth.settle(truth.state(x), moves, duration=0.4)
    knots = recording.grippers["moving"].t
    times = np.union1d(knots[knots <= frames[-1] + 1.2 / FORCE_RATE_HZ], frames)
    return truth(state, moves, times.tolist(), dt=0.6 * truth.stable_step())


def _first_shape(x: np.ndarray, pull: Pull, detail: Detail, rng: np.random.Generator) -> np.ndarray:
    """Return the first shape [V, 3] m on the model's mesh, with a smooth error and a small one of each free vertex."""
    share = np.asarray(tc.meshes.rectangle(1.0, 1.0, resolution=detail.model(pull)).uv)
    along = share[:, pull.axis, None]
    start, end = CLAMP_ERROR_M * rng.standard_normal((2, 3))
    free = (along > 1e-6) & (along < 1 - 1e-6)
    error = (1 - along) * start + along * end + FREE_VERTEX_ERROR_M * free * rng.standard_normal((len(share), 3))
    return interpolate_on_grid(x, detail.truth(pull), share) + error


def _observe(
    x: np.ndarray, frames: np.ndarray, pull: Pull, detail: Detail, rng: np.random.Generator
) -> tuple[rec.PointClouds, rec.Markers, float]:
    """Return clouds, markers and the depth's standard deviation [m] of a Kinect above, with a bar in its view."""
    resolution, noise = detail.truth(pull), DepthNoise()
    middle, depth = x[0].mean(0), float(noise.sigma(np.array(CAMERA_HEIGHT_M)))
    eye = middle + np.array([0.0, -CAMERA_OFFSET_M, CAMERA_HEIGHT_M])
    camera = DepthCamera.azure_kinect_nfov(look_at(eye, middle, up=np.array([0.0, 1.0, 0.0])))
    view, faces = (
        View(camera, noise, max_points=detail.points),
        tc.meshes.rectangle(1.0, 1.0, resolution=resolution).faces,
    )
    bar = _bar(x[0], eye)
    clouds = [capture(view, frame, faces, [bar], rng=rng).points for frame in x]
    u, v = np.meshgrid(*((np.arange(n) + 0.5) / n for n in MARKER_GRID), indexing="ij")
    share = np.stack([u.ravel(), v.ravel()], axis=1)
    xyz = np.stack([interpolate_on_grid(frame, resolution, share) for frame in x])
    hidden = _behind(xyz, eye, bar[0])
    lateral = noise.jitter * CAMERA_HEIGHT_M / camera.K[0, 0]
    xyz += rng.standard_normal(xyz.shape) * [lateral, lateral, depth]
    xyz[hidden] = np.nan
    points = rec.PointClouds(frames, np.concatenate(clouds), np.array([len(c) for c in clouds]))
    return points, rec.Markers(frames, xyz, share * pull.size), depth


def _bar(x: np.ndarray, eye: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return corners [4, 3] m and triangles of a flat bar that hides ``BAR_WIDTH_FRACTION`` of the sheet's length."""
    low, high = x.min(0), x.max(0)
    ends = low[0] + (BAR_CENTRE_FRACTION + BAR_WIDTH_FRACTION * np.array([-0.5, 0.5])) * (high - low)[0]
    far = np.array([2 * low[1] - high[1], 2 * high[1] - low[1]])
    shadow = np.array([[ends[i], far[j], x[:, 2].mean()] for i, j in ((0, 0), (1, 0), (1, 1), (0, 1))])
    return shadow + (eye - shadow) * (BAR_HEIGHT_M / CAMERA_HEIGHT_M), np.array([[0, 1, 2], [0, 2, 3]])


def _behind(xyz: np.ndarray, eye: np.ndarray, bar: np.ndarray) -> np.ndarray:
    """Return [...] bool, whether the bar hides a point from the eye."""
    ray = xyz - eye
    crossing = (eye + ray * ((bar[0, 2] - eye[2]) / ray[..., 2:]))[..., :2]
    return ((crossing > bar[:, :2].min(0)) & (crossing < bar[:, :2].max(0))).all(-1)
