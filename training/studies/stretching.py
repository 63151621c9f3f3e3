"""A sheet that one clamp pulls away from another under a depth camera: the paper's fabric experiment, as twins.

Truth and model obey the same law (no other engine has all of A-EP's parameters). Between them differ the mesh, the
step, the first shape, the density that is taken for known, and all that sensors do.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch

import torchcloth as tc
from torchcloth import recordings as rec
from torchcloth.identification import build_cloth
from torchcloth.observe import DepthCamera, DepthNoise, View, capture, look_at
from torchcloth.robots import replay  # pyright: ignore[reportMissingImports] - mapped from robots/ at installation
from torchcloth.types import Rollout

from .synthetic_sheets import on_grid, readings

CLOTH = np.array([0.30, 0.20])  # m, along x and y
THICKNESS = 1e-3  # m, of the presets
RADIUS = 1e-3  # m, around each point of a clamp
TAUT, TAUT_OBLIQUE = 0.01, 0.03  # strain at the first frame; a sheet that is pulled askew buckles unless it is taut
STRAIN, STRONGEST = 0.08, 40.0  # pulled so far, or by so many newtons: what an arm with 4 kg of payload can hold
RISE = 0.25  # s, then it is held
RATE, KNOTS = 30.0, 120.0  # 1/s, of the camera and of the force sensors
FORCE_NOISE = 0.05  # N, white, of each reading
DENSITY_ERROR = 0.01  # of the weighing
FREE_ERROR, HELD_ERROR = 0.2e-3, 0.5e-3  # m, of the first shape at each free vertex, and of each clamp's place
EYE, SIDEWAYS = 0.60, 0.05  # m, of the camera above the sheet, and beside its middle
BAR, BAR_MIDDLE, BAR_HEIGHT = 0.30, 0.62, 0.05  # what hides the sheet: share of its length, where; m above it
POINTS = 250  # of a cloud
MARKERS = (21, 15)  # printed on the sheet
BENDING, BENDING_TIME, DRAG, AIR = 1e-5, 5e-3, 1.2, 1.204  # N m, s, C_n, kg/m^3; known


class Fabric(NamedTuple):
    """SI units; ``membrane`` is Young's modulus times thickness."""

    membrane: float  # N/m
    poisson: float
    density: float  # kg/m^2


class Pull(NamedTuple):
    """One trial.

    Attributes:
        direction: of the pull: "x" or "y"; or "45", both at once, with the clamps along y.
        clamps: where they bite, over the whole width, as shares of the cloth's length; what lies beyond is rolled up
            in them.
    """

    direction: str
    clamps: tuple[float, float] = (0.0, 1.0)

    @property
    def axis(self) -> int:
        """Of the cloth, along which the clamps lie opposite each other."""
        return int(self.direction == "y")

    @property
    def size(self) -> np.ndarray:
        """[2] m, of the cloth between the clamps."""
        size = CLOTH.copy()
        size[self.axis] *= self.clamps[1] - self.clamps[0]
        return size

    @property
    def way(self) -> np.ndarray:
        """[3] unit vector."""
        return {"x": np.eye(3)[0], "y": np.eye(3)[1], "45": np.array([1.0, 1.0, 0.0]) / 2**0.5}[self.direction]

    @property
    def taut(self) -> float:
        """Strain at the first frame."""
        return TAUT_OBLIQUE if self.direction == "45" else TAUT


class Detail(NamedTuple):
    """How finely a twin is made."""

    cell: float = 0.025  # m, of the model's mesh; the truth's are less than half of it, and do not fit into it
    frames: int = 13
    points: int = POINTS

    def model(self, pull: Pull) -> tuple[int, int]:
        """Vertices along x and y."""
        across, up = (max(2, round(float(length) / self.cell)) for length in pull.size)
        return across + 1, up + 1

    def truth(self, pull: Pull) -> tuple[int, int]:
        """Vertices along x and y."""
        across, up = self.model(pull)
        return 2 * across, 2 * up


def strain(fabric: Fabric, pull: Pull) -> float:
    """How far it is pulled, as a share of its length."""
    return min(STRAIN, STRONGEST / (fabric.membrane * float(pull.size[1 - pull.axis])))


