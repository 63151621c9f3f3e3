"""Random scenes of grippers that move a cloth, each a function of its seed and split, simulated by this library.

Two splits have no scene in common, and differ in content. Of the split "train" are sheets, shirts and trousers, fabrics
of a narrower range, and all motions but two. A scene of "held-out" has one novelty: a garment (a dress), a fabric
outside the range of the training, a motion (fling or cover), or nothing but its seed. There is no contact between
layers of cloth: it would take forty times as long.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import lru_cache
from typing import Literal, NamedTuple, get_args

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

import torchcloth as tc
from torchcloth import meshes
from torchcloth._utils.torch_modes import default_dtype
from torchcloth.boundaries import AbstractBoundary, Grasp, Plane
from torchcloth.effects import AbstractEffect, AirDrag, Bending, Gravity
from torchcloth.episodes.pattern_interpolation import interpolation_weights
from torchcloth.errors import InvalidInput, SimulationDiverged, TorchclothError, UnstableStep
from torchcloth.materials import AEP
from torchcloth.meshes import Mesh
from torchcloth.robots import primitives  # pyright: ignore[reportMissingImports] - mapped from robots/
from torchcloth.robots.primitives import GripperLimits  # pyright: ignore[reportMissingImports]

Array = np.ndarray
Split = Literal["train", "held-out"]
SPLITS: tuple[Split, ...] = get_args(Split)
NOVELTIES = ("seed", "garment", "fabric", "motion")  # of the split "held-out"

POSE_FRAME_PERIOD_S = 1 / 30
MOTIONS_PER_CLOTH = 3  # successive seeds share meshes and grips, because a new mesh costs as much as a motion
GARMENT_SHARE = 0.25
FABRIC_THICKNESS_M = 5e-4
TRAINING_GARMENTS, NOVEL_GARMENTS = ("shirt", "trousers"), ("dress",)
GARMENT_GRIPS = {
    "shirt": (("left shoulder", "right shoulder"), ("left hem corner", "right hem corner")),
    "trousers": (("left waist corner", "right waist corner"), ("left hem outside", "right hem outside")),
    "dress": (("left shoulder", "right shoulder"), ("left hem corner", "right hem corner")),
}
VARIED_MEASURES = {
    "shirt": {"length": 0.72, "chest": 0.54, "hem": 0.54, "shoulders": 0.46, "sleeve": 0.24, "cuff": 0.18},
    "trousers": {"length": 1.04, "waist": 0.40, "hip": 0.53, "hem": 0.21},
    "dress": {"length": 1.05, "bust": 0.47, "hem": 0.78, "shoulders": 0.38},
}
HANGING_MOTIONS, TABLE_MOTIONS = ("spline", "swing", "shake"), ("fold", "drag", "lift", "lifted spline")
NOVEL_MOTIONS = ("fling", "cover")  # the first hangs at its start, the second lies on the table

HANGING_SETTLING_TIME_S, SETTLING_RATE_PER_S = 0.5, 10.0
SPEED_RANGE_M_PER_S = (0.1, 1.2)
DURATION_RANGE_S = (1.5, 2.5)
TRAJECTORY_KNOT_PERIOD_S = 0.02
MAX_EDGE_LENGTH_RATIO = 1.5  # beyond it the cloth is torn
MIN_AREA_RATIO = 0.05  # of a triangle to its area at rest; below it the triangle has collapsed
MAX_COLLAPSED_FRACTION = 0.02  # of the triangles of all frames
SPLIT_CODES = {"train": 720, "held-out": 721}


class RejectedScene(TorchclothError):
    """A scene whose simulation diverged or whose triangles collapsed."""


class Fabric(NamedTuple):
    """Parameters of a fabric.

    Attributes:
        membrane_stiffness: E h [N/m].
        bending_stiffness: B [N m].
        drag: C_n [-].
        areal_density: rho_A [kg/m^2].
        poisson_ratio: nu [-].
        bending_damping_time: tau_b [s].
    """

    membrane_stiffness: float
    bending_stiffness: float
    drag: float
    areal_density: float
    poisson_ratio: float
    bending_damping_time: float


FABRIC_RANGES = {
    "membrane_stiffness": (40.0, 1000.0),
    "bending_stiffness": (1e-5, 3e-4),
    "drag": (0.7, 1.6),
    "areal_density": (0.10, 0.35),
    "poisson_ratio": (0.2, 0.4),
    "bending_damping_time": (0.01, 0.1),
}
# The training ends here; beyond are fabrics of the split "held-out". All ranges are sampled log-uniformly.
TRAINING_FABRIC_LIMITS = {"membrane_stiffness": 650.0, "bending_stiffness": 2e-4, "areal_density": 0.29}


class ClothShape(NamedTuple):
    """A cloth on two meshes, and where grippers hold it.

    Attributes:
        kind: "sheet" or the name of a garment.
        true_mesh: that is simulated and seen.
        mesh: of the network.
        weights: [V, W], from the W vertices of ``true_mesh`` to the V of ``mesh``; None: the meshes are one.
        grip_kind: "corners", "inwards", "bar", "corner" or the places of a garment.
        true_grips: vertices of ``true_mesh`` in each gripper.
        grips: vertices of ``mesh`` in each gripper.
    """

    kind: str
    true_mesh: Mesh
    mesh: Mesh
    weights: Array | None
    grip_kind: str
    true_grips: tuple[Array, ...]
    grips: tuple[Array, ...]


class Scene(NamedTuple):
    """A cloth with its fabric at its start, and the motion of the grippers.

    Attributes:
        seed: number of the scene in its split.
        split: "train" or "held-out".
        novelty: what the training has not seen: "seed", "garment", "fabric" or "motion".
        shape: meshes and grips.
        fabric: parameters.
        motion_kind: such as "spline" or "fold".
        has_table: whether there is a table at z = 0.
        start: [W, 3] m, vertices of the true mesh before they settle.
        settling_time: s.
        motion: path of each gripper, from 0 s; its pose is at the centre of what it holds.
        duration: s.
    """

    seed: int
    split: Split
    novelty: str
    shape: ClothShape
    fabric: Fabric
    motion_kind: str
    has_table: bool
    start: Array
    settling_time: float
    motion: dict[str, tc.Trajectory]
    duration: float


class SimulatedScene(NamedTuple):
    """Frames of a simulated scene.

    Attributes:
        scene: that was simulated.
        times: [T] s, ``POSE_FRAME_PERIOD_S`` apart.
        true_x: [T, W, 3] m, vertices of the true mesh.
        x: [T, V, 3] m, the same cloth at the vertices of the network's mesh.
        v: [T, V, 3] m/s.
    """

    scene: Scene
    times: Array
    true_x: Array
    x: Array
    v: Array


def gripper_names(count: int) -> list[str]:
    """Return the names of the first ``count`` grippers."""
    return [f"gripper {k + 1}" for k in range(count)]


def build_scene(seed: int, split: Split) -> Scene:
    """Build the scene of a seed.

    Raises:
        InvalidInput: a negative seed or an unknown split.
    """
    if split not in SPLITS:
        raise InvalidInput("split", got=repr(split), expected=f"one of {', '.join(SPLITS)}")
    if seed < 0:
        raise InvalidInput("seed", got=seed, expected="a whole number >= 0")
    shape, novelty = _cloth_shape(seed // MOTIONS_PER_CLOTH, split)
    rng = np.random.default_rng([SPLIT_CODES[split], 1, seed])
    fabric = _draw_fabric(rng, novelty == "fabric")
    has_two = len(shape.grips) == 2
    on_table = shape.kind == "sheet" and shape.grip_kind in ("corners", "inwards", "corner") and rng.random() < 0.25
    if novelty == "motion":
        on_table = shape.kind == "sheet" and shape.grip_kind != "bar" and rng.random() < 0.5
        motion_kind = NOVEL_MOTIONS[1] if on_table else NOVEL_MOTIONS[0]
    elif on_table:
        motion_kind = str(rng.choice(TABLE_MOTIONS))
    else:
        motion_kind = str(rng.choice(HANGING_MOTIONS, p=(0.7, 0.15, 0.15)))
    start = _lying_start(shape, rng) if on_table else _hanging_start(shape, rng)
    settling_time = 0.0 if on_table else HANGING_SETTLING_TIME_S * (1.0 if has_two else 1.6)
    motion, duration = _draw_motion(shape, start, motion_kind, rng)
    has_table = on_table or motion_kind == "fling"
    return Scene(seed, split, novelty, shape, fabric, motion_kind, has_table, start, settling_time, motion, duration)


def build_cloth(mesh: Mesh, fabric: Fabric, grips: Sequence[Array], has_table: bool) -> tc.Cloth:
    """Build a cloth without contact between layers, held by "gripper 1" and "gripper 2", over the "table" if any."""
    material = AEP(fabric.membrane_stiffness / FABRIC_THICKNESS_M, fabric.poisson_ratio, thickness=FABRIC_THICKNESS_M)
    effects: dict[str, AbstractEffect] = {
        "gravity": Gravity(),
        "bending": Bending(fabric.bending_stiffness, fabric.bending_damping_time),
        "air": AirDrag(fabric.drag),
    }
    boundaries: dict[str, AbstractBoundary] = {
        name: Grasp(vertices=vertices.tolist()) for name, vertices in zip(gripper_names(2), grips, strict=False)
    }
    if has_table:
        boundaries["table"] = Plane(offset=1e-3)
    return tc.Cloth(mesh, material, fabric.areal_density, effects, boundaries, contact=None)


@torch.no_grad()
def simulate(scene: Scene) -> SimulatedScene:
    """Simulate a scene in single precision, and interpolate it at the vertices of the network's mesh.

    Raises:
        RejectedScene: the simulation diverged, an edge is stretched by half, or triangles collapsed.
    """
    shape = scene.shape
    times = POSE_FRAME_PERIOD_S * np.arange(int(scene.duration / POSE_FRAME_PERIOD_S + 1e-6) + 1)
    try:
        with warnings.catch_warnings(), default_dtype(torch.float32):  # a scene is a function of its seed
            warnings.filterwarnings("ignore", "settle: after")  # the motion goes on from whatever shape it has
            cloth = build_cloth(shape.true_mesh, scene.fabric, shape.true_grips, scene.has_table)
            state = cloth.state(torch.as_tensor(scene.start, dtype=torch.float32))
            if scene.settling_time:
                state = cloth.settle(state, scene.motion, duration=scene.settling_time, rate=SETTLING_RATE_PER_S)
            rollout = cloth(state, scene.motion, times.tolist(), checkpoint=False)
    except (SimulationDiverged, UnstableStep) as error:
        raise RejectedScene(f"scene {scene.seed} of {scene.split}", got=str(error)) from error
    true_x, true_v = (tensor.numpy().astype(np.float64) for tensor in (rollout.x, rollout.v))
    _check_shapes(scene, true_x)
    if shape.weights is None:
        return SimulatedScene(scene, times, true_x, true_x, true_v)
    return SimulatedScene(scene, times, true_x, shape.weights @ true_x, shape.weights @ true_v)


def _check_shapes(scene: Scene, x: Array) -> None:
    """Refuse frames [T, W, 3] m in which edges are stretched too much or many triangles have no area."""
    mesh, where = scene.shape.true_mesh, f"scene {scene.seed} of {scene.split}"
    corners = x[:, mesh.faces]
    length = np.linalg.norm(corners - np.roll(corners, 1, axis=2), axis=-1)
    rest = np.linalg.norm(mesh.rest - np.roll(mesh.rest, 1, axis=1), axis=-1)
    stretch = float((length / rest).max())
    if not stretch < MAX_EDGE_LENGTH_RATIO:
        raise RejectedScene(
            where, got=f"an edge {stretch:.2f} times its length", expected=f"< {MAX_EDGE_LENGTH_RATIO:g}"
        )
    area = 0.5 * np.linalg.norm(
        np.cross(corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0]), axis=-1
    )
    collapsed = float((area < MIN_AREA_RATIO * mesh.area).mean())
    if collapsed > MAX_COLLAPSED_FRACTION:
        raise RejectedScene(where, got=f"{collapsed:.1%} of the triangles without area")


# -- cloth and grips --------------------------------------------------------------------------------------------------


@lru_cache(maxsize=4)  # bending stencils are cached by mesh, too
def _cloth_shape(number: int, split: Split) -> tuple[ClothShape, str]:
    """Return a cloth and its novelty."""
    rng = np.random.default_rng([SPLIT_CODES[split], 0, number])
    novelty = "seed" if split == "train" else str(rng.choice(NOVELTIES))
    if novelty == "garment" or (novelty != "motion" and rng.random() < GARMENT_SHARE):
        kind = str(rng.choice(NOVEL_GARMENTS if novelty == "garment" else TRAINING_GARMENTS))
        return _draw_garment(kind, rng), novelty
    return _draw_sheet(rng), novelty


def _draw_sheet(rng: np.random.Generator) -> ClothShape:
    width = rng.uniform(0.25, 0.6)
    height = float(np.clip(width * rng.uniform(1.0, 1.6) ** rng.choice((-1, 1)), 0.25, 0.6))
    true_mesh = meshes.rectangle(width, height, triangles=int(rng.integers(130, 450)))
    mesh = meshes.rectangle(width, height, triangles=round(np.exp(rng.uniform(np.log(80), np.log(450)))))
    weights = interpolation_weights(true_mesh, _uv(mesh)).to_dense().numpy()
    radius = float(np.exp(rng.uniform(np.log(0.001), np.log(0.030))))
    grip_kind = str(rng.choice(("corners", "inwards", "bar", "corner"), p=(0.55, 0.15, 0.12, 0.18)))
    left, right = (0.0, height), (width, height)
    if grip_kind == "inwards":
        left, right = (rng.uniform(0.03, 0.28) * width, height), (width * (1 - rng.uniform(0.03, 0.28)), height)
    if grip_kind == "bar":
        grips = [(np.flatnonzero(_uv(one)[:, 1] > height - 1e-9),) for one in (true_mesh, mesh)]
    else:
        places = [left, right]
        if grip_kind == "corner":
            places = [places[rng.integers(2)]]
        elif rng.random() < 0.5:  # gripper 1 is at the right
            places.reverse()
        grips = [tuple(_vertices_near(one, place, radius) for place in places) for one in (true_mesh, mesh)]
    return ClothShape("sheet", true_mesh, mesh, weights, grip_kind, *grips)


def _draw_garment(kind: str, rng: np.random.Generator) -> ClothShape:
    mesh = None
    while mesh is None:
        scale = rng.uniform(0.4, 0.7)
        measures = {name: scale * value * rng.uniform(0.88, 1.14) for name, value in VARIED_MEASURES[kind].items()}
        measures |= {name: scale * value for name, value in _fixed_measures(kind).items()}
        with suppress(InvalidInput):  # such as a sleeve that overlaps the body
            mesh = getattr(meshes, kind)(**measures, triangles=int(rng.integers(200, 400)))
    places = GARMENT_GRIPS[kind][int(rng.random() < 0.25)]
    names = list(places) if rng.random() < 0.8 else [places[rng.integers(2)]]
    if rng.random() < 0.5:
        names.reverse()
    radius = rng.uniform(0.01, 0.03)
    grips = tuple(mesh.vertices_at_place(name, radius) for name in names)
    return ClothShape(kind, mesh, mesh, None, ", ".join(names), grips, grips)


def _fixed_measures(kind: str) -> dict[str, float]:
    """Return the lengths of an adult's garment that are not varied: all other defaults in metres."""
    defaults = getattr(meshes, kind).__kwdefaults__
    skipped = {"triangles", "sleeve_angle", *VARIED_MEASURES[kind]}
    return {name: value for name, value in defaults.items() if name not in skipped}


