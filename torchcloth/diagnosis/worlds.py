"""The worlds that are simulated about a model's point, each made once for all episodes.

A world is a cloth of its own, whose stencils take as long to make as an episode of some meshes takes to simulate.
Nobody changes one, so all episodes and threads may share it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from threading import RLock
from typing import Any, TypeVar

from ..errors import InvalidInput, SimulationDiverged, UnstableStep
from .steps import shifted
from .world import Hypothesis, Model, World

IMPOSSIBLE = (InvalidInput, SimulationDiverged, UnstableStep)  # no world has such values, or none that is stable
T = TypeVar("T")


class Worlds:
    """Worlds of a model, made when they are first asked for.

    Args:
        model: at its point.
        shifts: (coordinate, step) of the points beside.
        finer: the same base on a finer mesh.
    """

    def __init__(self, model: Model, shifts: Sequence[tuple[int, float]] = (), finer: World | None = None) -> None:
        self.model, self.shifts, self._finer = model, list(shifts), finer
        self._made: dict[object, Any] = {}
        self._making = RLock()

    @property
    def plain(self) -> World:
        """At the point."""
        return self._once("plain", self.model.world)

    @property
    def beside(self) -> list[World]:
        """At the points beside."""
        return [self._once(k, lambda s=s: shifted(self.model, *s).world()) for k, s in enumerate(self.shifts)]

    @property
    def finest(self) -> World:
        """At the point, on the finer mesh."""
        if self._finer is None:
            raise ValueError("no finer mesh")
        base = self._finer
        return self._once("finest", lambda: replace(self.model, base=base).world())

    def changed(self, hypothesis: Hypothesis) -> World | None:
        """With a hypothesis at its typical amplitude; None: no such world."""
        name = (hypothesis.name, hypothesis.typical)
        return self._once(name, lambda: if_possible(lambda: hypothesis.apply(self.plain, hypothesis.typical)))

    def _once(self, key: object, make: Callable[[], T]) -> T:
        with self._making:
            if key not in self._made:
                self._made[key] = make()
            return self._made[key]


def if_possible(work: Callable[[], T]) -> T | None:
    """What comes of it; None of what no world allows, or what cannot be simulated."""
    try:
        return work()
    except IMPOSSIBLE:
        return None
