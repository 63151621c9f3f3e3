"""What a boundary must answer."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple

from torch import Tensor, nn

from ..meshes import Mesh


class PrescribedMotion(NamedTuple):
    """A trajectory resolved on the substeps of one frame interval."""

    increment: Tensor  # [..., N, 4, 4] rigid motion of the world points carried along during each substep
    pose: Tensor  # [..., N, 4, 4] m, of the body at the end of each substep
    closed: tuple[bool, ...]  # N flags


class AbstractBoundary(nn.Module, ABC):
    """Changes velocities so that the constraint holds at the end of the substep.

    ``driven`` boundaries need a trajectory in ``motion``; the layer reports the wrench that the cloth exerts on them.
    """

    is_prescribed: bool = False

    @abstractmethod
    def bind(self, mesh: Mesh) -> AbstractBoundary:
        """Resolve what depends on the mesh (vertex indices); returns self.

        Raises:
            InvalidInput: the boundary does not fit the mesh.
        """

    def prescribed_vertices(self, prescribed: PrescribedMotion | None, substep: int) -> Tensor | None:
        """Indices of the vertices whose velocities it dictates whatever they are; None: of none."""
        return None

    @abstractmethod
    def constrain(self, x: Tensor, v: Tensor, dt: float, prescribed: PrescribedMotion | None, substep: int) -> Tensor:
        """New velocities [..., V, 3] from positions at the start of the substep and velocities free of the boundary."""