def _uv(mesh: Mesh) -> Array:
    uv = mesh.uv
    assert uv is not None
    return uv


def _vertices_near(mesh: Mesh, place: tuple[float, float], radius: float) -> Array:
    """Return the vertices within ``radius`` of a pattern point, or the nearest one."""
    distance = np.linalg.norm(_uv(mesh) - place, axis=1)
    return np.flatnonzero(distance <= max(radius, distance.min() + 1e-9))


def _draw_fabric(rng: np.random.Generator, is_novel: bool) -> Fabric:
    values = {}
    novel = str(rng.choice(list(TRAINING_FABRIC_LIMITS))) if is_novel else ""
    for name, (low, high) in FABRIC_RANGES.items():
        limit = TRAINING_FABRIC_LIMITS.get(name, high)
        low, high = (limit, high) if name == novel else (low, limit)
        values[name] = float(np.exp(rng.uniform(np.log(low), np.log(high))))
    return Fabric(**values)


# -- starts -----------------------------------------------------------------------------------------------------------


def _flat_places(shape: ClothShape) -> tuple[Array, Array]:
    """Return the flat cloth [W, 3] m (across, up, depth) and the centres [G, 3] m of what the grippers hold."""
    flat = shape.true_mesh.vertices - shape.true_mesh.vertices.mean(0)
    if shape.kind != "sheet" and "hem" in shape.grip_kind:  # it hangs upside down
        flat = flat * [-1.0, -1.0, 1.0]
    return flat, np.stack([flat[index].mean(0) for index in shape.true_grips])


