"""What a cloth material must answer."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, NamedTuple

from torch import Tensor, nn

from ..types import Surface


class Stiffness(NamedTuple):
    """Largest tangents of a material as stress resultants [N/m], each [..., E or 1, 1]; they bound the stable step.

    In the plane, in the material's axes: a strain e does not raise the energy by more than half of
    warp e11^2 + weft e22^2 + 2 coupling e11 e22 + in_plane_shear (2 e12)^2. Where a law stiffens with strain, take its
    stiffest state; ``stability.SAFETY`` covers a factor of two beyond what is stated here.
    """

    warp: Tensor  # lambda + 2 mu of an isotropic law
    weft: Tensor  # likewise
    coupling: Tensor  # lambda
    in_plane_shear: Tensor  # mu
    normal: Tensor  # of the director's compression
    shear: Tensor  # of the director's shear

    @classmethod
    def isotropic(cls, lam: Tensor, mu: Tensor, normal: Tensor, shear: Tensor) -> Stiffness:
        """From Lame parameters."""
        return cls(lam + 2 * mu, lam + 2 * mu, lam, mu, normal, shear)


class AbstractMaterial(nn.Module, ABC):
    """A thin sheet: a membrane law in the surface, and a director law for contact and friction across it.

    Everything is per unit of rest area (thickness already multiplied in): energies in J/m^2, stresses in N/m.
    ``coefficients`` is called once per rollout; the other methods are pure functions of what it returns, whose tensors
    broadcast against [..., E, 3]. For the director law they are given with one more axis, [..., E, 1, 1], and meet
    n [..., E, 1, 3] and d3 [..., E, S, 3] (S contact points per triangle).
    """

    @property
    def has_axes(self) -> bool:
        """Whether warp and weft differ: then the mesh must have a pattern."""
        return False

    @abstractmethod
    def coefficients(self) -> Any:
        """NamedTuple of tensors [..., E or 1, 1] derived from the learnable parameters."""

    @abstractmethod
    def membrane_energy(self, c: Any, surface: Surface) -> Tensor:
        """[..., E, 1] J/m^2."""

    @abstractmethod
    def membrane_stress(self, c: Any, surface: Surface) -> tuple[Tensor, Tensor]:
        """Columns (P1, P2) of the first Piola-Kirchhoff resultant d(energy)/dF, each [..., E, 3] N/m."""

    @abstractmethod
    def director_energy(self, c: Any, n: Tensor, d3: Tensor) -> Tensor:
        """[..., E, S, 1] J/m^2, of the director d3 against the surface's unit normal n."""

    @abstractmethod
    def director_stress(self, c: Any, n: Tensor, d3: Tensor) -> tuple[Tensor, Tensor]:
        """(d(energy)/dn, d(energy)/dd3), each [..., E, S, 3] N/m; n is varied freely, the caller projects."""

    @abstractmethod
    def return_map(self, c: Any, n: Tensor, d3: Tensor) -> Tensor:
        """The elastic director after plastic flow, [..., E, S, 3]; idempotent."""

    def initial_memory(self, triangles: int) -> Tensor | None:
        """Inelastic part A of a virgin sheet's deformation [E, 4] = (A11, A12, A21, A22); None: always elastic.

        The membrane law is given the elastic deformation F_E = F A, A the inverse of the plastic set.
        """
        return None

    def flow(self, c: Any, trial: Surface, inverse_plastic: Tensor) -> Tensor:
        """The inelastic part [..., E, 4] after plastic flow; idempotent.

        ``elastic`` is the deformation F A that would be elastic if nothing flowed.
        """
        raise NotImplementedError(f"{type(self).__name__} starts a plastic set but does not let it flow")

    @abstractmethod
    def stiffness(self, c: Any) -> Stiffness:
        """Largest tangents, for the stable step."""
