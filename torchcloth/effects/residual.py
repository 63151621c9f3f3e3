"""Residual force: local laws that describe what the other effects leave, without naming a cause."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from .._utils.linalg import dot, safe_norm
from ..errors import InvalidInput
from ..meshes import Mesh
from ..parameters import PhysicalParameter
from ..types import EffectInputs
from ._bending_stencil import BendingStencil
from ._triangles import Triangles
from .base import AbstractEffect, Amplitude
from .viscous import largest_strain_rate_eigenvalue, strain_rate_force


class ResidualLaw(NamedTuple):
    """One local law of the residual force.

    Attributes:
        unit: of its coefficient.
        typical: size of the coefficient in an ordinary case.
        description: what a positive coefficient does.
    """

    unit: str
    typical: float
    description: str


RESIDUAL_LAWS = {
    "across": ResidualLaw("Pa s/m", 0.5, "opposes motion across the cloth, in proportion to speed"),
    "across2": ResidualLaw("Pa s^2/m^2", 0.7, "opposes motion across the cloth, growing as speed squared"),
    "along": ResidualLaw("Pa s/m", 0.2, "opposes motion along the cloth, in proportion to speed"),
    "along2": ResidualLaw("Pa s^2/m^2", 0.3, "opposes motion along the cloth, growing as speed squared"),
    "mass": ResidualLaw("kg/m^2", 0.1, "is weight and inertia"),
    "strain_rate": ResidualLaw("N s/m", 0.5, "opposes stretching and shearing, in proportion to their speed"),
    "bend": ResidualLaw("N m", 1e-4, "opposes bending"),
}
RESIDUAL_PLACES = {
    "": "everywhere",
    "edge": "near the free edges",
    "grip": "near the grippers",
    "inside": "far from the edges",
}


def describe_term(term: str, coefficient: float) -> str:
    """Describe in words what a term does; the opposite where its coefficient is negative."""
    law, _, place = term.partition("@")
    sign = "" if coefficient > 0 else "the opposite of what "
    return f"{sign}{RESIDUAL_LAWS[law].description}, {RESIDUAL_PLACES[place]}"


class Coefficients(NamedTuple):
    """Coefficients by law, per triangle [..., E, 1]; of mass and bend per vertex [..., V, 1]. None: no such term."""

    across: Tensor | None = None
    across2: Tensor | None = None
    along: Tensor | None = None
    along2: Tensor | None = None
    mass: Tensor | None = None
    strain_rate: Tensor | None = None
    bend: Tensor | None = None

    @property
    def has_drag(self) -> bool:
        """Whether any law depends on the velocity of the triangles."""
        return any(part is not None for part in self[:4])


class ResidualForce(AbstractEffect):
    """A sum of local laws, each uniform or weighted by position on the fabric. It describes, and names no cause.

    All laws are frame-indifferent. Weights depend on the distances d from the free edges and g from the grippers, both
    over the largest d: "@edge" is exp(-3 d), "@inside" is d^2, "@grip" is exp(-g^2). Per rest area:

        across: -c v_n n                across2: -c |v_n| v_n n      along: -c v_t      along2: -c |v_t| v_t
        mass: c more of it, with weight where there is ``Gravity``   strain_rate: as ``KelvinVoigt``
        bend: moment c times the curvature

    Args:
        terms: coefficient [SI] by term, "LAW" or "LAW@PLACE", of ``LAWS`` and ``PLACES``; either sign.
        gripped_vertices: vertices in grippers.

    Raises:
        InvalidInput: no term, or one that does not exist.
    """

    amplitudes = {
        "strength": Amplitude(
            unit="of the law", typical=1.0, smallest=0.1, confounded_with=("air.drag_n", "air.linear", "damp.kv")
        )
    }

    def __init__(self, terms: Mapping[str, float], gripped_vertices: Sequence[int] = ()) -> None:
        super().__init__()
        known = [f"{law}@{place}".rstrip("@") for law in RESIDUAL_LAWS for place in RESIDUAL_PLACES]
        if not isinstance(terms, Mapping):
            raise InvalidInput("terms", got=f"{terms!r:.40}", expected="a dict of strengths by law")
        unknown = [term for term in terms if term not in known]
        if unknown or not terms:
            raise InvalidInput(
                "terms", got=", ".join(unknown) or "none", expected=f"LAW or LAW@PLACE, laws {', '.join(RESIDUAL_LAWS)}"
            )
        self.terms, self.gripped_vertices = tuple(terms), tuple(gripped_vertices)
        self.strength = PhysicalParameter(
            torch.tensor(list(terms.values()), dtype=torch.get_default_dtype()), "SI", "real", name="residual force"
        )
        self.triangles, self.stencil = Triangles(), BendingStencil()
        for name in ("weights", "on_triangles", "vertex_area", "bound"):
            self.register_buffer(name, torch.zeros(0), persistent=False)
        self.weights: Tensor  # [places, V, 1] -
        self.on_triangles: Tensor  # [places, E, 1] -
        self.vertex_area: Tensor  # [V, 1] m^2
        self.bound: Tensor  # [V, 1] -; over mass it bounds the damping rate per unit of viscosity

    def bind(self, mesh: Mesh) -> ResidualForce:
        """Resolve weights and stencils, and return self.

        Raises:
            InvalidInput: a gripped vertex that the mesh does not have.
        """
        like = {"dtype": torch.get_default_dtype(), "device": self.strength.raw.device}
        wrong = [k for k in self.gripped_vertices if not 0 <= k < len(mesh.vertices)]
        if wrong:
            raise InvalidInput("gripped_vertices", got=f"vertex {wrong[0]}", expected=f"0 to {len(mesh.vertices) - 1}")
        self.triangles.bind(mesh, self.strength.raw.device)
        self.stencil.bind(mesh, device=self.strength.raw.device)
        weights = torch.as_tensor(_position_weights(mesh, self.gripped_vertices), **like)
        self.weights = weights.unsqueeze(-1)
        self.on_triangles = weights[:, torch.as_tensor(mesh.faces)].mean(-1, keepdim=True)
        self.vertex_area = torch.as_tensor(mesh.vertex_area, **like).unsqueeze(-1)
        self.bound = self.vertex_area * 3 * largest_strain_rate_eigenvalue(mesh.shape_gradient)
        return self

    def coefficients(self) -> Coefficients:
        """Return the coefficients of each law, summed over its terms."""
        strength, sums = self.strength.value, {}
        for k, term in enumerate(self.terms):
            law, _, place = term.partition("@")
            weight = (self.weights if law in ("mass", "bend") else self.on_triangles)[
                list(RESIDUAL_PLACES).index(place)
            ]
            part = strength[..., k, None, None] * weight
            sums[law] = sums[law] + part if law in sums else part
        return Coefficients(**sums)

    def mass(self, c: Coefficients) -> Tensor | None:
        """Return the mass on the vertices, [..., V, 1] kg."""
        return None if c.mass is None else c.mass * self.vertex_area

    def force(self, c: Coefficients, inputs: EffectInputs) -> Tensor:
        """Return the force of all laws but mass."""
        total = torch.zeros_like(inputs.x)
        if c.has_drag:
            total = self._drag(c, inputs)
        viscous = self.viscous(c, inputs)
        if viscous is not None:
            total = total + viscous
        if c.bend is not None:
            fit = self.stencil.fit_surface(inputs.x)
            total = total + self.stencil.moment_force(fit, c.bend * fit.curvature)
        return total

    def viscous(self, c: Coefficients, inputs: EffectInputs) -> Tensor | None:
        """Return the force of the strain rate."""
        return None if c.strain_rate is None else strain_rate_force(self.triangles, c.strain_rate, inputs)

    def _drag(self, c: Coefficients, inputs: EffectInputs) -> Tensor:
        surface = inputs.surface
        across, along, across2, along2 = (0.0 if p is None else p for p in (c.across, c.along, c.across2, c.along2))
        speed = dot(surface.v, surface.n)
        tangential = surface.v - speed * surface.n
        push = -(across + across2 * speed.abs()) * speed * surface.n
        push = push - (along + along2 * safe_norm(tangential)) * tangential
        shares = torch.cat([surface.area * push / 3] * 3, dim=-2)
        index = self.triangles.corners.unsqueeze(-1).expand(shares.shape)
        return torch.zeros_like(inputs.x).expand(*shares.shape[:-2], -1, 3).scatter_add(-2, index, shares)

    def stability_bounds(self, c: Coefficients, mass: Tensor) -> tuple[Tensor, Tensor]:
        """Bound the spectrum of a sheet at rest, where the laws of speed squared are 0."""

        def largest(part: Tensor | None) -> Tensor:
            return mass.new_zeros(()) if part is None else part.abs().amax()

        drag_rate = (largest(c.across) + largest(c.along)) * (self.vertex_area / mass).amax()
        return largest(c.bend) * self.stencil.bending_bound_over(mass), drag_rate + self.viscous_stability_bound(
            c, mass
        )

    def viscous_stability_bound(self, c: Coefficients, mass: Tensor) -> Tensor:
        """Return the damping rate of the strain rate's law."""
        return mass.new_zeros(()) if c.strain_rate is None else c.strain_rate.abs().amax() * (self.bound / mass).amax()

    def extra_repr(self) -> str:
        """Return the line of the data sheet: terms and coefficients."""
        values = self.strength.value.detach().flatten().tolist()
        return ", ".join(f"{term}={value:.3g}" for term, value in zip(self.terms, values, strict=False))


def _position_weights(mesh: Mesh, gripped: Sequence[int]) -> np.ndarray:
    """Return weights [places, V] in [0, 1]."""
    x, edges = mesh.vertices, mesh.boundary_edges
    edge = _distances(x, x[edges[:, 0]], x[edges[:, 1]]) if len(edges) else np.full(len(x), np.inf)
    # where every vertex lies on the rim, there is no inside and all of the cloth is near the rim
    size = edge.max() if len(edges) and edge.max() > 0 else float(np.ptp(x, axis=0).max())
    near = np.exp(-3 * edge / size)
    inside = np.minimum(edge / size, 1.0) ** 2
    grip = np.zeros(len(x))
    if len(gripped):
        patch = x[list(gripped)]
        grip = np.exp(-((_distances(x, patch, patch) / size) ** 2))
    return np.stack([np.ones(len(x)), near, grip, inside])


def _distances(x: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return distances [V] m from the nearest of the segments from ``a`` to ``b`` [N, 3]."""
    along, offset = b - a, x[:, None] - a
    s = np.clip((offset * along).sum(-1) / np.maximum((along * along).sum(-1), 1e-30), 0, 1)
    return np.linalg.norm(offset - s[..., None] * along, axis=-1).min(1)
