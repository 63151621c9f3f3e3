"""The ablation's scenes: three garments x three actions, each with the paper's parameters scaled."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

import torchcloth as tc
from torchcloth import meshes
from torchcloth.boundaries import Grasp, Plane
from torchcloth.dynamics.contact import Contact
from torchcloth.dynamics.contact.grid import REST_GAP_SPACINGS, MAX_POINT_DISTANCE_SPACINGS
from torchcloth.effects import AirDrag, Bending, Gravity
from torchcloth.errors import InvalidInput
from torchcloth.materials import AEP
from torchcloth.materials.presets import find_fabric
from torchcloth.meshes import Mesh
from torchcloth.robots.primitives import (  # pyright: ignore[reportMissingImports] - mapped from robots/
    Action,
    GripperLimits,
    cover,
    drag,
    fling,
)

from .measures import energies, scaled_poisson

LEVELS = (25, 50, 75, 125, 150, 175)  # % of the reference
PARAMETERS = {"E": "youngs_modulus", "nu": "poisson_ratio", "k": "contact_stiffness", "gamma": "shear_stiffness"}
ACTIONS = ("fling", "drag", "cover")
TRIFLE = 1e-6  # m, normal deviate of every vertex's start in the perturbed run
FRAME = 0.05  # s
LAYERS = 1e-3  # m between front and back at the start: the thickness of the presets; flat, hence unstrained
ASSUMED = "the paths, air (C_n 1.2), bending (1e-5 N m), table friction 0.4, c_F 0.3"
NOTHING = 1e-9  # factor that takes a stiffness out


class Garment(NamedTuple):
    """What is worn, of what, and where it is gripped."""

    mesh: Callable[..., Mesh]
    preset: str
    grips: dict[str, str]


GARMENTS = {
    "dress": Garment(meshes.dress, "dress", {"left": "left shoulder", "right": "right shoulder"}),
    "trousers": Garment(meshes.trousers, "pants", {"left": "left waist corner", "right": "right waist corner"}),
    "shirt": Garment(meshes.shirt, "shirt", {"left": "left shoulder", "right": "right shoulder"}),
}


class Variant(NamedTuple):
    """One run of a scene: a parameter at a level [%], or one of the runs beside the table (level 100)."""

    parameter: str
    level: int = 100

    @property
    def name(self) -> str:
        """Of its file."""
        return self.parameter if self.level == 100 else f"{self.parameter}-{self.level:03d}"

    def factors(self) -> dict[str, float]:
        """What each parameter is multiplied with (nu: after rescaling)."""
        if self.parameter == "corotated":
            return {"k": NOTHING, "gamma": NOTHING}
        return {self.parameter: self.level / 100} if self.parameter in PARAMETERS else {}


# Beside the table: a start moved by TRIFLE, and k = gamma = 0, which leaves the fixed-corotated membrane.
REFERENCE, PERTURBED, COROTATED = Variant("reference"), Variant("perturbed"), Variant("corotated")


@dataclass(frozen=True)
class Setup:
    """What all runs of a study share.

    Args:
        triangles: of each garment, about.
        scale: of the scene; lengths, and with them speeds, shrink, the clock stays. The paper's 0.5.
        spacing: of the contact grid [m]; None: the widest that one contact point per triangle allows.
        pace: of the grippers, 1 for at most 1 m/s and 5 m/s^2 at full scale.
        everywhere: contact at all triangles always, as in material point methods; k then stiffens single sheets, too.
        areal_density: [kg/m^2]; the paper gives none.
    """

    triangles: int = 1500
    scale: float = 0.5
    spacing: float | None = None
    pace: float = 1.0
    everywhere: bool = False
    areal_density: float = 0.2

    def __post_init__(self) -> None:
        for name in ("triangles", "scale", "spacing", "pace", "areal_density"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0):
                raise InvalidInput(name, got=f"{value:g}", expected="a finite value > 0")


class Run(NamedTuple):
    """What a run leaves."""

    t: np.ndarray  # [T] s
    x: np.ndarray  # [T, V, 3] m, float32
    energy: dict[str, np.ndarray]  # [T] J by "total" and ``WITHOUT``


class Scene:
    """One garment and one action."""

    def __init__(self, setup: Setup, garment: str, action: str) -> None:
        self.setup, self.garment = setup, GARMENTS[garment]
        made = self.garment.mesh(triangles=setup.triangles)
        pattern = setup.scale * np.asarray(made.pattern)
        mesh = Mesh.build(setup.scale * made.vertices, made.faces, pattern, made.places)
        self.spacing = mesh.mean_edge / MAX_POINT_DISTANCE_SPACINGS if setup.spacing is None else setup.spacing
        self.start = self._placed(mesh, hanging=action == "fling")
        self.mesh = Mesh.build(self.start, mesh.faces, mesh.pattern, mesh.places)
        grips = {name: self.start[self.mesh.places[place]].mean(0) for name, place in self.garment.grips.items()}
        self.action = self._action(action, {name: tuple(map(float, at)) for name, at in grips.items()})

    def _placed(self, mesh: Mesh, hanging: bool) -> np.ndarray:
        """[V, 3] m: on the table, or hanging above it. The directors start free of stress, whatever the distance."""
        x = mesh.vertices.copy()
        x[:, 2] *= LAYERS / np.ptp(x[:, 2])
        if hanging:
            x = np.stack([x[:, 0], -x[:, 2], x[:, 1]], axis=-1)
            x[:, 2] += 0.15 * self.setup.scale - x[:, 2].min()
        else:
            x[:, 2] += LAYERS / 2 - x[:, 2].min()
        return x

    def _action(self, name: str, grips: dict[str, Any]) -> Action:
        scale, pace = self.setup.scale, self.setup.pace
        limits = GripperLimits(1.0 * scale * pace, 5.0 * scale * pace**2)
        low, high = 0.02 * scale, 0.05 * scale
        if name == "fling":
            return fling(grips, 0.3 * scale, pull=0.3 * scale, landing=high, rest=0.4 / pace, limits=limits)
        if name == "drag":
            return drag(grips, 0.3 * scale, height=high, landing=low, rest=0.3 / pace, limits=limits)
        reach = 0.75 * float(np.ptp(self.start[:, 1]))
        return cover(grips, reach, landing=2 * REST_GAP_SPACINGS * self.spacing, rest=0.4 / pace, limits=limits)

    def cloth(self, variants: list[Variant]) -> tc.Cloth:
        """The garment with the parameters of each variant, as a batch."""
        return tc.Cloth(
            self.mesh,
            AEP(**self._parameters(variants), convention="paper"),
            self.setup.areal_density,
            {"gravity": Gravity(), "air": AirDrag(), "bending": Bending(1e-5, damping_time=0.03)},
            {name: Grasp.at(place, radius=0.03 * self.setup.scale) for name, place in self.garment.grips.items()}
            | {"table": Plane(friction=0.4, offset=LAYERS / 2)},
            Contact(self.spacing, everywhere=self.setup.everywhere),
        )

    def _parameters(self, variants: list[Variant]) -> dict[str, Any]:
        values = find_fabric(self.garment.preset).isotropic()
        for short, name in PARAMETERS.items():
            factors = [variant.factors().get(short, 1.0) for variant in variants]
            scaled = [scaled_poisson(values[name], f) if short == "nu" else values[name] * f for f in factors]
            values[name] = torch.tensor(scaled, dtype=torch.get_default_dtype()).unsqueeze(-1)
        return values

    def step(self) -> float:
        """One substep [s] for every run, stable with all parameters at once at their highest level."""
        values = find_fabric(self.garment.preset).isotropic()
        highest = LEVELS[-1] / 100
        for short, name in PARAMETERS.items():
            values[name] = scaled_poisson(values[name], highest) if short == "nu" else highest * values[name]
        cloth = self.cloth([REFERENCE])
        cloth.material = AEP(**values, convention="paper")
        return cloth.stable_step()

    def frames(self) -> list[float]:
        """Times [s] of what is kept."""
        count = max(1, round(self.action.duration / FRAME))
        return np.linspace(0, self.action.duration, count + 1).tolist()

    @torch.no_grad()
    def simulate(self, variants: list[Variant]) -> Iterator[tuple[float, list[Run]]]:
        """Yields (share done, []) after each frame, at last (1, a run for each variant)."""
        cloth, dt, frames = self.cloth(variants), self.step(), self.frames()
        model = cloth.build_model()
        state = cloth.state(self._starts(cloth, variants))
        kept, energy = [state.x], [energies(model, state)]
        for i in range(1, len(frames)):
            state = cloth(state, self.action.motion, frames[i - 1 : i + 1], dt=dt, checkpoint=False).state
            kept.append(state.x)
            energy.append(energies(model, state))
            if i < len(frames) - 1:
                yield i / (len(frames) - 1), []
        yield 1.0, [self._run(frames, kept, energy, b) for b in range(len(variants))]

    def _starts(self, cloth: tc.Cloth, variants: list[Variant]) -> Tensor:
        x = cloth.rest_state().x.expand(len(variants), -1, -1).clone()
        noise = torch.randn(x.shape[1:], generator=torch.Generator().manual_seed(0), dtype=x.dtype)
        for row, variant in zip(x, variants, strict=True):
            if variant == PERTURBED:
                row += TRIFLE * noise
        return x

    @staticmethod
    def _run(frames: list[float], kept: list[Tensor], energy: list[dict[str, Tensor]], b: int) -> Run:
        x = torch.stack([x[b] for x in kept]).numpy().astype(np.float32)
        series = {key: np.array([float(e[key].expand(len(kept[0]))[b]) for e in energy]) for key in energy[0]}
        return Run(np.array(frames), x, series)


def variants(levels: tuple[int, ...]) -> list[Variant]:
    """All runs of a scene, the reference first."""
    return [  # Beside the table: a start moved by TRIFLE, and k = gamma = 0, which leaves the fixed-corotated membrane.
        REFERENCE,
        PERTURBED,
        COROTATED,
        *(Variant(p, level) for p in PARAMETERS for level in levels),
    ]
