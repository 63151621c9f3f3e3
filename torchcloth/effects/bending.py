"""Bending stiffness, along warp and weft, with damping and rest curvature."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from .._utils.linalg import dot
from ..errors import InvalidInput
from ..meshes import Mesh
from ..parameters import PhysicalParameter
from ..types import EffectInputs
from ._bent import BendingStencil, neighbour_differences
from ._curvature import curvature_stencils, sum_entries, largest_eigenvalue, local_matrices, mixed_area, find_sparsity_pattern
from ._plate import PlateOperator, Plate
from .base import AbstractEffect, Amplitude


class Coefficients(NamedTuple):
    """What the force needs; the optional ones where the sheet is not isotropic and uniform, or not flat at rest."""

    stiffness: Tensor  # [] or [..., 1, 1] N m, or 1 where ``operator`` holds it
    viscosity: Tensor  # the same times the damping time, N m s or s
    operator: Tensor | None = None  # [..., D V, 1] N/m
    plate: Plate | None = None
    curl: Tensor | None = None  # [..., 1, 3] 1/m, rest curvature along ww, ff, sqrt 2 wf
    mobility: Tensor | None = None  # [..., 1, 1] 1/s, of creases


class Bending(AbstractEffect):
    """Bending of a sheet: a Kirchhoff plate, orthotropic in material axes, on the material's second derivatives.

    Energy per area 1/2 (k - k0 n) . P (k - k0 n) with the vector-valued curvature k_ab = d^2 x / da db in material axes
    a, b: equal to that of the surface where bending does not stretch. Isotropic P is B/2 [(1 - nu) (k_ww^2 + k_ff^2 +
    2 k_wf^2) + nu (k_ww + k_ff)^2]. k is a weighted least-squares fit about every vertex, linear in x with constant
    weights, so without rest curvature k0 the force is -Q (x + damping_time v) with one constant matrix Q. The direction
    of the mesh's diagonals does not matter; hinge formulas are wrong by factors of 3 to 4.5 on our sheets, and the
    Laplacian alone lets a free edge curl at no cost (it is nu = 1).

    Woven cloth: B_weft = weft_ratio B_warp, coupling nu sqrt(B_warp B_weft), and twisting stiffness (1 - nu)
    sqrt(B_warp B_weft) twist_ratio (1: Huber's estimate). A narrow strip at an angle a to the warp then has, at
    nu = 0, 1/B = cos^4 a / B_warp + sin^4 a / B_weft + 2 cos^2 a sin^2 a / B_twist.

    What is None is not there: no parameter to learn, no cost. 0 is there to be learned.

    Args:
        stiffness: B, along the warp where it differs [N m], >= 0; fabrics have 1e-6 to 1e-4. A number, one value per
            triangle [E] (a hem is stiffer), or [B, 1] for a batch.
        damping_time: tau_b, ratio of viscous to elastic bending moment [s], >= 0; fabrics have 0.01 to 0.1.
        poisson: nu of bending, in (-1, 1), a constant. 0: bending one way does not curl the other way.
        weft_ratio: stiffness along the weft over that along the warp, > 0.
        twist_ratio: twisting stiffness over Huber's estimate, > 0.
        curl_warp: rest curvature along the warp [1/m]; > 0 where the centre lies on the side of the normal (from which
            faces are counter-clockwise), so the cloth curls the other way when it is turned over. Knits have 1 to 5.
        curl_weft: likewise along the weft.

    Raises:
        InvalidInput: values out of range.
    """

    amplitudes = {
        "stiffness": Amplitude("N m", 1e-5, 1e-6),
        "damping_time": Amplitude("s", 0.03, 3e-3, ("internal_friction", "mass_damping")),
        "curl_warp": Amplitude("1/m", 3.0, 0.3, ("crease",)),
        "curl_weft": Amplitude("1/m", 3.0, 0.3, ("crease",)),
    }
    per_triangle = ("stiffness",)

    def __init__(
        self,
        stiffness: float | Tensor = 1e-5,
        damping_time: float | Tensor | None = None,
        poisson: float = 0.0,
        *,
        weft_ratio: float | Tensor | None = None,
        twist_ratio: float | Tensor | None = None,
        curl_warp: float | Tensor | None = None,
        curl_weft: float | Tensor | None = None,
    ) -> None:
        super().__init__()
        if not -1 < poisson < 1:
            raise InvalidInput("bending poisson", got=poisson, expected="a number in (-1, 1)")
        self.poisson = float(poisson)
        self.stiffness = PhysicalParameter(stiffness, "N m", "nonnegative", name="bending stiffness")
        self.damping_time = _optional(damping_time, "s", "nonnegative", "bending damping_time")
        self.weft_ratio = _optional(weft_ratio, "-", "positive", "bending weft_ratio")
        self.twist_ratio = _optional(twist_ratio, "-", "positive", "bending twist_ratio")
        self.curl_warp = _optional(curl_warp, "1/m", "real", "curl_warp")
        self.curl_weft = _optional(curl_weft, "1/m", "real", "curl_weft")
        for name, like in (("columns", torch.long), ("operator", None), ("bound", None), ("faces", torch.long)):
            self.register_buffer(name, torch.zeros(0, dtype=like), persistent=False)
        self.columns: Tensor  # [D, V] vertices that a vertex's force depends on
        self.operator: Tensor  # [D, V, 1] 1/m^2: minus the off-diagonal entries of Q for B = 1
        self.bound: Tensor  # [V, 1] 1/m^2: each vertex's area times the largest eigenvalue of Q over the areas
        self.faces: Tensor  # [E, 3]
        self.stencil, self.plate_operator = BendingStencil(), PlateOperator()

    def bind(self, mesh: Mesh) -> Bending:
        """Build the curvature stencils of the mesh's vertices and the matrix Q.

        Raises:
            InvalidInput: a field that does not have one value per triangle.
        """
        size = self.stiffness.raw.shape[-1] if self.stiffness.raw.ndim else 1
        if size not in (1, len(mesh.faces)):
            got, want = f"shape {tuple(self.stiffness.raw.shape)}", f"a number, [{len(mesh.faces)}] or [B, 1]"
            raise InvalidInput("bending stiffness", got=got, expected=want)
        dtype, device = torch.get_default_dtype(), self.stiffness.raw.device
        plate = _plate(mesh, self.poisson)
        self.columns = torch.as_tensor(plate.columns.T.copy(), device=device)
        self.operator = torch.as_tensor(-plate.entries.T.copy(), dtype=dtype, device=device).unsqueeze(-1)
        self.bound = torch.as_tensor(plate.bound.copy(), dtype=dtype, device=device).unsqueeze(-1)
        self.faces = torch.as_tensor(mesh.faces.copy(), device=device)
        self.stencil.bind(mesh, device)
        if self._uneven(size):
            self.plate_operator.bind(curvature_stencils(mesh), mixed_area(mesh), device)
        return self

    def _uneven(self, size: int) -> bool:
        return size > 1 or self.weft_ratio is not None or self.twist_ratio is not None

    @property
    def has_axes(self) -> bool:
        """Of woven cloth and curls."""
        return any(p is not None for p in (self.weft_ratio, self.twist_ratio, self.curl_warp, self.curl_weft))

    def coefficients(self) -> Coefficients:
        """Resolved once per rollout.

        Raises:
            InvalidInput: a value for each triangle, given to an effect that was made with one for all.
        """
        field = self.stiffness.field
        time = None if self.damping_time is None else self.damping_time.field
        curl = self._curl(field)
        if not self._uneven(field.shape[-2]):
            viscosity = torch.zeros_like(field) if time is None else field * time
            plate = None if curl is None else self._plate(field)
            return Coefficients(field, viscosity, None, plate, curl)
        if not len(self.plate_operator.locals):
            raise InvalidInput(
                "bending stiffness",
                got=f"{field.shape[-2]} values for an effect that was made with one",
                expected="one",
                remedy="make it with a field, Bending(torch.full((E,), 1e-5)), whose stencils differ",
            )
        plate = self._plate(field if field.shape[-2] == 1 else self._on_vertices(field))
        time = torch.zeros_like(field[..., :1, :]) if time is None else time
        return Coefficients(torch.ones_like(time), time, self.plate_operator.entries(plate), plate, curl)

    def has_rest_curvature(self) -> bool:
        """Whether the sheet may be other than flat at rest."""
        return self.curl_warp is not None or self.curl_weft is not None

    def _curl(self, like: Tensor) -> Tensor | None:
        if not self.has_rest_curvature():
            return None
        zero = like.new_zeros(1, 1)
        warp, weft = (zero if curl is None else curl.field for curl in (self.curl_warp, self.curl_weft))
        return torch.cat(torch.broadcast_tensors(warp, weft, zero), dim=-1)

    def _plate(self, warp: Tensor) -> Plate:
        one = torch.ones_like(warp)
        ratio = one if self.weft_ratio is None else self.weft_ratio.field
        twist = one if self.twist_ratio is None else self.twist_ratio.field
        mean = ratio.sqrt() * warp
        return Plate(warp, ratio * warp, self.poisson * mean, (1 - self.poisson) * twist * mean)

    def _on_vertices(self, field: Tensor) -> Tensor:
        """Means [..., V, 1] of values [..., E, 1], by the triangles at each vertex."""
        index = self.faces.flatten()
        spread = field.repeat_interleave(3, dim=-2)
        count = self.columns.shape[1]
        total = field.new_zeros(*field.shape[:-2], count, 1).index_add(-2, index, spread)
        here = field.new_zeros(count, 1).index_add(0, index, field.new_ones(len(index), 1))
        return total / here

    def force(self, c: Coefficients, now: EffectInputs) -> Tensor:
        """-Q (x + damping_time v) on each vertex, and what rest curvature adds."""
        field = c.stiffness * now.x
        if self.damping_time is not None:
            field = field + c.viscosity * now.v
        force = self._straightened(c, field)
        if c.curl is None or c.plate is None:
            return force
        return force - self.stencil.moment_force(
            self.stencil.fit_surface(now.x, now.compensation), c.plate.moment(self.rest_curvature(c.curl, now))
        )

    def viscous(self, c: Coefficients, now: EffectInputs) -> Tensor | None:
        """-Q damping_time v."""
        return None if self.damping_time is None else self._straightened(c, c.viscosity * now.v)

    def _straightened(self, c: Coefficients, field: Tensor) -> Tensor:
        """-Q field."""
        if c.operator is None:
            return (self.operator * neighbour_differences(field, self.columns)).sum(-3)
        operator = c.operator.unflatten(-2, self.plate_operator.columns.shape)
        return (operator * neighbour_differences(field, self.plate_operator.columns)).sum(-3)

    def rest_curvature(self, curl: Tensor, now: EffectInputs) -> Tensor:
        """[..., V or 1, 3] 1/m along ww, ff, sqrt 2 wf; ``curl`` is that of the virgin sheet."""
        return curl

    def energy(self, c: Coefficients, x: Tensor) -> Tensor:
        """Bending energy [...] J."""
        bent = self.stencil.fit_surface(x)
        plate = self._plate(c.stiffness) if c.plate is None else c.plate
        density = plate.energy(bent.second_derivatives)
        if c.curl is not None:
            density = density + dot(c.curl / 2 - bent.curvature, plate.moment(c.curl))
        return (self.stencil.area * density).sum((-2, -1))

    def stability_bounds(self, c: Coefficients, mass: Tensor) -> tuple[Tensor, Tensor]:
        """B times the largest eigenvalue of Q over the vertices' masses, bounded by that for equal areal density."""
        stiffness = c.stiffness.amax() * self._spectrum(c, mass)
        if c.curl is not None and c.plate is not None:
            moment = c.plate.moment(c.curl).square().sum(-1).amax().sqrt()
            stiffness = stiffness + moment * self.stencil.turning_bound_over(mass)
        return stiffness, self.viscous_stability_bound(c, mass)

    def viscous_stability_bound(self, c: Coefficients, mass: Tensor) -> Tensor:
        """All damping there is."""
        return c.viscosity.amax() * self._spectrum(c, mass)

    def _spectrum(self, c: Coefficients, mass: Tensor) -> Tensor:
        """Largest eigenvalue of Q over the masses, times the stiffness where ``c.operator`` holds it."""
        if c.operator is None or c.plate is None:
            return (self.bound / mass).amax()
        return c.plate.eigenvalue_bound() * self.stencil.bending_bound_over(mass)

    def extra_repr(self) -> str:
        """One line of the data sheet."""
        return f"poisson={self.poisson:g}"


def _optional(value: float | Tensor | None, unit: str, domain, name: str) -> PhysicalParameter | None:
    return None if value is None else PhysicalParameter(value, unit, domain, name=name)


class _Even(NamedTuple):
    """The plate matrix Q of unit stiffness, by rows."""

    columns: np.ndarray  # [V, D] int
    entries: np.ndarray  # [V, D] 1/m^2, off-diagonal
    bound: np.ndarray  # [V] 1/m^2: each vertex's area times the largest eigenvalue of Q over the areas


@lru_cache(maxsize=8)  # as curvature_stencils: the power iteration takes longer than many a simulation
def _plate(mesh: Mesh, poisson: float) -> _Even:
    stencils, area, share = curvature_stencils(mesh), mixed_area(mesh), mesh.vertex_area
    form = stencils.second @ np.linalg.cholesky(_isotropic(poisson)) * np.sqrt(area)[:, None, None]
    local = local_matrices(form)
    shape = find_sparsity_pattern(stencils.neighbours, local)
    entries = sum_entries(shape, local)
    return _Even(shape.columns, entries, share * largest_eigenvalue(shape.columns, entries, share))


def _isotropic(poisson: float) -> np.ndarray:
    """Energy k . P k / 2 per unit stiffness in k = (k_ww, k_ff, sqrt 2 k_wf)."""
    return np.array([[1.0, poisson, 0.0], [poisson, 1.0, 0.0], [0.0, 0.0, 1.0 - poisson]])
