"""Scenes of the ablation: three garments and three actions, with scaled parameters.

Contact acts only in part of these scenes. It ignores triangles that are less than 10 spacings and 3 edges apart along
the cloth. For garments of half size this is 0.2 m at 1500 triangles, 0.4 m at 300 and 0.6 m at 150. Over the side seam,
front and back of a garment are nearer than that, so they pass through each other. Folds that are farther apart touch.
A finer mesh or grid would let all layers touch. It would cost several times as much and change the published numbers,
so the scenes stay as they are. The library's warning is suppressed here; the report names scenes without any contact.
"""

from __future__ import annotations

import math
import warnings
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
from torchcloth.dynamics.contact.grid import MAX_POINT_DISTANCE_SPACINGS, REST_GAP_SPACINGS
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
from torchcloth.synthesis.initial_scene import INITIAL_LAYER_DISTANCE_M

from .measures import energies_without_each, scaled_poisson

LEVELS = (25, 50, 75, 125, 150, 175)  # % of the reference
PARAMETERS = {"E": "youngs_modulus", "nu": "poisson_ratio", "k": "contact_stiffness", "gamma": "shear_stiffness"}
ACTIONS = ("fling", "drag", "cover")
PERTURBATION_STD_M = 1e-6  # of each coordinate of the start in the perturbed run
ABLATION_FRAME_PERIOD_S = 0.05
ASSUMPTIONS = "the paths, air (C_n 1.2), bending (1e-5 N m), table friction 0.4, c_F 0.3"
NEGLIGIBLE_FACTOR = 1e-9  # removes a stiffness


class Garment(NamedTuple):
    """A garment, its fabric and its grips.

    Attributes:
        mesh: function that builds the mesh, with argument ``triangles``.
        preset: name of the fabric.
        grips: place on the mesh for each gripper.
    """

    mesh: Callable[..., Mesh]
    preset: str
    grips: dict[str, str]


GARMENTS = {
    "dress": Garment(meshes.dress, "dress", {"left": "left shoulder", "right": "right shoulder"}),
    "trousers": Garment(meshes.trousers, "pants", {"left": "left waist corner", "right": "right waist corner"}),
    "shirt": Garment(meshes.shirt, "shirt", {"left": "left shoulder", "right": "right shoulder"}),
}


class Variant(NamedTuple):
    """One run of a scene.

    Attributes:
        parameter: that is scaled; or "reference", "perturbed" or "corotated".
        level: of the parameter [%].
    """

    parameter: str
    level: int = 100

    @property
    def name(self) -> str:
        """Name of the run's file."""
        return self.parameter if self.level == 100 else f"{self.parameter}-{self.level:03d}"

    def factors(self) -> dict[str, float]:
        """Return the factor of each scaled parameter (of nu in its unbounded form)."""
        if self.parameter == "corotated":
            return {"k": NEGLIGIBLE_FACTOR, "gamma": NEGLIGIBLE_FACTOR}
        return {self.parameter: self.level / 100} if self.parameter in PARAMETERS else {}


# Not in the paper's table: a perturbed start, and k = gamma = 0, which leaves the fixed-corotated membrane.
REFERENCE, PERTURBED, COROTATED = Variant("reference"), Variant("perturbed"), Variant("corotated")


