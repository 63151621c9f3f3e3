"""What an effect must answer."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar, Literal

from torch import Tensor, nn

from ..meshes import Mesh
from ..types import ClothState, Surface


class AbstractEffect(nn.Module, ABC):
    """A force that the bare membrane does not have. Amplitude 0 must leave the base model bitwise unchanged.

    Class attributes:
        unit: of the amplitude.
        typical: amplitude of a typical case, in ``unit``.
        smallest: the smallest amplitude of interest.
        equivalences: names of effects or parameters that data can hardly tell from this one.
        acts_on: whether ``force`` returns one row per vertex, or one per triangle (shared equally by its corners).
    """

    unit: ClassVar[str]
    typical: ClassVar[float]
    smallest: ClassVar[float]
    equivalences: ClassVar[tuple[str, ...]] = ()
    acts_on: ClassVar[Literal["vertices", "triangles"]] = "vertices"

    def bind(self, mesh: Mesh) -> AbstractEffect:
        """Resolve what depends on the mesh; returns self."""
        return self

    @abstractmethod
    def coefficients(self) -> Any:
        """What ``force`` needs of the learnable parameters; called once per rollout."""

    @abstractmethod
    def force(self, c: Any, state: ClothState, surface: Surface, mass: Tensor) -> Tensor:
        """[..., V, 3] or [..., E, 3] N (see ``acts_on``); ``mass`` is the vertices' [..., V, 1] kg."""

    def rates(self, c: Any, mass: Tensor) -> tuple[Tensor, Tensor]:
        """(bound on omega^2 [1/s^2], bound on the linear damping rate [1/s]) that this effect adds; limits the step."""
        return mass.new_zeros(()), mass.new_zeros(())