def record(fabric: Fabric, pull: Pull, seed: int, detail: Detail) -> rec.Recording:
    """One trial as a recording: clouds, markers, forces, a first shape on the model's mesh, and a weighed density."""
    rng = np.random.default_rng(seed)
    frames = np.arange(detail.frames) / RATE
    bare = rec.Recording(
        cloth=_info(fabric.density, pull, detail.truth(pull)),
        provenance="synthetic: torchcloth, the same law on another mesh, with another step",
        grasps=_grasps(pull),
        grippers=_motion(pull, strain(fabric, pull), frames[-1]),
        air_density=AIR,
    )
    out = _simulate(sheet(bare, fabric), bare, frames, pull)
    x = out.x[np.searchsorted(out.t.numpy(), frames)].numpy()
    weighed = fabric.density * (1 + DENSITY_ERROR * rng.standard_normal())
    first = _first_shape(x[0], pull, detail, rng)
    points, markers, sigma = _look(x, frames, pull, detail, rng)
    grippers = {
        name: rec.GripperMotion(m.t, m.position, m.quat_wxyz, m.closed, readings(out, name, m.t, FORCE_NOISE, rng))
        for name, m in bare.grippers.items()
    }
    return rec.Recording(
        cloth=_info(weighed, pull, detail.model(pull), first),
        provenance=bare.provenance,
        grasps=bare.grasps,
        grippers=grippers,
        points=points,
        markers=markers,
        observation_noise_std=sigma,
        air_density=AIR,
    )


def sheet(
    recording: rec.Recording,
    fabric: Fabric,
    contact: tc.Contact | None = None,
    contact_stiffness: float = 1e6,
    shear_stiffness: float = 2.5e5,
) -> tc.Cloth:
    """The recording's cloth, of a fabric; the density is the recording's. k and gamma [Pa] act with contact only."""
    effects = {
        "gravity": tc.effects.Gravity(),
        "bending": tc.effects.Bending(BENDING, BENDING_TIME),
        "air": tc.effects.AirDrag(DRAG),
    }
    material = tc.materials.AEP(
        fabric.membrane / THICKNESS, fabric.poisson, contact_stiffness, shear_stiffness, thickness=THICKNESS
    )
    return build_cloth(recording, material, effects, contact)


def _info(density: float, pull: Pull, resolution: tuple[int, int], first: np.ndarray | None = None) -> rec.ClothInfo:
    mesh = tc.meshes.rectangle(*pull.size, resolution=resolution)
    return rec.ClothInfo(
        areal_density=density,
        thickness=THICKNESS,
        vertices=mesh.vertices,
        faces=mesh.faces,
        uv=mesh.uv,
        initial_vertices=first,
    )


def _grasps(pull: Pull) -> dict[str, rec.GraspInfo]:
    """The two clamps, as pattern points denser than any mesh."""
    out = {}
    for name, place in (("still", 0.0), ("moving", 1.0)):
        share = np.full((601, 2), place)
        share[:, 1 - pull.axis] = np.linspace(0.0, 1.0, 601)
        out[name] = rec.GraspInfo(share * pull.size, RADIUS)
    return out


def _motion(pull: Pull, most: float, duration: float) -> dict[str, rec.GripperMotion]:
    """Taut at first, then pulled and held."""
    t = np.arange(0.0, duration + 1.5 / KNOTS, 1 / KNOTS)
    rise = 0.5 * (1 - np.cos(np.pi * np.clip(t / RISE, 0, 1)))[:, None]
    length = pull.size[pull.axis]
    still = np.zeros((len(t), 3))
    still[:, 1 - pull.axis] = 0.5 * pull.size[1 - pull.axis]
    moving = still + (1 + pull.taut) * length * np.eye(3)[pull.axis] + (most - pull.taut) * length * rise * pull.way
    facing, closed = np.tile([1.0, 0, 0, 0], (len(t), 1)), np.ones(len(t), bool)
    return {name: rec.GripperMotion(t, x, facing, closed) for name, x in (("still", still), ("moving", moving))}


