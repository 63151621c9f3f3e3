"""Contact between layers of cloth: ``self_contact`` in the engine's words.

The stage ``Layers`` finds the triangles that take part and the nodes around their points. Loops over those points then
press (before the velocities) and let the directors follow (at the end). What the nodes do to the velocities is written
as a force: added mass resists it as it does all forces.
"""

from __future__ import annotations

from enum import IntEnum

import torch
from torch import Tensor

from ...dynamics.contact import FADING, Grid
from ...dynamics.contact.self_contact import CHUNK
from ...materials import AEP, OrthotropicAEP, StiffeningAEP
from ..fields import Field
from ..loops import VARYING, By
from ..lowering import DIRECTORS, Lowering, Unfused
from ..stages import Layers
from .patches import patches

_LAWS = (AEP, OrthotropicAEP, StiffeningAEP)  # whose law across the sheet is that of DirectorMaterial


class Rows(IntEnum):
    """What ``Layers`` lists, as in csrc/contact.h."""

    CORNERS, TRIANGLE, OWN, PLACE, NODES = 0, 3, 4, 5, 6
    WOKEN, ASLEEP = 7, 13  # where those of other points begin

    def table(self, offset: int = 0) -> int:
        """How an instruction names it."""
        return VARYING - self - offset


class Count(IntEnum):
    """And how many."""

    POINTS, WOKEN, ASLEEP = range(3)


class Contact:
    """Contact of a program under construction."""

    def __init__(self, low: Lowering, grid: Grid) -> None:
        model = low.model
        if type(model.material) not in _LAWS:
            raise Unfused(f"contact of the material {type(model.material).__name__}")
        self.low, self.grid = low, grid
        self.d3, self.closing = low.memory[DIRECTORS], low.memory["contact"]
        program = low.program
        self.mass, self.momentum, self.change, self.velocity = self.nodes = [program.nodes() for _ in range(4)]
        self.points = [program.points(comps) for comps in (16, 3, 1)]  # surface, offset, mass
        self.lowest = program.points(3)  # node
        self.lengths = program.constant(torch.tensor([[grid.spacing, 1 / grid.spacing]], dtype=torch.float64))
        self.share = low.number(1 / len(grid.points))
        self.least = torch.finfo(program.dtype).tiny ** 0.5  # kg
        self.play = low.number(grid.play)
        slowing = 2 * grid.damping / (FADING * grid.spacing) ** 2
        self.losses = program.constant(torch.tensor([[grid.damping, slowing]], dtype=torch.float64))
        self.places = program.constant(grid.points)
        self.area = program.constant(model.geometry.area)
        self.shape = program.constant(torch.cat([*model.geometry.warp, *model.geometry.weft], dim=-1))

    def press(self) -> None:
        """Forces of the directors: on the corners, and on the nodes."""
        self.low.program.contact(self._layers())
        self._alone(Count.WOKEN, Rows.WOKEN, self.low.x.now, self.d3.now, self.closing.now)
        p = _Points(self, again=True, first=True)
        contact, shear, _ = self._law(p)
        d3, closing = p.own(self.d3.now), p.own(self.closing.now)
        f1, f2, n, J = p.surface[0:3], p.surface[3:6], p.surface[12:15], p.surface[15:]
        density = p.parameter(self.low.model.areal_density)
        constants = [p.loop.load(field) for field in (self.low.dt, self.play, self.losses)]
        area, share = p.area, p.share
        given = p.loop.call("pressure", n, J, f1, f2, d3, closing, density, contact, shear, area, share, *constants)
        forces = p.loop.call("assemble", given[:6], p.shape, area)
        p.to_corners(forces, self.low.force)
        shares = p.loop.call("force_shares", p.lengths, d3, p.mass, given[6:])
        p.loop.spread(p.offset, shares, self.mass, Rows.NODES.table(), By.SLOPES)
        self.low.program.per_mass(self.mass, self.mass, self.change, self.least)
        self._repel()

    def _repel(self) -> None:
        p = _Points(self)
        change = p.loop.collect(p.offset, self.change, Rows.NODES.table(), By.ARMS)
        forces = p.loop.call("corner_forces", p.surface, p.mass, change, p.place, p.shape, p.lengths)
        p.to_corners(forces, self.low.force)

    def follow(self) -> None:
        """Directors after the substep."""
        p = _Points(self, again=True)
        v = p.corners(self.low.v.after)
        carried = p.loop.call("carried", p.surface, *v, p.mass, p.place, p.shape, p.lengths)
        p.loop.spread(p.offset, carried, self.momentum, Rows.NODES.table(), By.ARMS)
        self.low.program.per_mass(self.mass, self.momentum, self.velocity, self.least)
        self._turn()
        after = self.low.x.after, self.d3.after, self.closing.after
        self._alone(Count.ASLEEP, Rows.ASLEEP, *after)

    def _turn(self) -> None:
        p = _Points(self)
        d3 = p.own(self.d3.now)
        around = p.loop.collect(p.offset, self.velocity, Rows.NODES.table(), By.SLOPES)
        now = p.loop.call("surface", *p.corners(self.low.x.after), p.shape)[12:15]
        constants = p.loop.load(self.low.dt), p.loop.load(self.play)
        out = p.loop.call("follow", p.surface[12:15], now, d3, around, p.lengths, *self._law(p), *constants)
        p.loop.put(out[:3], self.d3.after, Rows.OWN.table())
        p.loop.put(out[3:], self.closing.after, Rows.OWN.table())

    def _law(self, p: _Points) -> list[list[int]]:
        """Registers of k h, gamma h and c_F."""
        c = self.low.model.coefficients
        return [p.parameter(value) for value in (c.contact, c.shear, c.cone)]

    def _alone(self, count: Count, rows: Rows, x: Field, d3: Field, closing: Field) -> None:
        """Directors far from other layers are the normals."""
        loop = self.low.program.varying(count)
        corners = [loop.load(x, rows.table(Rows.CORNERS + k)) for k in range(3)]
        surface = loop.call("surface", *corners, loop.load(self.shape, rows.table(Rows.TRIANGLE)))
        out = loop.call("alone", surface[12:15])
        loop.put(out[:3], d3, rows.table(Rows.OWN))
        loop.put(out[3:], closing, rows.table(Rows.OWN))

    def _layers(self) -> Layers:
        grid, corners = self.grid, self.low.model.geometry.corners.view(3, -1)
        found = patches(grid, corners)
        return Layers(
            fields=[self.low.x.now, self.lowest, *self.nodes, *self.points],
            corners=corners.cpu().numpy().astype("int32"),
            places=grid.points.cpu().double().numpy(),
            lengths=(grid.spacing, grid.skin, grid.reach),
            chunk=CHUNK,
            order=found.order,
            starts=found.starts,
            meet=found.meet,
            apart=found.apart,
        )


