"""Base class of boundaries, and the prescribed motion that they follow."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection
from typing import ClassVar, NamedTuple

from torch import Tensor, nn

from ..meshes import Mesh


class PrescribedMotion(NamedTuple):
    """A trajectory sampled on N substeps.

    Attributes:
        increment: [..., N, 4, 4], rigid motion of world points that the body carries along during each substep.
        pose: [..., N, 4, 4] m, of the body at the end of each substep.
        closed: N flags, the gripper holds the cloth during the substep.
    """

    increment: Tensor
    pose: Tensor
    closed: tuple[bool, ...]


class AbstractBoundary(nn.Module, ABC):
    """A constraint that changes velocities so that it holds at the end of the substep.

    Attributes:
        is_prescribed: the boundary follows a body, and needs a trajectory in ``motion``. The layer then reports the
            wrench that the cloth exerts on the body.
        world_facts: names of the parameters that are facts about the world, such as sizes. They require no gradients
            until the user asks for them by ``requires_grad_``.
    """

    is_prescribed: bool = False
    world_facts: ClassVar[Collection[str]] = ()

    @abstractmethod
    def bind(self, mesh: Mesh) -> AbstractBoundary:
        """Resolve what depends on the mesh, such as vertex indices, and return self.

        Raises:
            InvalidInput: the boundary does not fit the mesh.
        """

    def prescribed_vertices(self, prescribed: PrescribedMotion | None, substep: int) -> Tensor | None:
        """Return the indices of the vertices whose velocities the boundary sets, whatever they were; None: of none."""
        return None

    @abstractmethod
    def constrain(self, x: Tensor, v: Tensor, dt: float, prescribed: PrescribedMotion | None, substep: int) -> Tensor:
        """Return velocities that obey the boundary, [..., V, 3] m/s.

        Args:
            x: [..., V, 3] m, positions at the start of the substep.
            v: [..., V, 3] m/s, velocities without the boundary.
            dt: length of the substep [s].
            prescribed: motion of the body; None: it stands still.
            substep: row of ``prescribed``.
        """
