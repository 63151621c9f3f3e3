"""Manipulations of garments, and their scenes on any mesh and contact grid.

Contact acts only in part of these scenes. It ignores triangles that are less than about 7 gaps and 3 edges apart along
the cloth, here 0.5 to 0.7 m. Layers that are nearer along the cloth, such as front and back of a garment over the
side seam, pass through each other; only large folds touch. A smaller gap needs a finer mesh and smaller steps: one fit
would take days, and the published numbers would change. So the scenes stay as they are. The library's warning is
suppressed here; the studies say in their notes that such layers do not touch.
"""

from __future__ import annotations

import math
import warnings
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
from torchcloth.robots.primitives.base import Move, build_action  # pyright: ignore[reportMissingImports]
from torchcloth.synthesis.garments import (
    BENDING_DAMPING_TIME_S,
    DEFAULT_AREAL_DENSITY_KG_PER_M2,
    DEFAULT_BENDING_STIFFNESS_NM,
    GARMENTS,
    build_garment_mesh,
    build_material,
    cloth_properties,
)
from torchcloth.synthesis.initial_scene import INITIAL_LAYER_DISTANCE_M, MIN_HANGING_HEIGHT_M, TABLE_FRICTION

STUDY_GARMENTS = ("dress", "trousers", "shirt")
ACTIONS = ("cover", "fling", "drag")
CARRY = "carry"  # the garment hangs in the grippers, which carry it along; not part of the fits
CARRY_SHIFT_M = (0.3, 0.0, 0.1)
SPEEDS = {"slow": 0.7, "middle": 0.85, "fast": 1.0}  # largest speed of the grippers [m/s]
GRIPS = {
    "at the corners": (0.0, 0.0),
    "inwards": (0.2, 0.0),
    "lower": (0.0, 0.08),
}  # fraction towards the middle, fraction of the length downwards
POSTURES = {"straight": 0.0, "turned left": 0.35, "turned right": -0.35}  # angle of the body from the motion [rad]
PLATE_DRAG_COEFFICIENT = 1.2  # of a flat plate across the flow
COARSE_GRIP_RADIUS_M = 0.05  # large enough for some vertices of a coarse mesh
REST_TIME_S = 0.12  # after the grippers open


@dataclass(frozen=True)
class Manipulation:
    """A manipulation of a garment.

    Attributes:
        garment: one of ``STUDY_GARMENTS``.
        number: index of the manipulation, and seed of the sensor's errors.
        action: one of ``ACTIONS``, or ``CARRY``.
        speed: key of ``SPEEDS``.
        grip: key of ``GRIPS``.
        posture: key of ``POSTURES``.
        slower: divides the grippers' speed.
    """

    garment: str
    number: int
    action: str
    speed: str
    grip: str
    posture: str
    slower: float = 1.0

    @property
    def name(self) -> str:
        """Name of the case."""
        return f"{self.garment}-{self.number:02d}-{self.action}"

    def facts(self) -> dict[str, Any]:
        """Return the manipulation as a case stores it."""
        return asdict(self)