def _hanging_start(shape: ClothShape, rng: np.random.Generator) -> Array:
    """Return a start [W, 3] m: bent as a cylinder about the vertical, so that the grippers are nearer to each other."""
    flat, grips = _flat_places(shape)
    across, up, depth = flat.T.copy()
    if len(grips) == 1 and shape.grip_kind != "bar":
        offset = flat[:, :2] - grips[0, :2]
        angle = -math.pi / 2 - math.atan2(*offset.mean(0)[::-1])
        across, up = (offset @ np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])).T
        left, right, ratio = across.min(), across.max(), rng.uniform(0.75, 0.97)
    elif shape.grip_kind == "bar":
        left, right, ratio = across.min(), across.max(), 1.0
    else:
        left, right, ratio = grips[:, 0].min(), grips[:, 0].max(), rng.uniform(0.7, 1.0)
    waves = int(rng.choice((1, 2, 3), p=(0.6, 0.25, 0.15)))
    along, outward, normal = _bend(across, left, right, ratio, waves)
    sign = rng.choice((-1.0, 1.0))
    outward, normal = sign * outward, normal * [sign, 1.0]
    free = np.ones(len(flat))
    free[np.concatenate(shape.true_grips)] = 0.0
    depth = depth + free * rng.normal(0.0, 5e-4, len(flat))
    planar = np.stack([along + depth * normal[:, 0], outward + depth * normal[:, 1]], 1)
    x = np.column_stack([planar, up - up.min() + rng.uniform(0.12, 0.3)])
    return _turn_about_vertical(x - [*x[:, :2].mean(0), 0.0], rng.uniform(-math.pi, math.pi))


