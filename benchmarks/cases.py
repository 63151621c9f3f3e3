"""What is simulated: the same scenes for every contestant, in float32."""

from __future__ import annotations

import math
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
from torchcloth.training.validation.verification.apic import APICCloth

DT = 1.6e-4  # s, every case is stable with it
FRAME = 250  # substeps between frames: 25 frames a second
SPACING = 0.025  # m, edge of the standard sheet's cells and spacing of its contact grid
SIDE = 0.5  # m, of the standard sheet
SWING, PERIOD = 0.2, 1.0  # m from one end to the other, s
DENSITY = 0.15  # kg/m^2
MATERIAL = {  # a cotton: E h = 609 N/m, and contact as soft as folding needs
    "youngs_modulus": 609e3,
    "poisson_ratio": 0.3,
    "contact_stiffness": 5e4,
    "shear_stiffness": 2e4,
    "cone": 0.3,
}


class Path(NamedTuple):
    """How held vertices move: back and forth along ``swing``, and up by ``lift`` in the first second."""

    swing: tuple[float, float, float] = (0.0, 0.0, 0.0)  # m, from one end to the other
    lift: float = 0.0  # m

    def at(self, t: Tensor) -> Tensor:
        """Displacement [..., 3] m at times [...] s; starts at rest."""
        share = (1 - torch.cos(2 * math.pi * t / PERIOD)) / 2
        rise = (1 - torch.cos(math.pi * t.clamp(max=1.0))) / 2
        up = torch.tensor([0.0, 0.0, self.lift], dtype=t.dtype)
        return share.unsqueeze(-1) * torch.tensor(self.swing, dtype=t.dtype) + rise.unsqueeze(-1) * up


@dataclass(frozen=True, eq=False)
class Case:
    """One scene; ``held`` names the grippers, all of which follow ``path``."""

    name: str
    mesh: Mesh
    held: dict[str, list[int]]
    path: Path
    contact: tc.Contact | None
    effects: Callable[[], dict[str, AbstractEffect]]
    cloth_type: type[tc.Cloth] = tc.Cloth
    boundaries: Callable[[], dict[str, tc.boundaries.AbstractBoundary]] = field(default=dict)

    @property
    def triangles(self) -> int:
        """How many."""
        return len(self.mesh.faces)

    @property
    def fixed(self) -> list[int]:
        """Vertices that grippers hold."""
        return sorted(v for group in self.held.values() for v in group)

    def displacements(self, substeps: int) -> np.ndarray:
        """Of the grippers during each substep [substeps, 3] m, in float64: what torchcloth's drives do."""
        _, motion = grippers(self, substeps, torch.float64)
        times = torch.arange(substeps + 1, dtype=torch.float64) * DT
        pose = tc.boundaries.motion.interpolate(next(iter(motion.values())), times)
        return np.diff(pose[:, :3, 3].numpy(), axis=0)


class Scene(NamedTuple):
    """A case ready to run."""

    cloth: tc.Cloth
    x: Tensor  # [V, 3] or [batch, V, 3] m
    motion: dict[str, tc.Trajectory]
    times: list[float]  # s, of the frames


def make(name: str, small: bool = False) -> Case:
    """A case by name; ``sheet-N`` is a lone square sheet of about N triangles with the standard edge.

    ``small``: the same scene on a mesh that shows whether things work, not how fast.

    Raises:
        InvalidInput: no such case.
    """
    if name.startswith("sheet-") and name.removeprefix("sheet-").isdigit():
        cells = max(2, round(math.sqrt(int(name.removeprefix("sheet-")) / 2)))
        return _hanging(name, min(cells, SMALL) if small else cells, None)
    if name not in CASES:
        raise InvalidInput("case", got=repr(name), expected=f"one of {', '.join(CASES)}, sheet-N")
    return CASES[name](small)


def engines() -> list[str]:
    """Engines of the installed torchcloth, the best first."""
    return ["fused", "reference"]


def make_cloth(case: Case, engine: str) -> tc.Cloth:
    """The layer with an engine.

    Raises:
        InvalidInput: an engine that this torchcloth does not have.
    """
    if engine not in engines():
        raise InvalidInput("engine", got=repr(engine), expected=f"one of {', '.join(engines())}")
    grasps = {name: tc.boundaries.Grasp(vertices) for name, vertices in case.held.items()}
    return case.cloth_type(
        case.mesh,
        tc.materials.AEP(**MATERIAL),  # type: ignore[arg-type]
        DENSITY,
        case.effects(),
        {**case.boundaries(), **grasps},
        case.contact,
        engine,  # type: ignore[arg-type]
    )