@dataclass(frozen=True)
class Setup:
    """Settings that all runs of a study share.

    Attributes:
        triangles: approximate number for each garment.
        scale: of all lengths and speeds, not of time; 0.5 in the paper.
        spacing: of the contact grid [m]; None: the widest that one contact point per triangle allows.
        pace: of the grippers; 1 means at most 1 m/s and 5 m/s^2 at full scale.
        everywhere: whether contact acts at all triangles at all times, as in material point methods; k then stiffens
            single sheets, too.
        areal_density: [kg/m^2]; the paper gives none.

    Raises:
        InvalidInput: a number is not finite and positive.
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
    """Result of a run.

    Attributes:
        t: [T] s.
        x: [T, V, 3] m, float32.
        energy: [T] J, "total" and without each of ``LEFT_OUT_TERMS``.
    """

    t: np.ndarray
    x: np.ndarray
    energy: dict[str, np.ndarray]


class Scene:
    """One garment and one action."""

    def __init__(self, setup: Setup, garment: str, action: str) -> None:
        self.setup, self.garment = setup, GARMENTS[garment]
        garment_mesh = self.garment.mesh(triangles=setup.triangles)
        pattern = setup.scale * np.asarray(garment_mesh.pattern)
        mesh = Mesh.build(setup.scale * garment_mesh.vertices, garment_mesh.faces, pattern, garment_mesh.places)
        self.spacing = mesh.mean_edge / MAX_POINT_DISTANCE_SPACINGS if setup.spacing is None else setup.spacing
        self.start = self._place(mesh, hanging=action == "fling")
        self.mesh = Mesh.build(self.start, mesh.faces, mesh.pattern, mesh.places)
        grips = {name: self.start[self.mesh.places[place]].mean(0) for name, place in self.garment.grips.items()}
        self.action = self._action(action, {name: tuple(map(float, at)) for name, at in grips.items()})

    def _place(self, mesh: Mesh, hanging: bool) -> np.ndarray:
        """Return vertices [V, 3] m on the table, or hanging above it; the directors start without stress."""
        x = mesh.vertices.copy()
        x[:, 2] *= INITIAL_LAYER_DISTANCE_M / np.ptp(x[:, 2])
        if hanging:
            x = np.stack([x[:, 0], -x[:, 2], x[:, 1]], axis=-1)
            x[:, 2] += 0.15 * self.setup.scale - x[:, 2].min()
        else:
            x[:, 2] += INITIAL_LAYER_DISTANCE_M / 2 - x[:, 2].min()
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
        """Build the garment with the parameters of each variant, as a batch."""
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "contact: .* over another layer")  # see the module's docstring
            return self._build(variants)

    def _build(self, variants: list[Variant]) -> tc.Cloth:
        return tc.Cloth(
            self.mesh,
            AEP(**self._parameters(variants), convention="paper"),
            self.setup.areal_density,
            {"gravity": Gravity(), "air": AirDrag(), "bending": Bending(1e-5, damping_time=0.03)},
            {name: Grasp.at(place, radius=0.03 * self.setup.scale) for name, place in self.garment.grips.items()}
            | {"table": Plane(friction=0.4, offset=INITIAL_LAYER_DISTANCE_M / 2)},
            Contact(self.spacing, everywhere=self.setup.everywhere),
        )

    def _parameters(self, variants: list[Variant]) -> dict[str, Any]:
        values = find_fabric(self.garment.preset).isotropic()
        for short, name in PARAMETERS.items():
            factors = [variant.factors().get(short, 1.0) for variant in variants]
            scaled = [scaled_poisson(values[name], f) if short == "nu" else values[name] * f for f in factors]
            values[name] = torch.tensor(scaled, dtype=torch.get_default_dtype()).unsqueeze(-1)
        return values

    def stable_step_of_all(self) -> float:
        """Return one substep [s] for all runs, stable with all parameters at their highest level."""
        values = find_fabric(self.garment.preset).isotropic()
        highest = LEVELS[-1] / 100
        for short, name in PARAMETERS.items():
            values[name] = scaled_poisson(values[name], highest) if short == "nu" else highest * values[name]
        cloth = self.cloth([REFERENCE])
        cloth.material = AEP(**values, convention="paper")
        return cloth.stable_step()

    def frame_times(self) -> list[float]:
        """Return the times [s] of the stored frames."""
        count = max(1, round(self.action.duration / ABLATION_FRAME_PERIOD_S))
        return np.linspace(0, self.action.duration, count + 1).tolist()

    @torch.no_grad()
    def simulate(self, variants: list[Variant]) -> Iterator[tuple[float, list[Run]]]:
        """Simulate a batch; yields (fraction done, []) after each frame, and finally (1, one run for each variant)."""
        cloth, dt, frame_times = self.cloth(variants), self.stable_step_of_all(), self.frame_times()
        model = cloth.build_model()
        state = cloth.state(self._starts(cloth, variants))
        positions, energy = [state.x], [energies_without_each(model, state)]
        for i in range(1, len(frame_times)):
            state = cloth(state, self.action.motion, frame_times[i - 1 : i + 1], dt=dt, checkpoint=False).state
            positions.append(state.x)
            energy.append(energies_without_each(model, state))
            if i < len(frame_times) - 1:
                yield i / (len(frame_times) - 1), []
        yield 1.0, [self._run(frame_times, positions, energy, row) for row in range(len(variants))]

    def _starts(self, cloth: tc.Cloth, variants: list[Variant]) -> Tensor:
        x = cloth.rest_state().x.expand(len(variants), -1, -1).clone()
        noise = torch.randn(x.shape[1:], generator=torch.Generator().manual_seed(0), dtype=x.dtype)
        for row, variant in zip(x, variants, strict=True):
            if variant == PERTURBED:
                row += PERTURBATION_STD_M * noise
        return x

    @staticmethod
    def _run(frame_times: list[float], positions: list[Tensor], energy: list[dict[str, Tensor]], row: int) -> Run:
        x = torch.stack([x[row] for x in positions]).numpy().astype(np.float32)
        series = {key: np.array([float(e[key].expand(len(positions[0]))[row]) for e in energy]) for key in energy[0]}
        return Run(np.array(frame_times), x, series)


def list_variants(levels: tuple[int, ...]) -> list[Variant]:
    """Return all runs of a scene, the reference first."""
    return [
        REFERENCE,
        PERTURBED,
        COROTATED,
        *(Variant(p, level) for p in PARAMETERS for level in levels),
    ]
