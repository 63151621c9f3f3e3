"""Base class of effects: the hooks that an effect may override."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

from torch import Tensor, nn

from ..errors import InvalidInput
from ..meshes import Mesh
from ..types import EffectInputs, Surface

SMALLEST_FRACTION_OF_TYPICAL = 0.4  # smallest effect of interest, where a declaration gives none


@dataclass(frozen=True)
class Amplitude:
    """Scale of an effect's parameter, and the cause that a diagnosis makes of it. At 0 that part is switched off.

    Priors of fits, the catalogue of causes, its glossary and its page follow from this declaration.

    Attributes:
        unit: SI unit.
        typical: value in an ordinary case.
        smallest: smallest effect of interest; None: 0.4 of the amplitude that a diagnosis calls typical.
        confounded_with: causes of the catalogue ("air.linear") or parameters ("Bending.stiffness") that data can
            hardly distinguish from this one.
        signed: whether negative values make sense.
        cause: name of the cause in the catalogue, without axis; empty: a diagnosis does not ask about it.
        title: title of the cause in reports.
        description: the cause in one sentence, for reports.
        diagnosis_typical: typical amplitude of the cause, from published magnitudes; None: ``typical``. It differs
            where the scale of the prior was chosen for other fabrics. Both decide results, so both are declared.
        prior_ratio: standard deviation of the prior of a fit, over the typical value or the start, whichever is larger.
    """

    unit: str
    typical: float
    smallest: float | None = None
    confounded_with: tuple[str, ...] = ()
    signed: bool = False
    cause: str = ""
    title: str = ""
    description: str = ""
    diagnosis_typical: float | None = None
    prior_ratio: float = 2.0

    @property
    def typical_of_cause(self) -> float:
        """Typical amplitude in a diagnosis, in ``unit``."""
        return self.typical if self.diagnosis_typical is None else self.diagnosis_typical

    @property
    def smallest_fraction(self) -> float:
        """Smallest effect of interest, as a fraction of the typical amplitude in a diagnosis."""
        if self.smallest is None:
            return SMALLEST_FRACTION_OF_TYPICAL
        return abs(self.smallest / self.typical_of_cause)


class AbstractEffect(nn.Module, ABC):
    """A physical effect that the bare membrane does not have. Amplitude 0 must leave the base model bitwise unchanged.

    An effect may be a force; it may also add mass, added mass of air, another rest shape, or slip in a gripper.
    Override the hooks that it needs: all others return None and cost nothing. A constant force per vertex:

        class Pull(AbstractEffect):
            amplitudes = {"strength": Amplitude(unit="N", typical=1e-3, smallest=1e-4)}

            def __init__(self, strength=1e-3):
                super().__init__()
                self.strength = PhysicalParameter(strength, "N", "nonnegative", name="pull")  # 0 must be allowed
                self.register_buffer("along", torch.tensor([1.0, 0.0, 0.0]))  # a buffer moves to the cloth's device

            def coefficients(self):
                return self.strength.field  # [..., 1, 1], for scalars, fields and batches

            def force(self, c, inputs):
                return c * self.along.expand_as(inputs.x)

        class TestPull(torchcloth.testing.EffectContract):
            def make(self, amplitude):
                return Pull(amplitude)

    In all hooks ``c`` is what ``coefficients`` returned.

    Attributes:
        amplitudes: scales by parameter name, the main parameter first.
        per_triangle: names of the parameters that may have one value per triangle; all others are scalars or batches of
            scalars. None: not declared, so not checked.
        acts_on: whether ``force`` returns one row per vertex, or one per triangle (shared equally by its corners).
        world_facts: names of the parameters that are facts about the world, not about the cloth. They require no
            gradients until the user asks for them by ``requires_grad_``.
        grasp: name of the boundary whose grip ``grip_velocities`` changes; None: of none.
    """

    amplitudes: ClassVar[Mapping[str, Amplitude]]
    per_triangle: ClassVar[Collection[str] | None] = None
    world_facts: ClassVar[Collection[str]] = ()
    acts_on: ClassVar[Literal["vertices", "triangles"]] = "vertices"
    grasp: str | None = None

    @property
    def has_axes(self) -> bool:
        """Whether the effect distinguishes warp and weft, so that the mesh must have a pattern."""
        return False

    def bind(self, mesh: Mesh) -> AbstractEffect:
        """Resolve what depends on the mesh, and return self."""
        return self

    @abstractmethod
    def coefficients(self) -> Any:
        """Return what the hooks need of the learnable parameters; called once per rollout."""

    def force(self, c: Any, inputs: EffectInputs) -> Tensor | None:
        """Return the force in N, [..., V, 3] or [..., E, 3] (see ``acts_on``); None: no force."""
        return None

    def viscous(self, c: Any, inputs: EffectInputs) -> Tensor | None:
        """Return the part of ``force`` that is linear in velocity and may be stiff, [..., V, 3] N; None: no such part.

        It acts in stages, so it does not shorten the substep. At fixed positions it must be -C v with C symmetric and
        not negative. ``viscous_stability_bound`` must be overridden too, and ``acts_on`` must be "vertices".
        """
        return None

    def mass(self, c: Any) -> Tensor | None:
        """Return mass that the vertices carry along, [..., V, 1] kg; None: no mass."""
        return None

    def inertia(self, c: Any, surface: Surface) -> Tensor | None:
        """Return added mass that a triangle moves along its normal only, [..., E, 1] kg; None: no added mass."""
        return None

    def rest_deformation(self, c: Any) -> Tensor | None:
        """Return the rest deformation [..., E or 1, 2, 2]; None: the pattern is the rest shape.

        Its columns are warp and weft of the pattern, as it is drawn, in the true rest shape. They do not depend on the
        winding of the triangles.
        """
        return None

    def grip_compliance(self, c: Any) -> float:
        """Return the largest speed that ``grip_velocities`` gives per force [m/(N s)].

        Viscous forces on vertices that yield much are not applied in stages.
        """
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
        """Return the velocities of vertices in an imperfect grip, [..., V, 3] m/s.

        Args:
            c: coefficients.
            index: [H], the gripped vertices.
            free: [..., V, 3] m/s, velocities without the grip.
            gripped: [..., V, 3] m/s, velocities in a perfect grip.
            mass: [..., V, 1] kg, vertex masses.
            dt: length of the substep [s].
            added_mass_ratio: [..., V, 3, 3], mass of the air that moves along over the vertices' own; None: no air.
        """
        return gripped

    def initial_memory(self, x: Tensor) -> Tensor | None:
        """Return internal variables [..., N, K] of a new cloth at positions [..., V, 3]; None: the effect has none."""
        return None

    def update_memory(self, c: Any, inputs: EffectInputs) -> Tensor:
        """Return the internal variables at the present state, from the earlier ones ``inputs.memory``.

        It is called before ``force``.
        """
        raise NotImplementedError(f"{type(self).__name__} has initial_memory, but does not override update_memory")

    def stability_bounds(self, c: Any, mass: Tensor) -> tuple[Tensor, Tensor]:
        """Return bounds on omega^2 [1/s^2] and on the linear damping rate [1/s] that the effect adds.

        They limit the substep. ``mass`` is [..., V, 1] kg.
        """
        return mass.new_zeros(()), mass.new_zeros(())

    def viscous_stability_bound(self, c: Any, mass: Tensor) -> Tensor:
        """Return the part of that damping rate [1/s] which is ``viscous``."""
        return mass.new_zeros(())


def require_memory(inputs: EffectInputs) -> Tensor:
    """Return the internal variables of an effect that needs them.

    Raises:
        InvalidInput: the state has none.
    """
    if inputs.memory is None:
        raise InvalidInput(
            "memory of an effect", got="none", expected="internal variables", remedy="take the state from Cloth.state"
        )
    return inputs.memory
