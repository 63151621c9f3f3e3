"""A program under construction: its fields, the loops that several parts write into, and the register of lowerings.

A lowering turns one part of the model (a material, an effect, a boundary, a law of friction) into instructions of a
program. It lies in ``lowerings/`` and registers itself by the exact type of the part:

    @lowers(Gravity)
    def lower_weight(builder, name, effect, c): ...

A subclass may have changed the law, so it is not its base class's lowering that serves it.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor

from ..boundaries import PrescribedMotion
from ..dynamics.model import Model
from ..effects._bending_stencil import BendingStencil
from ..types import ClothState
from .enums import MAX_LANES, StencilForm
from .fields import Field
from .host_arrays import to_numpy
from .loops import Loop
from .program import Program

DIRECTORS = "d3"  # key of the state's directors among the internal variables, where there is contact
PACKS_PER_GROUP = 16  # packs whose items ``conflict_free_order`` spreads over one group
FunctionT = TypeVar("FunctionT", bound=Callable)


class UnsupportedPart(Exception):
    """The engine has no kernels for a part; the text names the part.

    Attributes:
        part: "material" or "effects.NAME"; None for a part that torch cannot take over.
    """

    part: str | None = None


_LOWERINGS: dict[type, Callable[..., Any]] = {}


def lowers(*types: type) -> Callable[[FunctionT], FunctionT]:
    """Register the decorated function as the lowering of parts of exactly these types."""

    def register(function: FunctionT) -> FunctionT:
        for cls in types:
            if cls in _LOWERINGS:
                raise RuntimeError(f"{cls.__name__} has two lowerings")
            _LOWERINGS[cls] = function
        return function

    return register


def lowering_of(part: object) -> Callable[..., Any] | None:
    """Return the lowering of a part's exact type; None without one."""
    return _LOWERINGS.get(type(part))


class StateField(NamedTuple):
    """A state variable of the program.

    Attributes:
        start: field with its value at the start of the substep.
        end: field with its value at the end.
    """

    start: Field
    end: Field


class PrescribedFields(NamedTuple):
    """Fields of a prescribed motion, one row for every substep.

    Attributes:
        increment: [16] change of the pose during the substep, a 4 x 4 matrix.
        pose: [16] pose at the end of the substep.
        closed: [1] 1 where a gripper is closed, else 0.
    """

    increment: Field
    pose: Field
    closed: Field