def _bend(across: Array, left: float, right: float, ratio: float, waves: int) -> tuple[Array, Array, Array]:
    """Bend a line into arcs of alternating sides, so that ``left`` and ``right`` come nearer by ``ratio``.

    Returns:
        Place along [W] m and outwards [W] m of the points ``across`` [W] m, and their normals [W, 2].
    """
    half_angle = 0.0
    if ratio < 1 - 1e-6:
        low, high = 1e-6, math.pi
        for _ in range(50):
            half_angle = (low + high) / 2
            low, high = (half_angle, high) if math.sin(half_angle) / half_angle > ratio else (low, half_angle)
    s = np.linspace(across.min() - 1e-6, across.max() + 1e-6, 400)
    phase = np.clip((s - left) / (right - left), 0.0, 1.0) * waves
    wave = np.minimum(phase.astype(int), waves - 1)
    angle = half_angle * (1 - 2 * (phase - wave)) * np.where(wave % 2 == 0, 1, -1)
    step = np.diff(s)
    middle = (angle[1:] + angle[:-1]) / 2
    along = np.concatenate([[0.0], np.cumsum(np.cos(middle) * step)])
    outward = np.concatenate([[0.0], np.cumsum(np.sin(middle) * step)])
    at = np.interp(across, s, angle)
    normal = np.stack([-np.sin(at), np.cos(at)], 1)
    return np.interp(across, s, along), np.interp(across, s, outward), normal


