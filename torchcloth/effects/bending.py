"""Bending stiffness, and its damping."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..errors import InvalidInput
from ..meshes import Mesh
from ..parameters import PhysicalParameter
from ..types import Moment
from ._curvature import assemble, curvature_stencils, largest_eigenvalue, mixed_area
from .base import AbstractEffect, Amplitude


class Coefficients(NamedTuple):
    """Bending stiffness [N m] and the same times the damping time [N m s]; [] or [..., 1, 1]."""

    stiffness: Tensor
    viscosity: Tensor


class Bending(AbstractEffect):
    """Isotropic bending of a sheet that is flat at rest: a Kirchhoff plate on the material's second derivatives.

    Energy per area B/2 [(1 - nu) (k_ww^2 + k_ff^2 + 2 k_wf^2) + nu (k_ww + k_ff)^2] with the vector-valued curvature
    k_ab = d^2 x / da db in material axes a, b: equal to that of the surface where bending does not stretch. k is a
    weighted least-squares fit about every vertex, linear in x with constant weights, so the force is -B Q (x + time v)
    with one constant matrix Q. The direction of the mesh's diagonals does not matter; hinge formulas are wrong by
    factors of 3 to 4.5 on our sheets, and the Laplacian alone lets a free edge curl at no cost (it is nu = 1).

    Args:
        stiffness: B [N m], >= 0; fabrics have 1e-6 to 1e-4. A number, or [B, 1] for a batch.
        damping_time: ratio of viscous to elastic bending moment [s], a constant.
        poisson: nu of bending, in (-1, 1), a constant. 0: bending one way does not curl the other way.

    Raises:
        InvalidInput: values out of range.
    """

    amplitudes = {"stiffness": Amplitude("N m", 1e-5, 1e-6)}

    def __init__(self, stiffness: float | Tensor = 1e-5, damping_time: float = 0.0, poisson: float = 0.0) -> None:
        super().__init__()
        if not damping_time >= 0:
            raise InvalidInput("bending damping_time", got=f"{damping_time} s", expected="a time >= 0")
        if not -1 < poisson < 1:
            raise InvalidInput("bending poisson", got=poisson, expected="a number in (-1, 1)")
        if isinstance(stiffness, Tensor) and stiffness.ndim and stiffness.shape[-1] != 1:
            raise InvalidInput(
                "bending stiffness", got=f"shape {tuple(stiffness.shape)}", expected="a number or [B, 1]"
            )
        self.stiffness = PhysicalParameter(stiffness, "N m", "nonnegative", name="bending stiffness")
        self.damping_time, self.poisson = float(damping_time), float(poisson)
        for name, like in (("near", torch.long), ("form", None), ("columns", torch.long), ("operator", None)):
            self.register_buffer(name, torch.zeros(0, dtype=like), persistent=False)
        self.register_buffer("bound", torch.zeros(0, 1), persistent=False)
        self.near: Tensor  # [N, V] neighbours that a vertex's curvature is fitted to
        self.form: Tensor  # [3, N, V, 1] 1/m: energy = B/2 |sum_n form (x_n - x)|^2
        self.columns: Tensor  # [D, V] vertices that a vertex's force depends on
        self.operator: Tensor  # [D, V, 1] 1/m^2: minus the off-diagonal entries of Q
        self.bound: Tensor  # [V, 1] 1/m^2: each vertex's area times the largest eigenvalue of Q over the areas

    def bind(self, mesh: Mesh) -> Bending:
        """Build the curvature stencils of the mesh's vertices and the matrix Q."""
        stencil, weight = curvature_stencils(mesh)
        area = mixed_area(mesh)
        form = weight @ np.linalg.cholesky(_plate(self.poisson)) * np.sqrt(area)[:, None, None]
        columns, entries = assemble(stencil, form)
        share = np.zeros(len(area))
        np.add.at(share, mesh.faces.ravel(), np.repeat(mesh.area / 3, 3))
        dtype = torch.get_default_dtype()
        self.near, self.columns = torch.as_tensor(stencil.T.copy()), torch.as_tensor(columns.T.copy())
        self.form = torch.as_tensor(form.transpose(2, 1, 0).copy(), dtype=dtype).unsqueeze(-1)
        self.operator = torch.as_tensor(-entries.T.copy(), dtype=dtype).unsqueeze(-1)
        self.bound = torch.as_tensor(share * largest_eigenvalue(columns, entries, share), dtype=dtype).unsqueeze(-1)
        return self

    def coefficients(self) -> Coefficients:
        """Resolved once per rollout."""
        value = self.stiffness.field
        return Coefficients(value, value * self.damping_time)

    def force(self, c: Coefficients, now: Moment) -> Tensor:
        """-B Q (x + damping_time v) on each vertex."""
        field = c.stiffness * now.x
        if self.damping_time:
            field = field + c.viscosity * now.v
        return (self.operator * _differences(field, self.columns)).sum(-3)

    def energy(self, c: Coefficients, x: Tensor) -> Tensor:
        """Bending energy [...] J."""
        curvature = (self.form * _differences(x, self.near).unsqueeze(-4)).sum(-3)
        return 0.5 * (c.stiffness * (curvature**2).sum(-3)).sum((-2, -1))

    def rates(self, c: Coefficients, mass: Tensor) -> tuple[Tensor, Tensor]:
        """B times the largest eigenvalue of Q over the vertices' masses, bounded by that for equal areal density."""
        largest = (self.bound / mass).amax()
        return c.stiffness.amax() * largest, c.viscosity.amax() * largest

    def extra_repr(self) -> str:
        """One line of the data sheet."""
        return f"damping_time={self.damping_time:g} s, poisson={self.poisson:g}"


def _plate(poisson: float) -> np.ndarray:
    """Energy k . P k / 2 per unit stiffness in k = (k_ww, k_ff, sqrt 2 k_wf). A woven plate has more than one such P,
    each with a stiffness of its own: then ``form`` and ``operator`` get an axis for them, summed in ``coefficients``.
    """
    return np.array([[1.0, poisson, 0.0], [poisson, 1.0, 0.0], [0.0, 0.0, 1.0 - poisson]])


def _differences(field: Tensor, index: Tensor) -> Tensor:
    """Values at each vertex's ``index`` [D, V] less its own [..., D, V, 3]: small numbers, wherever the sheet is."""
    return field.index_select(-2, index.flatten()).unflatten(-2, index.shape) - field.unsqueeze(-3)