def stage(case: Case, engine: str, substeps: int, batch: int = 0) -> Scene:
    """Cloth, initial positions and motion for ``substeps`` substeps; ``batch`` copies, 0: no batch dimension.

    The copies differ slightly, so that no contestant can share work between them.
    """
    cloth = make_cloth(case, engine)
    dtype = torch.get_default_dtype()
    x = torch.as_tensor(case.mesh.vertices, dtype=dtype)
    if batch:
        x = x * (1 + 1e-4 * torch.arange(batch, dtype=dtype)[:, None, None])
    times, motion = grippers(case, substeps, dtype)
    return Scene(cloth, x, motion, times)


def grippers(case: Case, substeps: int, dtype: torch.dtype) -> tuple[list[float], dict[str, tc.Trajectory]]:
    """Frame times that give exactly this many substeps of DT, and the trajectories."""
    marks = [*range(0, substeps, FRAME), substeps]
    knots = torch.arange(math.ceil(substeps * DT / 0.02) + 2, dtype=torch.float64) * 0.02
    shift = case.path.at(knots)
    motion = {}
    for name, vertices in case.held.items():
        pose = torch.eye(4, dtype=torch.float64).repeat(len(knots), 1, 1)
        pose[:, :3, 3] = shift + torch.as_tensor(case.mesh.vertices[vertices].mean(0))
        motion[name] = tc.Trajectory(knots, pose.to(dtype), torch.ones(len(knots), dtype=torch.bool))
    return [mark * DT for mark in marks], motion


def _weight() -> dict[str, AbstractEffect]:
    return {"gravity": Gravity()}


def _usual() -> dict[str, AbstractEffect]:
    return {"gravity": Gravity(), "air": AirDrag(), "bending": Bending(1e-5, 2e-3)}


def _hanging(
    name: str,
    cells: int,
    contact: tc.Contact | None,
    effects: Callable[[], dict[str, AbstractEffect]] = _weight,
    cloth_type: type[tc.Cloth] = tc.Cloth,
) -> Case:
    """A square sheet in the xz plane that hangs from its two upper corners, swung along y."""
    flat = tc.meshes.rectangle(cells * SPACING, cells * SPACING, resolution=(cells + 1, cells + 1))
    u, w, _ = flat.vertices.T
    mesh = Mesh.build(np.column_stack([u - cells * SPACING / 2, np.zeros_like(u), w]), flat.faces, flat.uv)
    top = mesh.vertices[:, 2] > w.max() - 1e-9
    left, right = (int(np.flatnonzero(top & (mesh.vertices[:, 0] == x))[0]) for x in np.ptp(u) * np.array([-0.5, 0.5]))
    hands = {"left": [left], "right": [right]}
    return Case(name, mesh, hands, Path((0.0, SWING, 0.0)), contact, effects, cloth_type)


def _garment(small: bool) -> Case:
    mesh = tc.meshes.shirt(triangles=150) if small else tc.meshes.shirt()
    return Case(
        "garment",
        mesh,
        {"hand": np.asarray(mesh.around("left shoulder", 0.03)).tolist()},
        Path(lift=0.4),
        tc.Contact(),
        _usual,
        boundaries=lambda: {"table": tc.boundaries.Plane([0.0, 0.0, -0.03], [0.0, 0.0, 1.0], 0.4)},
    )


def _standard(name: str, contact: tc.Contact, **options) -> Callable[[bool], Case]:
    return lambda small: _hanging(name, SMALL if small else round(SIDE / SPACING), contact, **options)


SMALL = 4  # cells along a side
_EVERYWHERE = tc.Contact(spacing=SPACING, everywhere=True, subdivisions=1, play=0.0, damping=0.0)
_DEFAULT = tc.Contact(spacing=SPACING)
CASES: dict[str, Callable[[bool], Case]] = {
    "standard-everywhere": _standard("standard-everywhere", _EVERYWHERE),
    "standard": _standard("standard", _DEFAULT),
    "standard-usual": _standard("standard-usual", _DEFAULT, effects=_usual),
    "standard-apic": _standard("standard-apic", _DEFAULT, cloth_type=APICCloth),
    "garment": _garment,
}
