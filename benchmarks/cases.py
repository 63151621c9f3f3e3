"""Cases of the benchmark: the same scenes for every contestant, in float32."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

import torchcloth as tc
from torchcloth.effects import AbstractEffect, AirDrag, Bending, Gravity
from torchcloth.errors import InvalidInput
from torchcloth.meshes import Mesh
from torchcloth.training.validation.verification.apic import (  # pyright: ignore[reportMissingImports]
    APICCloth,
)

SUBSTEP_S = 1.6e-4  # stable in every case
SUBSTEPS_PER_FRAME = 250  # 25 frames a second
CELL_SIZE_M = 0.025  # of the standard sheet; also the spacing of its contact grid
STANDARD_SHEET_SIDE_M = 0.5
SWING_M, SWING_PERIOD_S = 0.2, 1.0  # of the hands, from one end to the other
HAND_KNOT_INTERVAL_S = 0.02  # between poses of a gripper
AREAL_DENSITY_KG_PER_M2 = 0.15
MATERIAL = {  # a cotton: E h = 609 N/m, and contact as soft as folding needs
    "youngs_modulus": 609e3,
    "poisson_ratio": 0.3,
    "contact_stiffness": 5e4,
    "shear_stiffness": 2e4,
    "cone": 0.3,
}


class HandPath(NamedTuple):
    """Motion of the gripped vertices.

    Attributes:
        swing: m, oscillation from one end to the other.
        lift: m, rise in the first second.
    """

    swing: tuple[float, float, float] = (0.0, 0.0, 0.0)
    lift: float = 0.0

    def displacement(self, t: Tensor) -> Tensor:
        """Return the displacement [..., 3] m at times [...] s; the motion starts at rest."""
        fraction = (1 - torch.cos(2 * math.pi * t / SWING_PERIOD_S)) / 2
        rise = (1 - torch.cos(math.pi * t.clamp(max=1.0))) / 2
        up = torch.tensor([0.0, 0.0, self.lift], dtype=t.dtype)
        return fraction.unsqueeze(-1) * torch.tensor(self.swing, dtype=t.dtype) + rise.unsqueeze(-1) * up


@dataclass(frozen=True, eq=False)
class Case:
    """A scene.

    Attributes:
        name: of the case.
        mesh: of the cloth.
        grips: vertices by gripper; all grippers follow ``path``.
        path: motion of the grippers.
        contact: contact between layers; None without.
        effects: returns the effects.
        cloth_type: class of the cloth.
        boundaries: returns boundaries beside the grippers.
        expected_warning: pattern of a warning that the cloth gives, and that this scene means.
    """

    name: str
    mesh: Mesh
    grips: dict[str, list[int]]
    path: HandPath
    contact: tc.Contact | None
    effects: Callable[[], dict[str, AbstractEffect]]
    cloth_type: type[tc.Cloth] = tc.Cloth
    boundaries: Callable[[], dict[str, tc.boundaries.AbstractBoundary]] = field(default=dict)
    expected_warning: str | None = None

    @property
    def triangles(self) -> int:
        """Number of triangles of the mesh."""
        return len(self.mesh.faces)

    @property
    def gripped_vertices(self) -> list[int]:
        """Sorted vertices of all grippers."""
        return sorted(v for group in self.grips.values() for v in group)

    def displacements(self, substeps: int) -> np.ndarray:
        """Return the displacement of the grippers in each substep [substeps, 3] m, in float64."""
        _, motion = gripper_motion(self, substeps, torch.float64)
        times = torch.arange(substeps + 1, dtype=torch.float64) * SUBSTEP_S
        pose = tc.boundaries.motion.interpolate_poses(next(iter(motion.values())), times)
        return np.diff(pose[:, :3, 3].numpy(), axis=0)


class Scene(NamedTuple):
    """A case ready to run.

    Attributes:
        cloth: the cloth.
        x: [V, 3] or [batch, V, 3] m, initial positions.
        motion: trajectories of the grippers.
        times: s, of the frames.
    """

    cloth: tc.Cloth
    x: Tensor
    motion: dict[str, tc.Trajectory]
    times: list[float]


def make_case(name: str, small: bool = False) -> Case:
    """Return a case by name; ``sheet-N`` is a single square sheet of about N triangles with the standard edge.

    ``small``: the same scene on a mesh so small that it shows only whether a contestant works.

    Raises:
        InvalidInput: there is no such case.
    """
    if name.startswith("sheet-") and name.removeprefix("sheet-").isdigit():
        cells = max(2, round(math.sqrt(int(name.removeprefix("sheet-")) / 2)))
        return _hanging_sheet(name, min(cells, SMALL_CELLS) if small else cells, None)
    if name not in CASES:
        raise InvalidInput("case", got=repr(name), expected=f"one of {', '.join(CASES)}, sheet-N")
    return CASES[name](small)


def engines() -> list[str]:
    """Return the engines of the installed torchcloth, the fastest first."""
    return ["fused", "reference"]


def make_cloth(case: Case, engine: str) -> tc.Cloth:
    """Return the cloth of a case with an engine.

    Raises:
        InvalidInput: this torchcloth does not have the engine.
    """
    if engine not in engines():
        raise InvalidInput("engine", got=repr(engine), expected=f"one of {', '.join(engines())}")
    grasps = {name: tc.boundaries.Grasp(vertices) for name, vertices in case.grips.items()}
    with warnings.catch_warnings():
        if case.expected_warning is not None:
            warnings.filterwarnings("ignore", case.expected_warning)
        return case.cloth_type(
            case.mesh,
            tc.materials.AEP(**MATERIAL),  # type: ignore[arg-type]
            AREAL_DENSITY_KG_PER_M2,
            case.effects(),
            {**case.boundaries(), **grasps},
            case.contact,
            engine,  # type: ignore[arg-type]
        )


def build_scene(case: Case, engine: str, substeps: int, batch: int = 0) -> Scene:
    """Return cloth, initial positions and motion for ``substeps`` substeps; ``batch`` copies, 0: no batch dimension.

    The copies differ slightly, so that no contestant can share work between them.
    """
    cloth = make_cloth(case, engine)
    dtype = torch.get_default_dtype()
    x = torch.as_tensor(case.mesh.vertices, dtype=dtype)
    if batch:
        x = x * (1 + 1e-4 * torch.arange(batch, dtype=dtype)[:, None, None])
    times, motion = gripper_motion(case, substeps, dtype)
    return Scene(cloth, x, motion, times)


def gripper_motion(case: Case, substeps: int, dtype: torch.dtype) -> tuple[list[float], dict[str, tc.Trajectory]]:
    """Return frame times that give exactly this many substeps of SUBSTEP_S, and the trajectories."""
    marks = [*range(0, substeps, SUBSTEPS_PER_FRAME), substeps]
    knots = (
        torch.arange(math.ceil(substeps * SUBSTEP_S / HAND_KNOT_INTERVAL_S) + 2, dtype=torch.float64)
        * HAND_KNOT_INTERVAL_S
    )
    shift = case.path.displacement(knots)
    motion = {}
    for name, vertices in case.grips.items():
        pose = torch.eye(4, dtype=torch.float64).repeat(len(knots), 1, 1)
        pose[:, :3, 3] = shift + torch.as_tensor(case.mesh.vertices[vertices].mean(0))
        motion[name] = tc.Trajectory(knots, pose.to(dtype), torch.ones(len(knots), dtype=torch.bool))
    return [mark * SUBSTEP_S for mark in marks], motion


def _gravity_only() -> dict[str, AbstractEffect]:
    return {"gravity": Gravity()}


def _typical_effects() -> dict[str, AbstractEffect]:
    return {"gravity": Gravity(), "air": AirDrag(), "bending": Bending(1e-5, 2e-3)}


def _hanging_sheet(
    name: str,
    cells: int,
    contact: tc.Contact | None,
    effects: Callable[[], dict[str, AbstractEffect]] = _gravity_only,
    cloth_type: type[tc.Cloth] = tc.Cloth,
) -> Case:
    """Return a square sheet in the xz plane that hangs from its two upper corners and swings along y."""
    flat = tc.meshes.rectangle(cells * CELL_SIZE_M, cells * CELL_SIZE_M, resolution=(cells + 1, cells + 1))
    u, w, _ = flat.vertices.T
    mesh = Mesh.build(np.column_stack([u - cells * CELL_SIZE_M / 2, np.zeros_like(u), w]), flat.faces, flat.uv)
    top = mesh.vertices[:, 2] > w.max() - 1e-9
    left, right = (int(np.flatnonzero(top & (mesh.vertices[:, 0] == x))[0]) for x in np.ptp(u) * np.array([-0.5, 0.5]))
    hands = {"left": [left], "right": [right]}
    return Case(name, mesh, hands, HandPath((0.0, SWING_M, 0.0)), contact, effects, cloth_type)


def _garment(small: bool) -> Case:
    """Return a shirt on a table that one shoulder lifts.

    It measures what a shirt costs with the default contact grid, whose spacing is the mesh's edge. At that spacing 77 %
    of the triangles (all of the small mesh) that lie over the other layer do not see it, because the layers are joined
    at seams nearby. ``Contact.with_gap(0.03)`` would let the layers press on each other, at 1.4 times the time of a
    forward run; published times of this case would then change.
    """
    mesh = tc.meshes.shirt(triangles=150) if small else tc.meshes.shirt()
    return Case(
        "garment",
        mesh,
        {"hand": np.asarray(mesh.vertices_at_place("left shoulder", 0.03)).tolist()},
        HandPath(lift=0.4),
        tc.Contact(),
        _typical_effects,
        boundaries=lambda: {"table": tc.boundaries.Plane([0.0, 0.0, -0.03], [0.0, 0.0, 1.0], 0.4)},
        expected_warning="contact: .* do not see it",
    )


def _standard(name: str, contact: tc.Contact, **options) -> Callable[[bool], Case]:
    return lambda small: _hanging_sheet(
        name, SMALL_CELLS if small else round(STANDARD_SHEET_SIDE_M / CELL_SIZE_M), contact, **options
    )


SMALL_CELLS = 4  # along a side of a small sheet
EVERYWHERE_CONTACT = tc.Contact(spacing=CELL_SIZE_M, everywhere=True, subdivisions=1, free_compression=0.0, damping=0.0)
DEFAULT_CONTACT = tc.Contact(spacing=CELL_SIZE_M)
CASES: dict[str, Callable[[bool], Case]] = {
    "standard-everywhere": _standard("standard-everywhere", EVERYWHERE_CONTACT),
    "standard": _standard("standard", DEFAULT_CONTACT),
    "standard-usual": _standard("standard-usual", DEFAULT_CONTACT, effects=_typical_effects),
    "standard-apic": _standard("standard-apic", DEFAULT_CONTACT, cloth_type=APICCloth),
    "garment": _garment,
}