@torch.no_grad()
def _simulate(truth: tc.Cloth, recording: rec.Recording, frames: np.ndarray, pull: Pull) -> Rollout:
    """From taut and at rest, with a step that is not the model's."""
    moves = replay(recording)
    x = torch.as_tensor(truth.mesh.vertices).clone()
    x[:, pull.axis] *= 1 + pull.taut
    state = truth.settle(truth.state(x), moves, duration=0.4)
    knots = recording.grippers["moving"].t
    times = np.union1d(knots[knots <= frames[-1] + 1.2 / KNOTS], frames)
    return truth(state, moves, times.tolist(), dt=0.6 * truth.stable_step())


def _first_shape(x: np.ndarray, pull: Pull, detail: Detail, rng: np.random.Generator) -> np.ndarray:
    """[V, 3] m on the model's mesh: smoothly off between the clamps, and a little at every free vertex."""
    share = np.asarray(tc.meshes.rectangle(1.0, 1.0, resolution=detail.model(pull)).uv)
    along = share[:, pull.axis, None]
    start, end = HELD_ERROR * rng.standard_normal((2, 3))
    free = (along > 1e-6) & (along < 1 - 1e-6)
    error = (1 - along) * start + along * end + FREE_ERROR * free * rng.standard_normal((len(share), 3))
    return on_grid(x, detail.truth(pull), share) + error


def _look(
    x: np.ndarray, frames: np.ndarray, pull: Pull, detail: Detail, rng: np.random.Generator
) -> tuple[rec.PointClouds, rec.Markers, float]:
    """Clouds, markers and the depth's standard deviation [m] of a Kinect above, with a bar in its way."""
    resolution, noise = detail.truth(pull), DepthNoise()
    middle, depth = x[0].mean(0), float(noise.sigma(np.array(EYE)))
    eye = middle + np.array([0.0, -SIDEWAYS, EYE])
    camera = DepthCamera.azure_kinect_nfov(look_at(eye, middle, up=np.array([0.0, 1.0, 0.0])))
    view, faces = View(camera, noise, max_points=detail.points), tc.meshes.rectangle(1.0, 1.0, resolution=resolution).faces
    bar = _bar(x[0], eye)
    clouds = [capture(view, frame, faces, [bar], rng=rng).points for frame in x]
    u, v = np.meshgrid(*((np.arange(n) + 0.5) / n for n in MARKERS), indexing="ij")
    share = np.stack([u.ravel(), v.ravel()], axis=1)
    xyz = np.stack([on_grid(frame, resolution, share) for frame in x])
    hidden = _behind(xyz, eye, bar[0])
    lateral = noise.jitter * EYE / camera.K[0, 0]
    xyz += rng.standard_normal(xyz.shape) * [lateral, lateral, depth]
    xyz[hidden] = np.nan
    points = rec.PointClouds(frames, np.concatenate(clouds), np.array([len(c) for c in clouds]))
    return points, rec.Markers(frames, xyz, share * pull.size), depth


def _bar(x: np.ndarray, eye: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners [4, 3] m and triangles of a flat bar across the sheet, that hides ``BAR`` of its length."""
    low, high = x.min(0), x.max(0)
    ends = low[0] + (BAR_MIDDLE + BAR * np.array([-0.5, 0.5])) * (high - low)[0]
    far = np.array([2 * low[1] - high[1], 2 * high[1] - low[1]])
    shadow = np.array([[ends[i], far[j], x[:, 2].mean()] for i, j in ((0, 0), (1, 0), (1, 1), (0, 1))])
    return shadow + (eye - shadow) * (BAR_HEIGHT / EYE), np.array([[0, 1, 2], [0, 2, 3]])


def _behind(xyz: np.ndarray, eye: np.ndarray, bar: np.ndarray) -> np.ndarray:
    """[...] bool, which points the bar hides from the eye."""
    ray = xyz - eye
    crossing = (eye + ray * ((bar[0, 2] - eye[2]) / ray[..., 2:]))[..., :2]
    return ((crossing > bar[:, :2].min(0)) & (crossing < bar[:, :2].max(0))).all(-1)