class SubstepBuilder:
    """The program of a substep under construction, and the tensors that it will run on.

    Args:
        model: the parts.
        state: of the simulation; only shapes, precision and device count.
        prescribed: motions by boundary; only names count.
        in_torch: parts that torch computes beside the engine.

    Attributes:
        model: the parts.
        program: the program.
        vertices, faces: counts of the mesh.
        device: device of the tensors.
        x, v: positions and velocities.
        compensation: rounding error of the positions that is carried over (Kahan summation); None in float64.
        memory: internal variables by key, as in ``ClothState.memory``.
        dt: [1] substep [s].
        mass: [V, 1] kg.
        force: [V, 3] N, to be added to.
        vertex_forces: kernels that give each vertex a force of its own, with the fields whose rows they take.
        viscous_forces: each adds the viscous force of velocities to a field, both [V, 3]; used where the model has
            viscous stages.
        added_mass: [V, 6] kg, mass of the air that moves along (xx, xy, xz, yy, yz, zz), to be added to; None without.
        corners: numbers of the tables of the triangles' three vertices.
        triangles: the loop over triangles that comes first.
        bending_loops: loops over vertices that see how the sheet is bent, by the weights of their stencils.
        inputs: parameter fields with their tensors [..., rows, comps].
        torch_force: a parameter field without tensor for the force of the parts in torch; None without such parts.
        prescribed: fields of the prescribed motions, by boundary.
        impulses: [6] fields of the impulses, by boundary.
    """

    def __init__(
        self,
        model: Model,
        state: ClothState,
        prescribed: Mapping[str, PrescribedMotion],
        in_torch: Collection[str] = (),
    ) -> None:
        self.model = model
        self.vertices, self.faces = state.x.shape[-2], len(model.geometry.area)
        self.device = state.x.device
        self.program = Program(state.x.dtype, self.vertices)
        self.inputs: dict[Field, Tensor] = {}
        self._parameter_fields: dict[int, Field] = {}
        self.x, self.v = (StateField(*self.program.state(self.vertices, 3)) for _ in range(2))
        self.compensation: StateField | None = None
        if state.x.dtype == torch.float32:
            self.compensation = StateField(*self.program.state(self.vertices, 3))
            zero = torch.zeros(self.vertices, 3, dtype=torch.float32, device=self.device)
            self.inputs[self.compensation.start] = zero
        variables = {key: value for key, value in internal_variables(model, state).items() if key not in in_torch}
        self.memory = {key: StateField(*self.program.state(*value.shape[-2:])) for key, value in variables.items()}
        self.dt = self.program.per_substep(1)
        self.grid_shift: Field | None = None  # of contact
        self.mass = self.parameter(model.mass)
        self.force = self.program.temporary(self.vertices, 3)
        self.vertex_forces: list[tuple[str, tuple[Field, ...]]] = []
        self.viscous_forces: list[Callable[[Field, Field], None]] = []
        self.torch_force = self._force_from_torch() if in_torch else None
        self.added_mass: Field | None = None
        order = conflict_free_order(self.faces)
        self.corners = [self.program.table(c[order]) for c in to_numpy(model.geometry.corners).reshape(3, -1)]
        self.triangles = TriangleLoop(self)
        self.bending_loops: dict[Field, BendingLoop] = {}
        row = self.program.per_substep
        self.prescribed = {name: PrescribedFields(row(16), row(16), row(1)) for name in prescribed}
        self.impulses = {name: self.program.sum(6) for name in prescribed}

    @property
    def state_fields(self) -> dict[str, StateField]:
        """All variables that go on from substep to substep but the compensation, by their names in the state."""
        return {"x": self.x, "v": self.v, **self.memory}

    def parameter(self, tensor: Tensor, neighbours: int = 0) -> Field:
        """Return the input field of a coefficient [..., rows, comps]; one tensor has one field.

        ``neighbours``: as for ``Program.parameter``.
        """
        if id(tensor) not in self._parameter_fields:
            field = self.program.parameter(tensor.shape[-2], tensor.shape[-1], neighbours)
            self._parameter_fields[id(tensor)], self.inputs[field] = field, tensor
        return self._parameter_fields[id(tensor)]

    def number(self, value: float) -> Field:
        """Return a [1, 1] constant field that holds ``value``; kernels read it as they read a parameter."""
        return self.program.constant(np.array([[value]]))

    def loop(self, items: int) -> Loop:
        """Append a loop, which runs after all present stages."""
        return self.program.loop(items)

    def add_vertex_force(self, kernel: str, *fields: Field) -> None:
        """Add a force on every vertex that a kernel computes from the vertex's own row of these fields."""
        self.vertex_forces.append((kernel, fields))

    def bending_loop(self, sheet: BendingStencil) -> BendingLoop:
        """Return the loop of these stencils, which all effects that see the same bending share."""
        weight = self.program.constant(sheet.weight.reshape(-1, 1), neighbours=len(sheet.neighbours))
        if weight not in self.bending_loops:
            self.bending_loops[weight] = BendingLoop(self, sheet, weight)
        return self.bending_loops[weight]

    def close_force_loops(self) -> None:
        """Write the forces of the shared loops; no part may add to them afterwards."""
        self.triangles.close()
        for loop in self.bending_loops.values():
            loop.close()

    def momentum(self, loop: Loop, velocity_change: list[int], at: int | None = None) -> list[int]:
        """Return registers of the momentum that a change of velocity takes, that of the air included."""
        mass = loop.load(self.mass, at)
        if self.added_mass is None:
            return loop.call("scale3", mass, velocity_change)
        return loop.call("momentum_added_mass", loop.load(self.added_mass, at), mass, velocity_change)

    def added_mass_ratio(self, loop: Loop) -> list[int]:
        """Return registers of a vertex's added mass over its own mass; none without added mass."""
        if self.added_mass is None:
            return []
        return loop.call("added_mass_ratio", loop.load(self.added_mass), loop.load(self.mass))

    def _force_from_torch(self) -> Field:
        field = self.program.parameter(self.vertices, 3)
        self.add_vertex_force("copy3", field)
        return field


def internal_variables(model: Model, state: ClothState) -> dict[str, Tensor]:
    """Return the internal variables by key, with the directors where there is contact."""
    return dict(state.memory) if model.grid is None else {**state.memory, DIRECTORS: state.d3}


