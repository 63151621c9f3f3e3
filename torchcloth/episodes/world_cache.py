"""The worlds that are simulated about a model's point, each made once for all episodes.

A world is a cloth of its own, whose stencils take as long to make as an episode of some meshes takes to simulate.
Nobody changes one, so all episodes and threads may share it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from threading import RLock
from typing import Any, TypeVar

from .._utils.caching import Recent
from ..errors import InvalidInput, SimulationDiverged, UnstableStep
from .observed import Episode
from .replay import Frames
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
        recent: what has been simulated at this point and at others; None: nobody comes back to it.
    """

    def __init__(
        self,
        model: Model,
        shifts: Sequence[tuple[int, float]] = (),
        finer: World | None = None,
        recent: Recent[Frames] | None = None,
    ) -> None:
        self.model, self.shifts, self._finer = model, list(shifts), finer
        self._recent = recent
        self._made: dict[object, Any] = {}
        self._making = RLock()

    @property
    def plain(self) -> World:
        """At the point."""
        return self._once("plain", self.model.world)

    @property
    def beside(self) -> list[World]:
        """At the points beside; on the finer mesh along what has its slopes there."""
        make = lambda shift, finer: shifted(self._on_finer if finer else self.model, *shift).world()  # noqa: E731
        sides = enumerate(zip(self.shifts, self.finer_beside, strict=True))
        return [self._once(k, partial(make, *side)) for k, side in sides]

    @property
    def finest(self) -> World:
        """At the point, on the finer mesh."""
        return self._once("finest", lambda: self._on_finer.world())

    def happens(self, e: Episode, dt: float | None, finer: bool = False) -> Frames:
        """An episode at the point, on the finer mesh if asked for, whoever looks on; nobody may write to it."""
        model, world = self._on_finer if finer else self.model, self._at(finer)
        if self._recent is None:
            return world.simulated(e, dt)
        point = (model.base, model.parameters, model.accepted, tuple(model.point.tolist()))
        return self._recent.of((point, e, dt), partial(world.simulated, e, dt))

    def seen(self, e: Episode, dt: float | None, finer: bool = False) -> Frames:
        """What an observer has of that."""
        return self._at(finer).seen(self.happens(e, dt, finer), e)

    def changed(self, hypothesis: Hypothesis, finer: bool = False) -> World | None:
        """With a hypothesis at its typical amplitude, on the finer mesh if asked for; None: no such world."""
        h = hypothesis
        return self._once(
            (h.name, h.typical, finer), lambda: if_possible(lambda: h.applied(self._at(finer), h.typical))
        )

    def _at(self, finer: bool) -> World:
        return self.finest if finer else self.plain

    def is_finer(self, hypothesis: Hypothesis) -> bool:
        """Its slopes are taken on the finer mesh; there must be one."""
        return hypothesis.finer and self._finer is not None

    @property
    def finer_beside(self) -> list[bool]:
        """Which points beside are looked at on the finer mesh."""
        own = [*(False for _ in self.model.parameters), *map(self.is_finer, self.model.accepted)]
        return [own[coordinate] for coordinate, _ in self.shifts]

    @property
    def _on_finer(self) -> Model:
        if self._finer is None:
            raise ValueError("no finer mesh")
        return replace(self.model, base=self._finer)

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
