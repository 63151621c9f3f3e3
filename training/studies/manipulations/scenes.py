"""What is done to which garment, and the same scene on any mesh and contact grid."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

import numpy as np

import torchcloth as tc
from torchcloth import meshes
from torchcloth.boundaries import Grasp, Plane
from torchcloth.dynamics.contact import Contact
from torchcloth.effects import AirDrag, Bending, Gravity
from torchcloth.errors import InvalidInput
from torchcloth.materials import AEP
from torchcloth.meshes import Mesh
from torchcloth.robots import primitives  # pyright: ignore[reportMissingImports] - mapped from robots/
from torchcloth.robots.primitives import Action, GripperLimits  # pyright: ignore[reportMissingImports]
from torchcloth.synthesis.garments import DEFAULT_BENDING_STIFFNESS_NM, BENDING_DAMPING_TIME_S, DEFAULT_AREAL_DENSITY_KG_PER_M2, GARMENTS, build_material, cloth_properties, build_garment_mesh

WORN = ("dress", "trousers", "shirt")
ACTIONS = ("cover", "fling", "drag")
SPEEDS = {"slow": 0.7, "middle": 0.85, "fast": 1.0}  # m/s, of the grippers at most
GRIPS = {
    "at the corners": (0.0, 0.0),
    "inwards": (0.2, 0.0),
    "lower": (0.0, 0.08),
}  # share towards the middle, of length
POSTURES = {"straight": 0.0, "turned left": 0.35, "turned right": -0.35}  # rad, the cloth's body from the motion
INITIAL_LAYER_DISTANCE_M = 1e-3  # m between front and back at the start
TABLE_FRICTION = 0.4
MIN_HANGING_HEIGHT_M = 0.12  # m above the table, of hanging cloth
PLATE_DRAG_COEFFICIENT = 1.2  # of a flat plate, broadside
COARSE_GRIP_RADIUS_M = 0.05  # m, radius of what a gripper holds: on a coarse mesh, enough for some vertices
REST_TIME_S = 0.12  # s, after the grippers open


@dataclass(frozen=True)
class Manipulation:
    """One way to move a garment; ``number`` seeds the sensor's errors, ``slower`` divides the grippers' speed."""

    garment: str
    number: int
    action: str
    speed: str
    grip: str
    posture: str
    slower: float = 1.0

    @property
    def name(self) -> str:
        """Of its case."""
        return f"{self.garment}-{self.number:02d}-{self.action}"

    def facts(self) -> dict[str, Any]:
        """As a case keeps it."""
        return asdict(self)


def manipulations(garment: str, count: int = 10) -> list[Manipulation]:
    """Actions and levels of the factors by Latin squares: in nine, an action meets every level once."""
    speeds, grips, postures = (list(levels) for levels in (SPEEDS, GRIPS, POSTURES))
    out = []
    for i in range(count):
        a, b = i % 3, (i // 3) % 3
        levels = speeds[b], grips[(a + b) % 3], postures[(2 * a + b) % 3]
        out.append(Manipulation(garment, i, ACTIONS[a], *levels))
    return out


class Fabric(NamedTuple):
    """The values that a fit seeks, by the names that it uses; SI units."""

    youngs_modulus: float
    poisson_ratio: float
    contact_stiffness: float
    shear_stiffness: float
    bending: float = DEFAULT_BENDING_STIFFNESS_NM
    air: float = PLATE_DRAG_COEFFICIENT

    @classmethod
    def true(cls, garment: str) -> Fabric:
        """The paper's E and nu as the preset reads them, with the softer contact of ``torchcloth simulate``."""
        law = build_material(GARMENTS[garment].fabric)
        names = cls._fields[:4]
        return cls(*(float(getattr(law, name).value.detach()) for name in names))

    def start(self) -> Fabric:
        """Where the fit begins: everything is off by a factor of 1.25 to 2."""
        e, nu, k, gamma, bending, air = self
        return Fabric(1.5 * e, 2.0 * nu, 2.0 * k, 0.5 * gamma, 1.5 * bending, 0.8 * air)

    def named(self) -> dict[str, float]:
        """By the parameters' public names."""
        *law, bending, air = self
        return {**dict(zip(self._fields, law, strict=False)), "bending.stiffness": bending, "air.normal": air}


class Discretisation(NamedTuple):
    """Mesh, contact grid, and substep as a share of the stable one."""

    triangles: int
    gap: float  # m between layers that touch
    step: float = 1.0