class TriangleLoop:
    """A loop over triangles that computes once what several parts need.

    Args:
        builder: the program.
        velocity: [V, 3] velocities of the vertices; None: the cloth's.
        force: [V, 3] field to be added to; None: the force on the cloth.

    Attributes:
        loop: the loop.
        shape: registers a1, a2, b1, b2 of a triangle: warp and weft coefficients of its edges.
        area: register of its rest area.
    """

    def __init__(self, builder: SubstepBuilder, velocity: Field | None = None, force: Field | None = None) -> None:
        self._builder = builder
        self._velocity = builder.v.start if velocity is None else velocity
        self._force = builder.force if force is None else force
        geometry = builder.model.geometry
        program = builder.program
        self.loop = program.loop(builder.faces, conflict_free_order(builder.faces))
        self.shape = self.loop.load(program.constant(torch.cat([*geometry.warp, *geometry.weft], dim=-1)))
        self.area = self.loop.load(program.constant(geometry.area))
        self._computed: dict[str, list[int]] = {}
        self._forces: list[int] | None = None

    def parameter(self, tensor: Tensor) -> list[int]:
        """Return registers of a coefficient [..., E or 1, comps]."""
        return self._compute_once(f"parameter {id(tensor)}", lambda: self.loop.load(self._builder.parameter(tensor)))

    @property
    def x(self) -> list[list[int]]:
        """Registers of the corners' positions; in float32 relative to the first corner, as ``surface`` sees them."""
        builder = self._builder
        positions = self._corner_registers("x", builder.x.start)
        if builder.compensation is None:
            return positions
        compensation = self._corner_registers("compensation", builder.compensation.start)
        edges = self._compute_once("edges", lambda: self.loop.call("compensated_edges", *positions, *compensation))
        return [self.loop.load(builder.program.constant(np.zeros((1, 3)))), edges[:3], edges[3:]]

    @property
    def v(self) -> list[list[int]]:
        """Registers of the corners' velocities."""
        return self._corner_registers("v", self._velocity)

    @property
    def surface(self) -> list[int]:
        """Registers of f1, f2, cofactor1, cofactor2, n and J: 16 numbers."""
        return self._compute_once("surface", lambda: self.loop.call("surface", *self.x, self.shape))

    @property
    def normal(self) -> list[int]:
        """Registers of the unit normal."""
        return self.surface[12:15]

    def add_corner_forces(self, kernel: str, *inputs: list[int]) -> None:
        """Add forces on the corners (9 numbers) that a kernel computes."""
        self._forces = self.loop.call(kernel, *inputs, into=self._forces)

    def add_stress(self, columns: list[int]) -> None:
        """Add the corner forces of the columns of a first Piola-Kirchhoff stress (6 registers)."""
        self.add_corner_forces("assemble_forces", columns, self.shape, self.area)

    def close(self) -> None:
        """Scatter the sum of all corner forces once, however many effects there are."""
        if self._forces is not None:
            for k, corner in enumerate(self._builder.corners):
                self.loop.add(self._forces[3 * k : 3 * k + 3], self._force, corner)

    def _corner_registers(self, name: str, field: Field) -> list[list[int]]:
        flat = self._compute_once(name, lambda: [r for c in self._builder.corners for r in self.loop.load(field, c)])
        return [flat[0:3], flat[3:6], flat[6:9]]

    def _compute_once(self, name: str, compute: Callable[[], list[int]]) -> list[int]:
        if name not in self._computed:
            self._computed[name] = compute()
        return self._computed[name]


class BendingLoop:
    """Loop over vertices that computes bending and turns moments into forces; ``effects/_bending_stencil.py``.

    Attributes:
        loop: the loop.
        second: registers of the second derivatives of the positions (9) and of the vertex's area (1).
    """

    def __init__(self, builder: SubstepBuilder, sheet: BendingStencil, weight: Field) -> None:
        program, near = builder.program, sheet.neighbours.cpu().numpy()
        derivatives = program.temporary(builder.vertices, 15)
        self._stress_field = program.temporary(builder.vertices, 15, is_recorded=False)
        program.stencil(near, weight, builder.x.start, derivatives)
        remembers = any(key.startswith("effects.") for key in builder.memory)
        if builder.compensation is not None and remembers:  # an effect with memory would sum up rounding errors
            program.stencil(near, weight, builder.compensation.start, derivatives)
        self.loop = builder.loop(builder.vertices)
        program.stencil(near, weight, builder.force, self._stress_field, StencilForm.TRANSPOSED)
        self._derivatives = self.loop.load(derivatives)
        self._area = self.loop.load(program.constant(sheet.area))
        self.second = [*self._derivatives[:9], *self._area]
        self._moment: list[int] | None = None
        self._stress: list[int] | None = None
        self._normal_and_curvature: list[int] = []

    @property
    def curvature(self) -> list[int]:
        """Registers of the curvature along the normal (3)."""
        if not self._normal_and_curvature:
            self._normal_and_curvature = self.loop.call("sheet_curvature", self._derivatives)
        return self._normal_and_curvature[4:]

    def add_moment(self, moment: list[int]) -> None:
        """Add a bending moment (3 registers) that works on the curvature."""
        self._moment = moment if self._moment is None else self.loop.call("copy3", moment, into=self._moment)

    def add_stress(self, stress: list[int]) -> None:
        """Add what works on the derivatives (15 registers), times the area."""
        self._stress = stress if self._stress is None else self.loop.call("copy15", stress, into=self._stress)

    def close(self) -> None:
        """Apply the transposed stencil to the sum of all stresses."""
        if self._moment is not None:
            _ = self.curvature
            inputs = self._derivatives, self._normal_and_curvature[:4], self._area, self._moment
            self.add_stress(self.loop.call("bending_stress", *inputs))
        if self._stress is not None:
            self.loop.store(self._stress, self._stress_field)


