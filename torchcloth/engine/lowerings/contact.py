"""Contact between layers of cloth: ``dynamics/contact/self_contact.py`` in the engine's words.

The stage ``ContactSearch`` finds the active triangles and the grid nodes around their points. Loops over these points
add the contact forces (before the velocities) and update the directors (at the end). What the nodes do to the
velocities is written as a force, so that added mass resists it as it does all forces.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ...dynamics.contact import COMPRESSION_PER_SPACING, Grid
from ...dynamics.contact.self_contact import SUBSTEPS_PER_CHECKPOINT
from ..builder import DIRECTORS, SubstepBuilder, UnsupportedPart, lowering_of
from ..enums import CONTACT_ROWS, ContactCount, ContactTable, TransferBasis
from ..fields import Field
from ..stages import ContactSearch
from .patches import patches_of


def _table(table: ContactTable, offset: int = 0) -> int:
    """Number by which an instruction names a table that the contact search lists."""
    return CONTACT_ROWS - table - offset


class ContactLowering:
    """Contact of a program under construction.

    Raises:
        UnsupportedPart: the engine does not know the material's law across the sheet.
    """

    def __init__(self, builder: SubstepBuilder, grid: Grid) -> None:
        model = builder.model
        if lowering_of(model.material) is None:
            raise UnsupportedPart(f"contact of the material {type(model.material).__name__}")
        self.builder, self.grid = builder, grid
        self.d3, self.closing = builder.memory[DIRECTORS], builder.memory["contact"]
        program = builder.program
        self.mass, self.momentum, self.change, self.velocity = self.nodes = [program.nodes() for _ in range(4)]
        self.points = [program.points(comps) for comps in (16, 3, 1)]  # surface, offset, mass
        self.lowest_node = program.points(3)
        self.shift = builder.grid_shift = program.per_substep(3)
        self.lengths = program.constant(torch.tensor([[grid.spacing, 1 / grid.spacing]], dtype=torch.float64))
        self.area_share = builder.number(1 / len(grid.points))
        self.min_mass_kg = torch.finfo(program.dtype).tiny ** 0.5
        self.clearance = builder.number(grid.free_compression)
        slowing = 2 * grid.damping * (COMPRESSION_PER_SPACING / grid.spacing) ** 2
        self.damping = program.constant(torch.tensor([[grid.damping, slowing]], dtype=torch.float64))
        self.barycentric = program.constant(grid.points)
        self.area = program.constant(model.geometry.area)
        self.shape = program.constant(torch.cat([*model.geometry.warp, *model.geometry.weft], dim=-1))

    def add_forces(self) -> None:
        """Add the forces of compressed directors on the triangles' corners, and those of the nodes."""
        builder = self.builder
        builder.program.contact_search(self._search())
        at_start = builder.x.start, self.d3.start, self.closing.start
        self._reset_directors(ContactCount.ACTIVATED, ContactTable.ACTIVATED, *at_start)

        # stress of the directors, and what they push on the nodes
        p = _PointLoop(self, is_replayed=True, is_first=True)
        contact, shear, _ = self._law(p)
        d3, closing = p.point_value(self.d3.start), p.point_value(self.closing.start)
        f1, f2, n, J = p.surface[0:3], p.surface[3:6], p.surface[12:15], p.surface[15:]
        density = p.parameter(builder.model.areal_density)
        constants = [p.loop.load(field) for field in (builder.dt, self.clearance, self.damping)]
        inputs = n, J, f1, f2, d3, closing, density, contact, shear, p.area, p.area_share, *constants
        pressure = p.loop.call("contact_pressure", *inputs)
        p.add_to_corners(p.loop.call("assemble_forces", pressure[:6], p.shape, p.area), builder.force)
        shares = p.loop.call("force_shares", p.lengths, d3, p.mass, pressure[6:])
        p.loop.p2g(p.offset, shares, self.mass, _table(ContactTable.NODES), TransferBasis.GRADIENT)
        builder.program.grid_velocity(self.mass, self.mass, self.change, self.min_mass_kg)

        # acceleration of the nodes as forces on the corners
        p = _PointLoop(self)
        change = p.loop.g2p(p.offset, self.change, _table(ContactTable.NODES), TransferBasis.AFFINE)
        forces = p.loop.call("corner_forces", p.surface, p.mass, change, p.place, p.shape, p.lengths)
        p.add_to_corners(forces, builder.force)

    def update_directors(self) -> None:
        """Let the directors follow the nodes' velocities, at the end of the substep."""
        builder = self.builder
        p = _PointLoop(self, is_replayed=True)
        v = p.corner_values(builder.v.end)
        shares = p.loop.call("momentum_shares", p.surface, *v, p.mass, p.place, p.shape, p.lengths)
        p.loop.p2g(p.offset, shares, self.momentum, _table(ContactTable.NODES), TransferBasis.AFFINE)
        builder.program.grid_velocity(self.mass, self.momentum, self.velocity, self.min_mass_kg)

        p = _PointLoop(self)
        d3 = p.point_value(self.d3.start)
        gradient = p.loop.g2p(p.offset, self.velocity, _table(ContactTable.NODES), TransferBasis.GRADIENT)
        normal = p.loop.call("surface", *p.corner_values(builder.x.end), p.shape)[12:15]
        constants = p.loop.load(builder.dt), p.loop.load(self.clearance)
        inputs = p.surface[12:15], normal, d3, gradient, p.lengths, *self._law(p), *constants
        out = p.loop.call("update_director", *inputs)
        p.loop.store(out[:3], self.d3.end, _table(ContactTable.POINT))
        p.loop.store(out[3:], self.closing.end, _table(ContactTable.POINT))

        at_end = builder.x.end, self.d3.end, self.closing.end
        self._reset_directors(ContactCount.INACTIVE, ContactTable.INACTIVE, *at_end)

    def _law(self, p: _PointLoop) -> list[list[int]]:
        """Registers of k h, gamma h and c_F."""
        c = self.builder.model.coefficients
        return [p.parameter(value) for value in (c.contact, c.shear, c.cone)]

    def _reset_directors(self, count: ContactCount, group: ContactTable, x: Field, d3: Field, closing: Field) -> None:
        """Set directors far from other layers to the normals."""
        loop = self.builder.program.loop_over_contact(count)
        corners = [loop.load(x, _table(group, ContactTable.CORNERS + k)) for k in range(3)]
        shape = loop.load(self.shape, _table(group, ContactTable.TRIANGLE))
        surface = loop.call("surface", *corners, shape)
        out = loop.call("reset_director", surface[12:15])
        loop.store(out[:3], d3, _table(group, ContactTable.POINT))
        loop.store(out[3:], closing, _table(group, ContactTable.POINT))

    def _search(self) -> ContactSearch:
        grid, corners = self.grid, self.builder.model.geometry.corners.view(3, -1)
        patches = patches_of(grid, corners)
        return ContactSearch(
            fields=[self.builder.x.start, self.lowest_node, self.shift, *self.nodes, *self.points],
            corners=corners.cpu().numpy().astype("int32"),
            barycentric=grid.points.cpu().double().numpy(),
            lengths=(grid.spacing, grid.search_skin, grid.reach),
            search_interval=SUBSTEPS_PER_CHECKPOINT,
            order=patches.order,
            patch_starts=patches.starts,
            patches_may_meet=patches.may_meet,
            non_adjacent=patches.non_adjacent,
        )