class Scene:
    """A manipulation on one discretisation.

    Attributes:
        mesh: the garment where it starts.
        rest: [V, 3] m, its vertices in its own frame.
        held: gripper -> vertices in its grip.
        action: paths of the grippers.
        hangs: whether it hangs at the start, else it lies on the table.

    Raises:
        InvalidInput: a mesh so coarse that a grip holds nothing.
    """

    def __init__(self, what: Manipulation, fine: Discretisation) -> None:
        self.what, self.fine, self.hangs = what, fine, what.action == "fling"
        self.garment = GARMENTS[what.garment]
        made = build_garment_mesh(self.garment, fine.triangles)
        self.rest, self.length = made.vertices, float(np.ptp(made.vertices[:, 1]))
        self.mesh = Mesh.build(self._placed(self.rest), made.faces, made.pattern, made.places)
        places = self._grips(made)
        apart = {name: np.linalg.norm(self.rest - place, axis=1) for name, place in places.items()}
        self.held = {name: np.flatnonzero(distance <= COARSE_GRIP_RADIUS_M) for name, distance in apart.items()}
        if not all(len(held) for held in self.held.values()):
            raise InvalidInput("--triangles", got=fine.triangles, expected="a vertex in every grip, so more triangles")
        self.action = self._action({name: tuple(self._placed(place[None])[0]) for name, place in places.items()})

    def cloth(self, fabric: Fabric) -> tc.Cloth:
        """The garment with these values."""
        h = cloth_properties(self.garment.fabric)["thickness"]
        law = AEP(*fabric[:2], contact_stiffness=fabric[2], shear_stiffness=fabric[3], thickness=h)
        effects = {
            "gravity": Gravity(),
            "air": AirDrag(fabric.air),
            "bending": Bending(fabric.bending, damping_time=BENDING_DAMPING_TIME_S),
        }
        boundaries = {name: Grasp(held.tolist()) for name, held in self.held.items()}
        table = Plane(friction=TABLE_FRICTION, offset=INITIAL_LAYER_DISTANCE_M / 2)
        return tc.Cloth(
            self.mesh, law, DEFAULT_AREAL_DENSITY_KG_PER_M2, effects, {**boundaries, "table": table}, Contact.with_gap(self.fine.gap)
        )

    def _grips(self, made: Mesh) -> dict[str, np.ndarray]:
        """Gripper -> [3] m, the middle of its pad in the garment's own frame."""
        inwards, lower = GRIPS[self.what.grip]
        places = [made.vertices[made.places[place]].mean(0) for place in self.garment.grips]
        middle = (places[0] + places[1]) / 2
        shifts = [inwards * (middle - place) - [0.0, lower * self.length, 0.0] for place in places]
        return {name: place + s for name, place, s in zip(("left", "right"), places, shifts, strict=True)}

    def _placed(self, points: np.ndarray) -> np.ndarray:
        """[N, 3] m in the world, of points in the garment's frame: hanging by its grips, or on the table.

        Away from the arms is +x; the gripped end is up, or towards the arms. The body is turned about the vertical.
        """
        x, y, z = points.T
        z = z * (INITIAL_LAYER_DISTANCE_M / (meshes.garments.LAYER_GAP_M * self.garment.scale))
        if self.hangs:
            forward, side, up = z, x, MIN_HANGING_HEIGHT_M + self.length / 2 + y
        else:
            forward, side, up = self.length / 2 - y, x, z + 1.5 * INITIAL_LAYER_DISTANCE_M
        turn = POSTURES[self.what.posture]
        near = {"drag": 0.46, "cover": 0.36, "fling": 0.50}[self.what.action]
        return np.stack(
            [
                near + math.cos(turn) * forward - math.sin(turn) * side,
                math.sin(turn) * forward + math.cos(turn) * side,
                up,
            ],
            axis=-1,
        )

    def _action(self, grips: dict[str, tuple[float, ...]]) -> Action:
        """Away for cover and fling, towards the arms for drag."""
        speed = SPEEDS[self.what.speed] / self.what.slower
        limits = GripperLimits(speed, 8.0 * speed**2)
        if self.what.action == "fling":
            return primitives.fling(grips, 0.12, heading=0.0, pull=0.15, landing=0.05, rest=REST_TIME_S, limits=limits)
        if self.what.action == "drag":
            return primitives.drag(grips, 0.15, heading=math.pi, landing=0.02, rest=REST_TIME_S, limits=limits)
        reach = 0.75 * self.length
        return primitives.cover(grips, reach, heading=0.0, landing=2 * self.fine.gap, rest=REST_TIME_S, limits=limits)


def slowed(what: Manipulation, length: float, fine: Discretisation) -> Manipulation:
    """The same with grippers so slow that it takes ``length`` seconds.

    Raises:
        InvalidInput: it takes longer as it is.
    """
    lasts = min(float(path.t[-1]) for path in Scene(what, fine).action.motion.values())
    if length < lasts:
        raise InvalidInput("--length", got=f"{length:g} s", expected=f"{lasts:.2f} s or more")
    return replace(what, slower=what.slower * (length - REST_TIME_S) / (lasts - REST_TIME_S))