class VelocityStage:
    """The vertices' velocities between the forces and the drift: in registers as long as one loop will do.

    Attributes:
        loop: over the vertices, while the velocities are in registers.
        velocities: registers of the velocities.
        velocities_before: registers of the velocities before the present boundary.
        field: the velocities while they are in memory, for a boundary that changes few of them; else None.
    """

    def __init__(self, builder: SubstepBuilder, loop: Loop, velocities: list[int]) -> None:
        self._builder, self.loop, self.velocities, self.velocities_before = builder, loop, velocities, velocities
        self.field: Field | None = None
        self._has_drifted = False

    def spill_to_field(self) -> Field:
        """End the loop and return a field with the velocities, for work that is not done vertex by vertex."""
        field = self._store(self.velocities)
        self._spilled_before = (
            field if self.velocities_before == self.velocities else self._store(self.velocities_before)
        )
        return field

    def reload_from_field(self, field: Field) -> None:
        """Begin a new loop with the velocities of a field."""
        self.loop = self._builder.loop(self._builder.vertices)
        self.velocities, self.velocities_before = self.loop.load(field), self.loop.load(self._spilled_before)

    def to_field(self, drift: bool) -> Field:
        """Return a field with the velocities; ``drift``: they stay there, so the positions can follow at once."""
        if self.field is None and drift:
            self.drift()
            self.field = self._builder.v.end
        elif self.field is None:
            self.velocities_before = self.velocities
            self.field = self.spill_to_field()
        return self.field

    def to_registers(self) -> None:
        """Bring the velocities back into registers."""
        if self.field is not None:
            self.reload_from_field(self.field)
            self.field = None

    def scatter_rows(self, loop: Loop, rows: int, velocities: list[int]) -> None:
        """Replace the velocities of some rows of ``field``, from a loop over these.

        Raises:
            ValueError: the velocities are in registers.
        """
        if self.field is None:
            raise ValueError("the velocities are in registers")
        loop.store(velocities, self.field, rows)
        if self._has_drifted:
            self._drift_rows(loop, velocities, rows)

    def drift(self) -> None:
        """Move the positions with the velocities; a second call does nothing."""
        if not self._has_drifted:
            self.to_registers()
            self.loop.store(self.velocities, self._builder.v.end)
            self._drift_rows(self.loop, self.velocities)
            self._has_drifted = True

    def _drift_rows(self, loop: Loop, velocities: list[int], rows: int | None = None) -> None:
        builder = self._builder
        inputs = loop.load(builder.dt), loop.load(builder.x.start, rows), velocities
        if builder.compensation is None:
            loop.store(loop.call("drift", *inputs), builder.x.end, rows)
            return
        result = loop.call("drift_compensated", *inputs, loop.load(builder.compensation.start, rows))
        loop.store(result[:3], builder.x.end, rows)
        loop.store(result[3:], builder.compensation.end, rows)

    def _store(self, regs: list[int]) -> Field:
        field = self._builder.program.temporary(self._builder.vertices, 3)
        self.loop.store(regs, field)
        return field


def conflict_free_order(items: int) -> np.ndarray:
    """Return an order in which the items of a pack are far apart in the mesh.

    Additions to one vertex then need not wait for each other. Packs that follow each other are close to each other, for
    the cache, and for threads that have some of them each.
    """
    packs = -(-items // MAX_LANES)
    groups = np.array_split(np.arange(packs * MAX_LANES).reshape(packs, MAX_LANES), -(-packs // PACKS_PER_GROUP))
    order = np.concatenate([group.reshape(MAX_LANES, -1).T.ravel() for group in groups])
    return order[order < items]