class _PointLoop:
    """A loop over the active points; the first such loop computes what all of them need.

    Attributes:
        loop: the loop.
        surface: registers of the triangle's surface (16 numbers).
        offset: registers of the point's offset from its lowest node, in grid spacings.
        mass: register of the point's mass.
    """

    def __init__(self, contact: ContactLowering, is_replayed: bool = False, is_first: bool = False) -> None:
        self._contact = contact
        self.loop = contact.builder.program.loop_over_contact(ContactCount.ACTIVE, is_replayed)
        shared = self._compute() if is_first else [self.loop.load(field) for field in contact.points]
        self.surface, self.offset, self.mass = shared

    def _compute(self) -> list[list[int]]:
        corners = self.corner_values(self._contact.builder.x.start)
        density = self.parameter(self._contact.builder.model.areal_density)
        lowest = self.loop.load(self._contact.lowest_node)
        values = [
            self.loop.call("surface", *corners, self.shape),
            self.loop.call(
                "grid_offset", self.lengths, self.loop.load(self._contact.shift), lowest, self.place, *corners
            ),
            self.loop.call("point_mass", density, self.area, self.area_share),
        ]
        for regs, field in zip(values, self._contact.points, strict=True):
            self.loop.store(regs, field)
        return values

    @property
    def shape(self) -> list[int]:
        """Registers of the rest shape of the triangle: warp and weft coefficients of its edges."""
        return self.loop.load(self._contact.shape, _table(ContactTable.TRIANGLE))

    @property
    def area(self) -> list[int]:
        """Register of the rest area of the triangle [m^2]."""
        return self.loop.load(self._contact.area, _table(ContactTable.TRIANGLE))

    @property
    def area_share(self) -> list[int]:
        """Register of the fraction of the triangle that belongs to the point."""
        return self.loop.load(self._contact.area_share)

    @property
    def place(self) -> list[int]:
        """Registers of the barycentric coordinates of the point."""
        return self.loop.load(self._contact.barycentric, _table(ContactTable.PLACE))

    @property
    def lengths(self) -> list[int]:
        """Registers of the grid's spacing [m] and its inverse [1/m]."""
        return self.loop.load(self._contact.lengths)

    def corner_values(self, field: Field) -> list[list[int]]:
        """Registers of a vertex field at the triangle's corners."""
        return [self.loop.load(field, _table(ContactTable.CORNERS, k)) for k in range(3)]

    def add_to_corners(self, values: list[int], field: Field) -> None:
        """Add nine numbers to a vertex field at the corners."""
        for k in range(3):
            self.loop.add(values[3 * k : 3 * k + 3], field, _table(ContactTable.CORNERS, k))

    def point_value(self, field: Field) -> list[int]:
        """Registers of a field of all points."""
        return self.loop.load(field, _table(ContactTable.POINT))

    def parameter(self, tensor: Tensor) -> list[int]:
        """Registers of a coefficient [..., 1 or E, 1]."""
        return self.loop.load(self._contact.builder.parameter(tensor), _table(ContactTable.TRIANGLE))
