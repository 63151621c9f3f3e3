"""Deformation of a specimen of cloth in a tension machine: force and change of width from a membrane law.

Each kind of specimen has one state, or a few, each of which is the same everywhere in its part of the specimen. So it
needs no mesh and has exact derivatives. Meshes of whole clamped specimens agree within 1 % for a strip 43 widths long,
and within 2 % for bias extension with yarns 1e4 times stiffer than shear. With yarns only 100 times stiffer they
differ by 12 to 50 %, which grows with the angle (tests/identification).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from math import pi, sqrt
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.func import functional_call

from ...errors import InvalidInput, SimulationDiverged
from ...materials import AbstractMaterial
from ...recordings import ForceDisplacement
from ...types import Surface

LOAD_STEP_COUNTS = (1, 8, 64)  # tried in turn: more where the path to the equilibrium is curved
MAX_NEWTON_STEPS = 30
TRACTION_RELATIVE_TOLERANCE = 1e-10  # of the tractions on the sides, relative to their slopes
PRELOAD_STRAIN_TOLERANCE = 1e-12


class Response(NamedTuple):
    """Readings of the machine and of marks on the specimen.

    Attributes:
        force: [N] N.
        lateral_strain: [N] change of width over width.
    """

    force: Tensor
    lateral_strain: Tensor


class AbstractSpecimen(ABC):
    """A kind of specimen; it is elastic, and materials with a plastic set are refused."""

    @abstractmethod
    def respond(self, material: AbstractMaterial, c: Any, table: ForceDisplacement, strain: Tensor) -> Response:
        """Compute the response to strains [N] from the unloaded state.

        It is differentiable in the coefficients ``c`` of the material and in the strains.
        """

    def curve(self, material: AbstractMaterial, table: ForceDisplacement) -> Response:
        """Compute the response at the table's displacements, which begin at its preload.

        Raises:
            InvalidInput: a material that flows, or a specimen of another kind.
            SimulationDiverged: no equilibrium was found.
        """
        if material.initial_memory(1) is not None:
            raise InvalidInput("material", got="one with a plastic set", expected="an elastic one")
        c = material.coefficients()
        strain = torch.as_tensor(table.strain).to(c[0].dtype)
        if not table.preload:
            return self.respond(material, c, table, strain)
        preload_strain = self._preload_strain(material, c, table)  # differentiable
        response = self.respond(
            material, c, table, torch.cat([preload_strain, (1 + preload_strain) * (1 + strain) - 1])
        )
        width = 1 + response.lateral_strain
        return Response(response.force[1:], width[1:] / width[:1] - 1)

    def preload_strain(self, material: AbstractMaterial, table: ForceDisplacement) -> float:
        """Compute the strain of the specimen under its preload, from the unloaded state."""
        if not table.preload:
            return 0.0
        return float(self._preload_strain(material, material.coefficients(), table).detach())

    def _preload_strain(self, material: AbstractMaterial, c: Any, table: ForceDisplacement) -> Tensor:
        """Strain [1] under the preload: Newton's method on values, then one step that carries the derivatives."""
        fixed, strain = _values(c), torch.zeros(1, dtype=c[0].dtype)
        for _ in range(MAX_NEWTON_STEPS):
            strain = strain.detach().requires_grad_()
            with torch.enable_grad():
                force = self.respond(material, fixed, table, strain).force
                slope = torch.autograd.grad(force.sum(), strain)[0]
            step = (table.preload - force.detach()) / slope
            strain = strain.detach() + step
            if float(step.abs()) < PRELOAD_STRAIN_TOLERANCE:
                return strain + (table.preload - self.respond(material, c, table, strain).force) / slope
        raise SimulationDiverged("the specimen under its preload", got="no equilibrium", expected="one")


