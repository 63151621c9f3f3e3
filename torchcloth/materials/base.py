"""Base class of materials, and the stiffness that bounds the stable step."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection
from typing import Any, ClassVar, NamedTuple

from torch import Tensor, nn

from ..types import Surface


class Stiffness(NamedTuple):
    """Largest tangents of a material as stress resultants [N/m], each [..., E or 1, 1]; they bound the stable step.

    In the plane, in the material's axes, a strain e must not raise the energy by more than half of warp e11^2 + weft
    e22^2 + 2 coupling e11 e22 + in_plane_shear (2 e12)^2. For a law that stiffens with strain take the stiffest state.
    ``stability.STABLE_STEP_OVER_LINEAR_LIMIT`` covers a factor of two beyond these values.

    Attributes:
        warp: lambda + 2 mu of an isotropic law.
        weft: lambda + 2 mu of an isotropic law.
        coupling: lambda of an isotropic law.
        in_plane_shear: mu of an isotropic law.
        normal: of the director's compression.
        shear: of the director's shear.
    """

    warp: Tensor
    weft: Tensor
    coupling: Tensor
    in_plane_shear: Tensor
    normal: Tensor
    shear: Tensor

    @classmethod
    def isotropic(cls, lam: Tensor, mu: Tensor, normal: Tensor, shear: Tensor) -> Stiffness:
        """Build from Lame parameters times thickness, and the director's tangents, all N/m."""
        return cls(lam + 2 * mu, lam + 2 * mu, lam, mu, normal, shear)


class AbstractMaterial(nn.Module, ABC):
    """A thin sheet: a membrane law in the surface, and a director law for contact and friction across it.

    Everything is per unit of rest area, with the thickness multiplied in: energies in J/m^2, stresses in N/m.
    ``coefficients`` is called once per rollout. The other methods are pure functions of what it returned, ``c``, whose
    tensors broadcast with [..., E, 3]. For the director law they have one more axis, [..., E, 1, 1], and broadcast with
    n [..., E, 1, 3] and d3 [..., E, S, 3] (S contact points per triangle).

    Attributes:
        contact_parameters: names of the parameters that act in contact between layers only. In a cloth without contact
            they require no gradients.
    """

    contact_parameters: ClassVar[Collection[str]] = ()

    @property
    def has_axes(self) -> bool:
        """Whether the law distinguishes warp and weft, so that the mesh must have a pattern."""
        return False

    @abstractmethod
    def coefficients(self) -> Any:
        """Return a NamedTuple of tensors [..., E or 1, 1] that are computed from the learnable parameters."""

    @abstractmethod
    def membrane_energy(self, c: Any, surface: Surface) -> Tensor:
        """Return the energy density of the membrane, [..., E, 1] J/m^2."""

    @abstractmethod
    def membrane_stress(self, c: Any, surface: Surface) -> tuple[Tensor, Tensor]:
        """Return the columns of the first Piola-Kirchhoff resultant d(energy)/dF, each [..., E, 3] N/m."""

    @abstractmethod
    def director_energy(self, c: Any, n: Tensor, d3: Tensor) -> Tensor:
        """Return the energy density [..., E, S, 1] J/m^2 of the director d3 against the surface's unit normal n."""

    @abstractmethod
    def director_stress(self, c: Any, n: Tensor, d3: Tensor) -> tuple[Tensor, Tensor]:
        """Return d(energy)/dn and d(energy)/dd3, each [..., E, S, 3] N/m, with n varied freely: the caller projects."""

    @abstractmethod
    def return_map(self, c: Any, n: Tensor, d3: Tensor) -> Tensor:
        """Return the elastic director after plastic flow, [..., E, S, 3]; must be idempotent."""

    def initial_memory(self, triangles: int) -> Tensor | None:
        """Return A = (A11, A12, A21, A22) [E, 4] of a new sheet; None: the membrane is always elastic.

        A is the inverse of the plastic set: the membrane law acts on the elastic deformation F_E = F A.
        """
        return None

    def flow(self, c: Any, trial: Surface, inverse_plastic: Tensor) -> Tensor:
        """Return A [..., E, 4] after plastic flow; must be idempotent.

        Args:
            c: coefficients.
            trial: the deformation F A, which would be elastic if nothing flowed.
            inverse_plastic: A [..., E, 4] before the flow.
        """
        raise NotImplementedError(f"{type(self).__name__} has initial_memory, but does not override flow")

    @abstractmethod
    def stiffness(self, c: Any) -> Stiffness:
        """Return the largest tangents, which bound the stable step."""
