"""A cloth with contact on a device: as one without it while no layers are near each other.

Directors away from other layers are the normals, so nothing of contact has to be computed there. Stretches in which
layers meet are for the reference.
"""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor

from ..boundaries import Drive
from ..dynamics import Impulses, added
from ..model import Model, surface
from ..transfer import Grid
from ..types import ClothState
from .cuda.layers import LayerSearch
from .fused import Fused

FASTER = 1.2  # than a vertex is at the start of some substeps, in the middle of them
CONTACT = "contact"  # key of how fast directors close, among the internal variables
Stretch = tuple[ClothState, Tensor | None, Impulses]


class Apart:
    """The stretches of one simulation.

    Raises:
        Unfused: a part without kernels.
        Unbuilt: no compiler for the device.
    """

    able = True

    def __init__(self, model: Model, grid: Grid, state: ClothState, drives: Mapping[str, Drive]) -> None:
        self.model, self.grid = model, grid
        self.fused = Fused(model._replace(grid=None), _without(state), drives)
        self._search = LayerSearch(model, grid)
        self._clear: Tensor | None = None  # positions [..., V, 3] m, at which no layers were near

    def stretch(
        self,
        state: ClothState,
        lost: Tensor | None,
        dt: float,
        drives: Mapping[str, Drive],
        substeps: int,
        first: int = 0,
    ) -> Stretch | None:
        """As ``functional.stretch``; None where layers meet."""
        total: Impulses = {}
        last = first + substeps
        while first < last:
            found = self._some(state, lost, dt, drives, first, last)
            if found is None:
                return None
            (state, lost, impulses), first = found
            total = added(total, impulses)
        return self._with_directors(state, lost), lost, total

    def _some(
        self, state: ClothState, lost: Tensor | None, dt: float, drives: Mapping[str, Drive], first: int, last: int
    ) -> tuple[Stretch, int] | None:
        """(as many substeps as are sure to meet no layers, which comes next)."""
        moved = float("inf") if self._clear is None else float((state.x.detach() - self._clear).abs().max())
        if moved > self.grid.skin / 4:  # little room is left
            if self._search.any_near(state.x):
                self._clear = None
                return None
            self._clear, moved = state.x.detach(), 0.0
        room = self.grid.skin / 2 - moved
        soon = room / (FASTER * dt * float(state.v.detach().abs().max()) + 1e-12)  # substeps
        count = max(1, min(last - first, int(soon))) if soon == soon else last - first
        while True:
            found, way = self.fused.measured(_without(state), lost, dt, drives, count, first)
            # one substep goes nowhere before it is over; what is not finite is found by others
            if count == 1 or not float(way.max()) >= room:
                return found, first + count
            count //= 2

    def _with_directors(self, state: ClothState, lost: Tensor | None) -> ClothState:
        n = surface(self.model.geometry, state.x, state.v, lost).n
        d3 = n.repeat_interleave(len(self.grid.points), dim=-2)
        return state._replace(d3=d3, memory=state.memory | {CONTACT: d3.new_zeros(*d3.shape[:-1], 1)})


def _without(state: ClothState) -> ClothState:
    """Of a cloth without contact."""
    return state._replace(memory={key: t for key, t in state.memory.items() if key != CONTACT})