def _lying_start(shape: ClothShape, rng: np.random.Generator) -> Array:
    """Return a sheet [W, 3] m that lies flat on the table."""
    flat, _ = _flat_places(shape)
    lying = np.column_stack([flat[:, :2], 2e-3 + np.abs(rng.normal(0.0, 5e-4, len(flat)))])
    return _turn_about_vertical(lying, rng.uniform(-math.pi, math.pi))


def _turn_about_vertical(x: Array, angle: float) -> Array:
    return x @ Rotation.from_euler("z", angle).as_matrix().T


# -- motions ----------------------------------------------------------------------------------------------------------


def _draw_motion(
    shape: ClothShape, start: Array, kind: str, rng: np.random.Generator
) -> tuple[dict[str, tc.Trajectory], float]:
    """Return the paths of the grippers, and their duration [s]."""
    grips = np.stack([start[index].mean(0) for index in shape.true_grips])
    inwards = start.mean(0) - grips.mean(0)
    heading = math.atan2(inwards[1], inwards[0])
    length = 2 * float(np.linalg.norm(inwards))
    limits = GripperLimits(rng.uniform(0.3, SPEED_RANGE_M_PER_S[1]), rng.uniform(2.0, 8.0))
    named: Mapping[str, Sequence[float]] = dict(zip(gripper_names(len(grips)), grips.tolist(), strict=True))
    any_heading = rng.uniform(-math.pi, math.pi)
    if kind in ("spline", "lifted spline"):
        return _draw_spline_motion(shape, start, grips, kind == "lifted spline", rng)
    if kind == "swing":
        action = primitives.swing(
            named, rng.uniform(0.04, 0.2), period=rng.uniform(0.7, 1.5), heading=any_heading, limits=limits
        )
    elif kind == "shake":
        action = primitives.shake(
            named,
            rng.uniform(0.01, 0.05),
            cycles=5,
            period=rng.uniform(0.25, 0.5),
            elevation=rng.choice((math.pi / 2, rng.uniform(0, math.pi / 2))),
            heading=any_heading,
            limits=limits,
        )
    elif kind == "fling":
        across = grips[-1] - grips[0]
        heading = math.atan2(across[1], across[0]) + math.pi / 2 if len(grips) == 2 else any_heading
        action = primitives.fling(
            named, rng.uniform(0.1, 0.3), heading=heading, landing=0.05, pull=rng.uniform(0.0, 0.3), limits=limits
        )
    elif kind == "fold":
        action = primitives.fold(
            named,
            crease=rng.uniform(0.25, 0.5) * length,
            heading=heading,
            height=rng.uniform(0.08, 0.25),
            landing=0.02,
            short=0.0,
            roll=rng.uniform(0.0, math.pi),
            limits=limits,
        )
    elif kind == "cover":
        action = primitives.cover(
            named, rng.uniform(0.5, 0.9) * length, heading=heading, roll=rng.uniform(0.0, math.pi), limits=limits
        )
    elif kind == "drag":
        action = primitives.drag(
            named,
            rng.uniform(0.1, 0.4),
            heading=heading + rng.choice((math.pi, rng.uniform(-math.pi, math.pi))),
            height=rng.uniform(0.02, 0.12),
            limits=limits,
        )
    else:
        action = primitives.hang(
            named, rng.uniform(0.15, 0.6), heading=any_heading, carry=rng.uniform(0.0, 0.2), rest=0.5, limits=limits
        )
    return _until_release(action)


