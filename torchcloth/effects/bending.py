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
from ._bending_stencil import BendingStencil, neighbour_differences
from ._curvature import (
    curvature_stencils,
    find_sparsity_pattern,
    largest_eigenvalue,
    local_matrices,
    mixed_area,
    sum_entries,
)
from ._plate import Plate, PlateOperator
from .base import AbstractEffect, Amplitude


class Coefficients(NamedTuple):
    """What the bending force needs.

    Attributes:
        stiffness: [] or [..., 1, 1] N m; or 1 where ``operator`` contains the stiffness.
        viscosity: stiffness times damping time [N m s], or the damping time [s].
        operator: [..., D V, 1] N/m, for a sheet that is not isotropic and uniform; else None.
        plate: stiffness matrix, for such a sheet or one that is not flat at rest; else None.
        curl: [..., 1, 3] 1/m, rest curvature along ww, ff, sqrt 2 wf; None: flat.
        mobility: [..., 1, 1] 1/s, of creases; None: no creases.
    """

    stiffness: Tensor
    viscosity: Tensor
    operator: Tensor | None = None
    plate: Plate | None = None
    curl: Tensor | None = None
    mobility: Tensor | None = None


_CURL = Amplitude(
    unit="1/m",
    typical=3.0,
    confounded_with=("plast.crease",),
    signed=True,
    cause="rest.curl",
    title="Curl at rest",
    description="The cloth at rest is curved along warp or weft, to one of its sides.",
)


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

    An argument that is None adds no parameter and no cost. An argument of 0 adds a parameter that can be learned.

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
        # fabrics differ a hundredfold: 2e-6 N m of a lining, 2e-4 N m of a thick knit
        "stiffness": Amplitude(unit="N m", typical=1e-5, smallest=1e-6, prior_ratio=10.0),
        "damping_time": Amplitude(
            unit="s",
            typical=0.03,
            confounded_with=("fric.internal_bend", "air.linear"),
            cause="damp.bend",
            title="Damping of bending",
            description="Bending is damped: ripples die out sooner than swings.",
            diagnosis_typical=0.05,
        ),
        "curl_warp": _CURL,
        "curl_weft": _CURL,
    }
    per_triangle = ("stiffness",)

    def __init__(
        self,
        stiffness: float | Tensor = 1e-5,
        damping_time: float | Tensor | None = None,
        *,
        poisson: float = 0.0,
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
        self.columns: Tensor  # [D, V], vertices that a vertex's force depends on
        self.operator: Tensor  # [D, V, 1] 1/m^2, minus the off-diagonal entries of Q for B = 1
        self.bound: Tensor  # [V, 1] 1/m^2, each vertex's area times the largest eigenvalue of Q over the areas
        self.faces: Tensor  # [E, 3]
        self.stencil, self.plate_operator = BendingStencil(), PlateOperator()

    def bind(self, mesh: Mesh) -> Bending:
        """Build the curvature stencils of the mesh's vertices and the matrix Q, and return self.

        Raises:
            InvalidInput: a field that does not have one value per triangle.
        """
        size = self.stiffness.raw.shape[-1] if self.stiffness.raw.ndim else 1
        if size not in (1, len(mesh.faces)):
            got, want = f"shape {tuple(self.stiffness.raw.shape)}", f"a number, [{len(mesh.faces)}] or [B, 1]"
            raise InvalidInput("bending stiffness", got=got, expected=want)
        dtype, device = torch.get_default_dtype(), self.stiffness.raw.device
        plate = _uniform_plate(mesh, self.poisson)
        self.columns = torch.as_tensor(plate.columns.T.copy(), device=device)
        self.operator = torch.as_tensor(-plate.entries.T.copy(), dtype=dtype, device=device).unsqueeze(-1)
        self.bound = torch.as_tensor(plate.bound.copy(), dtype=dtype, device=device).unsqueeze(-1)
        self.faces = torch.as_tensor(mesh.faces.copy(), device=device)
        self.stencil.bind(mesh, device)
        if self._needs_operator(size):
            self.plate_operator.bind(curvature_stencils(mesh), mixed_area(mesh), device)
        return self

    def _needs_operator(self, size: int) -> bool:
        return size > 1 or self.weft_ratio is not None or self.twist_ratio is not None

    @property
    def has_axes(self) -> bool:
        """Whether the effect distinguishes warp and weft: for woven cloth and for curls."""
        return any(p is not None for p in (self.weft_ratio, self.twist_ratio, self.curl_warp, self.curl_weft))

    def coefficients(self) -> Coefficients:
        """Return what the force needs; see ``Coefficients``.

        Raises:
            InvalidInput: a value for each triangle, given to an effect that was made with one for all.
        """
        field = self.stiffness.field
        time = None if self.damping_time is None else self.damping_time.field
        curl = self._curl(field)
        if not self._needs_operator(field.shape[-2]):
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
        """Return whether the sheet may be curved at rest."""
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
        """Return the means [..., V, 1] of values [..., E, 1] over the triangles at each vertex."""
        index = self.faces.flatten()
        repeated = field.repeat_interleave(3, dim=-2)
        count = self.columns.shape[1]
        total = field.new_zeros(*field.shape[:-2], count, 1).index_add(-2, index, repeated)
        triangle_count = field.new_zeros(count, 1).index_add(0, index, field.new_ones(len(index), 1))
        return total / triangle_count

    def force(self, c: Coefficients, inputs: EffectInputs) -> Tensor:
        """Return -Q (x + damping_time v) on each vertex, and what rest curvature adds."""
        field = c.stiffness * inputs.x
        if self.damping_time is not None:
            field = field + c.viscosity * inputs.v
        force = self._apply_stiffness(c, field)
        if c.curl is None or c.plate is None:
            return force
        return force - self.stencil.moment_force(
            self.stencil.fit_surface(inputs.x, inputs.compensation), c.plate.moment(self.rest_curvature(c.curl, inputs))
        )

    def viscous(self, c: Coefficients, inputs: EffectInputs) -> Tensor | None:
        """Return -Q damping_time v, if there is damping."""
        return None if self.damping_time is None else self._apply_stiffness(c, c.viscosity * inputs.v)

    def _apply_stiffness(self, c: Coefficients, field: Tensor) -> Tensor:
        if c.operator is None:
            return (self.operator * neighbour_differences(field, self.columns)).sum(-3)
        operator = c.operator.unflatten(-2, self.plate_operator.columns.shape)
        return (operator * neighbour_differences(field, self.plate_operator.columns)).sum(-3)

    def rest_curvature(self, curl: Tensor, inputs: EffectInputs) -> Tensor:
        """Return the rest curvature [..., V or 1, 3] 1/m along ww, ff, sqrt 2 wf; ``curl`` is that of a new sheet."""
        return curl

    def energy(self, c: Coefficients, x: Tensor) -> Tensor:
        """Compute the bending energy, [...] J."""
        bent = self.stencil.fit_surface(x)
        plate = self._plate(c.stiffness) if c.plate is None else c.plate
        density = plate.energy(bent.second_derivatives)
        if c.curl is not None:
            density = density + dot(c.curl / 2 - bent.curvature, plate.moment(c.curl))
        return (self.stencil.area * density).sum((-2, -1))

    def stability_bounds(self, c: Coefficients, mass: Tensor) -> tuple[Tensor, Tensor]:
        """Bound omega^2 by B times the largest eigenvalue of Q over the vertices' masses.

        The eigenvalue is bounded by that for a uniform areal density.
        """
        stiffness = c.stiffness.amax() * self._largest_eigenvalue(c, mass)
        if c.curl is not None and c.plate is not None:
            moment = c.plate.moment(c.curl).square().sum(-1).amax().sqrt()
            stiffness = stiffness + moment * self.stencil.turning_bound_over(mass)
        return stiffness, self.viscous_stability_bound(c, mass)

    def viscous_stability_bound(self, c: Coefficients, mass: Tensor) -> Tensor:
        """Return the whole damping rate."""
        return c.viscosity.amax() * self._largest_eigenvalue(c, mass)

    def _largest_eigenvalue(self, c: Coefficients, mass: Tensor) -> Tensor:
        """Return the largest eigenvalue of Q over the masses, times the stiffness where ``c.operator`` contains it."""
        if c.operator is None or c.plate is None:
            return (self.bound / mass).amax()
        return c.plate.eigenvalue_bound() * self.stencil.bending_bound_over(mass)

    def extra_repr(self) -> str:
        """Return the line of the data sheet: Poisson's ratio."""
        return f"poisson={self.poisson:g}"


def _optional(value: float | Tensor | None, unit: str, domain, name: str) -> PhysicalParameter | None:
    return None if value is None else PhysicalParameter(value, unit, domain, name=name)


class _UniformPlate(NamedTuple):
    """The plate matrix Q of unit stiffness, by rows.

    Attributes:
        columns: [V, D] int.
        entries: [V, D] 1/m^2, off-diagonal.
        bound: [V] 1/m^2, each vertex's area times the largest eigenvalue of Q over the areas.
    """

    columns: np.ndarray
    entries: np.ndarray
    bound: np.ndarray


# As many as ``curvature_stencils`` caches: the power iteration takes longer than many a simulation.
@lru_cache(maxsize=8)
def _uniform_plate(mesh: Mesh, poisson: float) -> _UniformPlate:
    stencils, area, share = curvature_stencils(mesh), mixed_area(mesh), mesh.vertex_area
    form = stencils.second @ np.linalg.cholesky(_isotropic_plate(poisson)) * np.sqrt(area)[:, None, None]
    local = local_matrices(form)
    shape = find_sparsity_pattern(stencils.neighbours, local)
    entries = sum_entries(shape, local)
    return _UniformPlate(shape.columns, entries, share * largest_eigenvalue(shape.columns, entries, share))


def _isotropic_plate(poisson: float) -> np.ndarray:
    """Return P of unit stiffness for k = (k_ww, k_ff, sqrt 2 k_wf)."""
    return np.array([[1.0, poisson, 0.0], [poisson, 1.0, 0.0], [0.0, 0.0, 1.0 - poisson]])