class Uniaxial(AbstractSpecimen):
    """A long strip, pulled along its axis x and free at its sides: uniaxial stress, F = [[1 + e, a], [0, 1 + b]].

    The shear a is free, as in the middle of a strip of many widths; clamps on a short off-axis strip hinder it.
    """

    def respond(self, material: AbstractMaterial, c: Any, table: ForceDisplacement, strain: Tensor) -> Response:
        """Compute the state in which the sides carry no traction."""
        free, slope = self._settle(material, _values(c), table.angle, strain.detach())
        free = free - torch.linalg.solve(slope, self._stress(material, c, table.angle, strain, free)[1])
        along, _ = self._stress(material, c, table.angle, strain, free)
        return Response(table.width * along, free[:, 1])

    def _settle(self, material: AbstractMaterial, c: Any, angle: float, strain: Tensor) -> tuple[Tensor, Tensor]:
        """(a, b) [N, 2] in equilibrium, and the slope [N, 2, 2] of the traction there."""
        for steps in LOAD_STEP_COUNTS:
            free = torch.zeros(len(strain), 2, dtype=strain.dtype)
            try:
                for k in range(1, steps + 1):
                    free, slope = self._relax(material, c, angle, k / steps * strain, free)
                return free, slope
            except SimulationDiverged:
                if steps == LOAD_STEP_COUNTS[-1]:
                    raise
        raise AssertionError("no load steps")

    def _relax(
        self, material: AbstractMaterial, c: Any, angle: float, strain: Tensor, free: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Newton's method from the state ``free``."""
        for _ in range(MAX_NEWTON_STEPS):
            free = free.detach().requires_grad_()
            with torch.enable_grad():
                traction = self._stress(material, c, angle, strain, free)[1]
                rows = [torch.autograd.grad(traction[:, k].sum(), free, retain_graph=True)[0] for k in (0, 1)]
            slope = torch.stack(rows, dim=1)
            free, traction = free.detach(), traction.detach()
            if float(traction.abs().max()) <= TRACTION_RELATIVE_TOLERANCE * float(slope.abs().max()):
                return free, slope
            free = free - torch.linalg.solve(slope, traction).clamp(-0.2, 0.2)
        got = f"none at a strain of {float(strain.abs().max()):.3g}"
        raise SimulationDiverged("the strip's equilibrium", got=got, expected="one")

    def _stress(
        self, material: AbstractMaterial, c: Any, angle: float, strain: Tensor, free: Tensor
    ) -> tuple[Tensor, Tensor]:
        """N/m: first Piola-Kirchhoff stress along the axis [N], and traction on the sides [N, 2]."""
        cos, sin = torch.tensor([angle]).to(strain.dtype).cos(), torch.tensor([angle]).to(strain.dtype).sin()
        zero = torch.zeros_like(strain)
        x = torch.stack([1 + strain, zero, zero], dim=-1)  # F e_x
        y = torch.stack([free[:, 0], 1 + free[:, 1], zero], dim=-1)
        p1, p2 = material.membrane_stress(c, build_surface_state(cos * x - sin * y, sin * x + cos * y))
        return (cos * p1 + sin * p2)[:, 0], (-sin * p1 + cos * p2)[:, :2]


class Trellis(AbstractSpecimen):
    """Bias extension: a rectangle clamped at both ends, yarns at 45 degrees that turn at their crossings, inextensible.

    The middle shears by g = pi/2 - 2 acos((1 + u / (L - W)) / sqrt 2), the four triangles next to it by g/2, and those
    at the clamps do not shear (Cao et al. 2008, doi 10.1016/j.compositesa.2008.02.016). The force follows from the work
    of the material's law over these parts. The length must be at least two widths. Slip and stretch of yarns are
    neglected.
    """

    def respond(self, material: AbstractMaterial, c: Any, table: ForceDisplacement, strain: Tensor) -> Response:
        """Compute shear angles from kinematics, and the force from virtual work."""
        length, width = table.length, table.width
        if abs(abs(table.angle) - pi / 4) > 1e-3 or length < 2 * width * (1 - 1e-6):
            got = f"angle {table.angle:.3g} rad, length {length:g} m, width {width:g} m"
            raise InvalidInput("a trellis", got=got, expected="45 degrees to the warp and a length of two widths")
        middle = length - width
        closing = (1 + strain * length / middle) / sqrt(2)
        if float(closing.detach().max()) >= 1:
            limit = f"less than {(sqrt(2) - 1) * middle / length:.3g}, where yarns meet"
            raise InvalidInput("a trellis", got=f"a strain of {float(strain.detach().max()):.3g}", expected=limit)
        shear = pi / 2 - 2 * torch.acos(closing)
        rate = sqrt(2) / middle / torch.sqrt(1 - closing * closing)  # d shear / d displacement
        whole, half = width * (length - 1.5 * width), width * width  # m^2, areas that shear by g and by g / 2
        work = whole * self._stress(material, c, shear) + 0.5 * half * self._stress(material, c, 0.5 * shear)
        return Response(work * rate, torch.cos(0.5 * shear) - torch.sin(0.5 * shear) - 1)

    def angle(self, table: ForceDisplacement) -> Tensor:
        """Compute the shear [N] rad of the middle at the table's displacements."""
        closing = (1 + torch.as_tensor(table.displacement) / (table.length - table.width)) / sqrt(2)
        return pi / 2 - 2 * torch.acos(closing)

    def _stress(self, material: AbstractMaterial, c: Any, shear: Tensor) -> Tensor:
        """N/m, derivative [N] of the law's energy by the shear [N] of rigid yarns."""
        cos, sin, zero = torch.cos(0.5 * shear), torch.sin(0.5 * shear), torch.zeros_like(shear)
        f1, f2 = torch.stack([cos, sin, zero], dim=-1), torch.stack([sin, cos, zero], dim=-1)
        p1, p2 = material.membrane_stress(c, build_surface_state(f1, f2))
        turn1, turn2 = torch.stack([-sin, cos, zero], dim=-1), torch.stack([cos, -sin, zero], dim=-1)
        return 0.5 * (p1 * turn1 + p2 * turn2).sum(-1)


class _Law(nn.Module):
    """A material under the name that it has in a cloth."""

    def __init__(self, material: AbstractMaterial) -> None:
        super().__init__()
        self.material = material

    def forward(self, specimen: AbstractSpecimen, tables: Sequence[ForceDisplacement]) -> list[Response]:
        """Compute one response per table."""
        return [specimen.curve(self.material, table) for table in tables]


def compute_responses(
    material: AbstractMaterial,
    entries: Mapping[str, Tensor],
    specimen: AbstractSpecimen,
    tables: Sequence[ForceDisplacement],
) -> list[Response]:
    """Compute responses with some stored tensors replaced, and differentiable in these.

    Args:
        material: the law.
        entries: tensors by their names in a cloth's state.
        specimen: how specimens deform.
        tables: specimens and displacements.
    """
    of_material = {key: value for key, value in entries.items() if key.startswith("material.")}
    return functional_call(_Law(material), of_material, (specimen, tables))


def build_surface_state(f1: Tensor, f2: Tensor) -> Surface:
    """Compute the kinematics of N states from the columns [N, 3] of their deformation gradients."""
    normal = torch.linalg.cross(f1, f2)
    ratio = normal.norm(dim=-1, keepdim=True)
    n = normal / ratio
    cofactors = torch.linalg.cross(f2, n), torch.linalg.cross(n, f1)
    return Surface(f1, f2, *cofactors, n, ratio, torch.ones_like(ratio), torch.zeros_like(f1))


def _values(c: Any) -> Any:
    """Coefficients without derivatives."""
    return type(c)(*(part.detach() for part in c))