class _Points:
    """A loop over the points that take part; the first finds what they all need."""

    def __init__(self, contact: Contact, again: bool = False, first: bool = False) -> None:
        self._contact, self.loop = contact, contact.low.program.varying(Count.POINTS, again)
        find = self._find if first else self._look
        self.surface, self.offset, self.mass = find()

    def _look(self) -> list[list[int]]:
        return [self.loop.load(field) for field in self._contact.points]

    def _find(self) -> list[list[int]]:
        corners = self.corners(self._contact.low.x.now)
        density = self.parameter(self._contact.low.model.areal_density)
        found = [
            self.loop.call("surface", *corners, self.shape),
            self.loop.call("offset", self.lengths, self.loop.load(self._contact.lowest), self.place, *corners),
            self.loop.call("point_mass", density, self.area, self.share),
        ]
        for regs, field in zip(found, self._contact.points, strict=True):
            self.loop.put(regs, field)
        return found

    @property
    def shape(self) -> list[int]:
        """Of the triangle at rest."""
        return self.loop.load(self._contact.shape, Rows.TRIANGLE.table())

    @property
    def area(self) -> list[int]:
        """Of the triangle at rest."""
        return self.loop.load(self._contact.area, Rows.TRIANGLE.table())

    @property
    def share(self) -> list[int]:
        """Of the triangle that belongs to the point."""
        return self.loop.load(self._contact.share)

    @property
    def place(self) -> list[int]:
        """Barycentric."""
        return self.loop.load(self._contact.places, Rows.PLACE.table())

    @property
    def lengths(self) -> list[int]:
        """Spacing of the grid and one over it."""
        return self.loop.load(self._contact.lengths)

    def corners(self, field: Field) -> list[list[int]]:
        """Registers of a vertex field at the triangle's corners."""
        return [self.loop.load(field, Rows.CORNERS.table(k)) for k in range(3)]

    def to_corners(self, shares: list[int], field: Field) -> None:
        """Add nine numbers to a vertex field at the corners."""
        for k in range(3):
            self.loop.add(shares[3 * k : 3 * k + 3], field, Rows.CORNERS.table(k))

    def own(self, field: Field) -> list[int]:
        """Registers of a field of all points."""
        return self.loop.load(field, Rows.OWN.table())

    def parameter(self, tensor: Tensor) -> list[int]:
        """Registers of a coefficient [..., 1 or E, 1]."""
        return self.loop.load(self._contact.low.parameter(tensor), Rows.TRIANGLE.table())