def _until_release(action: primitives.Action) -> tuple[dict[str, tc.Trajectory], float]:
    """Return the motion until the grippers open, at least as long as the shortest scene, at most as the longest."""
    duration = min(max(action.release_time, DURATION_RANGE_S[0]), DURATION_RANGE_S[1])
    motion = {}
    for name, (t, pose, _) in action.motion.items():
        is_before = t <= action.release_time + 1e-9
        t, pose = t[is_before], pose[is_before]
        if float(t[-1]) < duration + 0.2:  # clouds may lag, so the path goes on for a while
            rest = t[-1] + torch.tensor([0.1, duration + 0.2 - float(t[-1]) + 0.1], dtype=t.dtype)
            t, pose = torch.cat([t, rest]), torch.cat([pose, pose[-1:], pose[-1:]])
        motion[name] = tc.Trajectory(t, pose, torch.ones(len(t), dtype=torch.bool))
    return motion, duration


def _draw_spline_motion(
    shape: ClothShape, start: Array, grips: Array, is_lifted: bool, rng: np.random.Generator
) -> tuple[dict[str, tc.Trajectory], float]:
    """Return smooth random paths: translation, turns about the vertical, change of distance, or one gripper alone."""
    duration = rng.uniform(*DURATION_RANGE_S)
    count = math.ceil((duration + 0.2) / TRAJECTORY_KNOT_PERIOD_S) + 1
    t = TRAJECTORY_KNOT_PERIOD_S * np.arange(count)
    translation = _smooth_random(t, 3, rng) * rng.uniform(0.05, 0.3) * [1.0, 1.0, 0.5]
    yaw = _smooth_random(t, 1, rng)[:, 0] * (rng.uniform(0.1, 1.2) if rng.random() < 0.6 else 0.0)
    centre = grips.mean(0)
    offset = grips - centre
    paths = np.repeat(grips[:, None], count, axis=1)
    if len(grips) == 2 and rng.random() < 0.2:  # one gripper moves
        paths[rng.integers(2)] += translation
        yaw[:] = 0.0
    else:
        turned = np.einsum("kij,gj->gki", Rotation.from_euler("z", yaw[:, None]).as_matrix(), offset)
        if rng.random() < 0.6:
            turned = turned * (1 + rng.uniform(0.05, 0.45) * _smooth_random(t, 1, rng))
        if len(grips) == 2 and rng.random() < 0.3:
            turned[..., 2] += _smooth_random(t, 1, rng)[:, 0] * np.array([[0.1], [-0.1]])
        paths = centre + turned + translation
    if is_lifted:
        paths[..., 2] += rng.uniform(0.1, 0.5) * np.clip(t / rng.uniform(0.5, 1.2), 0, 1) ** 2
        paths[..., 2] = np.maximum(paths[..., 2], grips[:, None, 2])
    if len(grips) == 2:
        largest = _largest_distance(shape)
        between, half = paths.mean(0), (paths[1] - paths[0]) / 2
        half = half * np.minimum(1.0, largest / 2 / np.maximum(np.linalg.norm(half, axis=-1), 1e-9))[:, None]
        paths = np.stack([between - half, between + half])
    reach = 0.5 * float(np.ptp(start[np.concatenate(shape.true_grips)], axis=0).max()) if len(grips) == 1 else 0.0
    velocity = np.linalg.norm(np.gradient(paths, TRAJECTORY_KNOT_PERIOD_S, axis=1), axis=-1)
    velocity = velocity + reach * np.abs(np.gradient(yaw, TRAJECTORY_KNOT_PERIOD_S))
    limit = rng.uniform(*SPEED_RANGE_M_PER_S)
    fraction = min(1.0, limit / max(float(velocity.max()), 1e-9))
    paths = grips[:, None] + fraction * (paths - grips[:, None])
    tilt = _smooth_random(t, 2, rng) * (rng.uniform(0.0, 0.4) if rng.random() < 0.4 else 0.0)
    turn = Rotation.from_euler("zyx", np.column_stack([fraction * yaw, tilt])).as_matrix()
    if shape.grip_kind == "bar":
        turn = Rotation.from_euler("z", fraction * yaw[:, None]).as_matrix()
    motion = {}
    for name, path in zip(gripper_names(len(grips)), paths, strict=True):
        pose = np.tile(np.eye(4), (count, 1, 1))
        pose[:, :3, :3], pose[:, :3, 3] = turn, path
        motion[name] = tc.Trajectory(torch.as_tensor(t), torch.as_tensor(pose), torch.ones(count, dtype=torch.bool))
    return motion, duration


def _largest_distance(shape: ClothShape) -> float:
    """Return the distance [m] of what two grippers hold on the flat cloth."""
    _, grips = _flat_places(shape)
    return float(np.linalg.norm(grips[1] - grips[0]))


def _smooth_random(t: Array, count: int, rng: np.random.Generator) -> Array:
    """Return smooth random functions [K, count] of time that start at rest from 0 and reach 1 or -1."""
    knots = np.arange(0.0, t[-1] + 1.0, rng.uniform(0.3, 0.8))
    values = rng.standard_normal((len(knots), count))
    values[0] = 0.0
    curve = CubicSpline(knots, values, bc_type="clamped")(t)
    return curve / np.maximum(np.abs(curve).max(0), 1e-9)