def manipulations(garment: str, count: int = 10) -> list[Manipulation]:
    """Return manipulations by Latin squares: among nine, each action meets each level of a factor once."""
    speeds, grips, postures = (list(levels) for levels in (SPEEDS, GRIPS, POSTURES))
    out = []
    for i in range(count):
        a, b = i % 3, (i // 3) % 3
        levels = speeds[b], grips[(a + b) % 3], postures[(2 * a + b) % 3]
        out.append(Manipulation(garment, i, ACTIONS[a], *levels))
    return out


class Fabric(NamedTuple):
    """Values of the fitted parameters in SI units."""

    youngs_modulus: float
    poisson_ratio: float
    contact_stiffness: float
    shear_stiffness: float
    bending: float = DEFAULT_BENDING_STIFFNESS_NM
    air: float = PLATE_DRAG_COEFFICIENT

    @classmethod
    def true(cls, garment: str) -> Fabric:
        """Return the true values: the paper's E and nu, with the softer contact of ``torchcloth simulate``."""
        law = build_material(GARMENTS[garment].fabric)
        names = cls._fields[:4]
        return cls(*(float(getattr(law, name).value.detach()) for name in names))

    def start(self) -> Fabric:
        """Return the start of the fit, where all values are wrong by a factor of 1.25 to 2."""
        e, nu, k, gamma, bending, air = self
        return Fabric(1.5 * e, 2.0 * nu, 2.0 * k, 0.5 * gamma, 1.5 * bending, 0.8 * air)

    def named(self) -> dict[str, float]:
        """Return the values by the parameters' public names."""
        *law, bending, air = self
        return {**dict(zip(self._fields, law, strict=False)), "bending.stiffness": bending, "air.normal": air}


class Discretisation(NamedTuple):
    """Discretisation of a scene.

    Attributes:
        triangles: approximate number.
        gap: distance of layers that touch [m].
        step: substep as a fraction of the stable one.
    """

    triangles: int
    gap: float
    step: float = 1.0


class Scene:
    """A manipulation on one discretisation.

    Attributes:
        mesh: the garment at its start.
        rest: [V, 3] m, vertices in the garment's frame.
        gripped_vertices: indices of the vertices in each gripper.
        action: paths of the grippers.
        hangs: whether the garment hangs at the start; else it lies on the table.

    Raises:
        InvalidInput: the mesh is so coarse that a grip contains no vertex.
    """

    def __init__(self, what: Manipulation, fine: Discretisation) -> None:
        self.what, self.fine, self.hangs = what, fine, what.action in ("fling", CARRY)
        self.garment = GARMENTS[what.garment]
        made = build_garment_mesh(self.garment, fine.triangles)
        self.rest, self.length = made.vertices, float(np.ptp(made.vertices[:, 1]))
        self.mesh = Mesh.build(self._placed(self.rest), made.faces, made.pattern, made.places)
        places = self._grips(made)
        apart = {name: np.linalg.norm(self.rest - place, axis=1) for name, place in places.items()}
        self.gripped_vertices = {
            name: np.flatnonzero(distance <= COARSE_GRIP_RADIUS_M) for name, distance in apart.items()
        }
        if not all(len(gripped_vertices) for gripped_vertices in self.gripped_vertices.values()):
            raise InvalidInput("--triangles", got=fine.triangles, expected="a vertex in every grip, so more triangles")
        self.action = self._action({name: tuple(self._placed(place[None])[0]) for name, place in places.items()})

    def cloth(self, fabric: Fabric) -> tc.Cloth:
        """Build the garment with these values."""
        h = cloth_properties(self.garment.fabric)["thickness"]
        law = AEP(fabric[0], fabric[1], contact_stiffness=fabric[2], shear_stiffness=fabric[3], thickness=h)
        effects = {
            "gravity": Gravity(),
            "air": AirDrag(fabric.air),
            "bending": Bending(fabric.bending, damping_time=BENDING_DAMPING_TIME_S),
        }
        boundaries = {name: Grasp(vertices.tolist()) for name, vertices in self.gripped_vertices.items()}
        table = Plane(friction=TABLE_FRICTION, offset=INITIAL_LAYER_DISTANCE_M / 2)
        boundaries = {**boundaries, "table": table}
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "contact: .* over another layer")  # see the module's docstring
            contact = Contact.with_gap(self.fine.gap)
            return tc.Cloth(self.mesh, law, DEFAULT_AREAL_DENSITY_KG_PER_M2, effects, boundaries, contact)

    def _grips(self, made: Mesh) -> dict[str, np.ndarray]:
        """Return the centre [3] m of each gripper's pad in the garment's frame."""
        inwards, lower = GRIPS[self.what.grip]
        places = [made.vertices[made.places[place]].mean(0) for place in self.garment.grips]
        middle = (places[0] + places[1]) / 2
        shifts = [inwards * (middle - place) - [0.0, lower * self.length, 0.0] for place in places]
        return {name: place + s for name, place, s in zip(("left", "right"), places, shifts, strict=True)}

    def _placed(self, points: np.ndarray) -> np.ndarray:
        """Transform points [N, 3] m from the garment's frame to the world: hanging by its grips, or on the table.

        +x points away from the arms. The gripped end is up, or towards the arms. The body is turned about the vertical.
        """
        x, y, z = points.T
        z = z * (INITIAL_LAYER_DISTANCE_M / (meshes.garments.GARMENT_GAP_M * self.garment.scale))
        if self.hangs:
            forward, side, up = z, x, MIN_HANGING_HEIGHT_M + self.length / 2 + y
        else:
            forward, side, up = self.length / 2 - y, x, z + 1.5 * INITIAL_LAYER_DISTANCE_M
        turn = POSTURES[self.what.posture]
        near = {"drag": 0.46, "cover": 0.36, "fling": 0.50, CARRY: 0.50}[self.what.action]
        return np.stack(
            [
                near + math.cos(turn) * forward - math.sin(turn) * side,
                math.sin(turn) * forward + math.cos(turn) * side,
                up,
            ],
            axis=-1,
        )

    def _action(self, grips: dict[str, tuple[float, ...]]) -> Action:
        """Return the action: towards the arms for drag, away from them for all others."""
        speed = SPEEDS[self.what.speed] / self.what.slower
        limits = GripperLimits(speed, 8.0 * speed**2)
        if self.what.action == CARRY:
            moves = [Move(CARRY_SHIFT_M)]
            return build_action(grips, moves, heading=0.0, rest=REST_TIME_S, limits=limits, release=False)
        if self.what.action == "fling":
            return primitives.fling(grips, 0.12, heading=0.0, pull=0.15, landing=0.05, rest=REST_TIME_S, limits=limits)
        if self.what.action == "drag":
            return primitives.drag(grips, 0.15, heading=math.pi, landing=0.02, rest=REST_TIME_S, limits=limits)
        reach = 0.75 * self.length
        return primitives.cover(grips, reach, heading=0.0, landing=2 * self.fine.gap, rest=REST_TIME_S, limits=limits)


def slowed(what: Manipulation, length: float, fine: Discretisation) -> Manipulation:
    """Return the manipulation with slower grippers, so that it takes ``length`` seconds.

    Raises:
        InvalidInput: it takes longer already.
    """
    lasts = min(float(path.t[-1]) for path in Scene(what, fine).action.motion.values())
    if length < lasts:
        raise InvalidInput("--length", got=f"{length:g} s", expected=f"{lasts:.2f} s or more")
    return replace(what, slower=what.slower * (length - REST_TIME_S) / (lasts - REST_TIME_S))
