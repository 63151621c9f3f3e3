"""What an effect must answer."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping
from typing import Any, ClassVar, Literal, NamedTuple

from torch import Tensor, nn

from ..errors import InvalidInput
from ..meshes import Mesh
from ..types import EffectInputs, Surface


class Amplitude(NamedTuple):
    """How large a parameter of an effect is; 0 switches that part of the effect off."""

    unit: str
    typical: float  # of an ordinary case
    smallest: float  # below this nobody cares
    equivalences: tuple[str, ...] = ()  # effects or parameters that data can hardly tell from it


class AbstractEffect(nn.Module, ABC):
    """Something real that the bare membrane does not have. Amplitude 0 must leave the base model bitwise unchanged.

    An effect may be a force, and may also add mass, air that moves along, another rest shape, or slip in a gripper:
    override what it is. Everything else answers None and costs nothing. A constant force per vertex:

        class Pull(AbstractEffect):
            amplitudes = {"strength": Amplitude("N", 1e-3, 1e-4)}

            def __init__(self, strength=1e-3):
                super().__init__()
                self.strength = PhysicalParameter(strength, "N", "nonnegative", name="pull")  # 0 must be allowed
                self.register_buffer("along", torch.tensor([1.0, 0.0, 0.0]))  # goes where the cloth goes

            def coefficients(self):
                return self.strength.field  # [..., 1, 1]: numbers, fields and batches alike

            def force(self, c, now):
                return c * self.along.expand_as(now.x)

        class TestPull(torchcloth.testing.EffectContract):
            def make(self, amplitude):
                return Pull(amplitude)

    Class attributes:
        amplitudes: by parameter name, the main one first.
        per_triangle: names of parameters that may have a value for each triangle, all others being scalars or batches
            of them; None: not said, so not checked.
        acts_on: whether ``force`` returns one row per vertex, or one per triangle (shared equally by its corners).
        grasp: name of the boundary that ``grip_velocities`` belongs to.
    """

    amplitudes: ClassVar[Mapping[str, Amplitude]]
    per_triangle: ClassVar[Collection[str] | None] = None
    acts_on: ClassVar[Literal["vertices", "triangles"]] = "vertices"
    grasp: str | None = None

    @property
    def has_axes(self) -> bool:
        """Whether warp and weft differ: then the mesh must have a pattern."""
        return False

    def bind(self, mesh: Mesh) -> AbstractEffect:
        """Resolve what depends on the mesh; returns self."""
        return self

    @abstractmethod
    def coefficients(self) -> Any:
        """What the methods below need of the learnable parameters; called once per rollout."""

    def force(self, c: Any, now: EffectInputs) -> Tensor | None:
        """[..., V, 3] or [..., E, 3] N (see ``acts_on``)."""
        return None

    def viscous(self, c: Any, now: EffectInputs) -> Tensor | None:
        """[..., V, 3] N: the part of ``force`` that is linear in velocity, if it may be stiff; then it costs no steps.

        At fixed positions it is -C v with C symmetric and not negative. ``viscous_stability_bound`` must be there as well, and
        ``force`` one of the vertices.
        """
        return None

    def mass(self, c: Any) -> Tensor | None:
        """[..., V, 1] kg, carried along by the vertices."""
        return None

    def inertia(self, c: Any, surface: Surface) -> Tensor | None:
        """[..., E, 1] kg that a triangle must move along its normal only."""
        return None

    def rest_deformation(self, c: Any) -> Tensor | None:
        """[..., E or 1, 2, 2], columns: where the warp and weft of the pattern lie in the true rest shape."""
        return None

    def grip_compliance(self, c: Any) -> float:
        """m/(N s): most speed that ``grip_velocities`` gives for a force; viscous forces on what yields much take no stages."""
        return 0.0 if self.grasp is None else math.inf

    def grip_velocities(
        self,
        c: Any,
        index: Tensor,
        free: Tensor,
        gripped: Tensor,
        mass: Tensor,
        dt: float,
        added_mass_ratio: Tensor | None,
    ) -> Tensor:
        """Velocities of the held vertices ``index`` in an imperfect grip, from those ``free`` of it and ``held`` by it.

        All of ``free``, ``held`` and the result are [..., V, 3] m/s. ``resistance`` [..., V, 3, 3] is the mass of the
        air that moves along, over the ``mass`` [..., V, 1] kg of the vertices; None: none does.
        """
        return gripped

    def initial_memory(self, x: Tensor) -> Tensor | None:
        """Internal variables [..., N, K] of a virgin cloth at positions [..., V, 3]; None: remembers nothing."""
        return None

    def update_memory(self, c: Any, now: EffectInputs) -> Tensor:
        """Internal variables at ``now``, from those of the substep before (``now.memory``); called before ``force``."""
        raise NotImplementedError(f"{type(self).__name__} starts internal variables but does not update_memory them")

    def stability_bounds(self, c: Any, mass: Tensor) -> tuple[Tensor, Tensor]:
        """(bound on omega^2 [1/s^2], bound on the linear damping rate [1/s]) that this effect adds; limits the step."""
        return mass.new_zeros(()), mass.new_zeros(())

    def viscous_stability_bound(self, c: Any, mass: Tensor) -> Tensor:
        """What of that damping rate [1/s] is ``viscous``."""
        return mass.new_zeros(())


def require_memory(now: EffectInputs) -> Tensor:
    """The internal variables, for an effect that cannot do without.

    Raises:
        InvalidInput: the state carries none.
    """
    if now.memory is None:
        raise InvalidInput(
            "memory of an effect", got="none", expected="internal variables", remedy="take the state from Cloth.state"
        )
    return now.memory
