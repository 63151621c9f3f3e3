"""Cache of the worlds around a model's point, each built once for all episodes.

A world is a cloth of its own, whose stencils take as long to build as some episodes take to simulate. Worlds are never
modified, so all episodes and threads may share them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from threading import RLock
from typing import Any, TypeVar

from .._utils.caching import LRUCache
from ..errors import InvalidInput, SimulationDiverged, UnstableStep
from .observed import Episode
from .replay import Frames
from .steps import shift_model
from .world import Hypothesis, World, WorldModel

IMPOSSIBLE_WORLD_ERRORS = (InvalidInput, SimulationDiverged, UnstableStep)  # illegal values, or an unstable world
T = TypeVar("T")


class WorldCache:
    """Worlds of a model, built when they are first needed.

    Args:
        model: at its point.
        shifts: (coordinate, step) of the shifted points.
        fine_base: the base world on the fine mesh, or None.
        recent: cache of simulations at this point and others; None: they are not needed again.
    """

    def __init__(
        self,
        model: WorldModel,
        shifts: Sequence[tuple[int, float]] = (),
        fine_base: World | None = None,
        recent: LRUCache[Frames] | None = None,
    ) -> None:
        self.model, self.shifts, self._fine_base = model, list(shifts), fine_base
        self._recent = recent
        self._worlds: dict[object, Any] = {}
        self._lock = RLock()

    @property
    def base(self) -> World:
        """World at the point."""
        return self._get_or_build("base", self.model.build_world)

    @property
    def shifted(self) -> list[World]:
        """Worlds at the shifted points, on the fine mesh along coordinates that need it."""

        def build(shift: tuple[int, float], fine: bool) -> World:
            return shift_model(self._fine_model if fine else self.model, *shift).build_world()

        pairs = enumerate(zip(self.shifts, self.shifted_on_fine_mesh, strict=True))
        return [self._get_or_build(k, partial(build, *pair)) for k, pair in pairs]

    @property
    def fine(self) -> World:
        """World at the point on the fine mesh."""
        return self._get_or_build("fine", lambda: self._fine_model.build_world())

    def simulate(self, e: Episode, dt: float | None, fine: bool = False) -> Frames:
        """Simulate an episode at the point, without errors of an observer; nobody may write to the frames.

        Args:
            e: the episode.
            dt: largest substep [s]; None: the stable one.
            fine: use the fine mesh.
        """
        model, world = self._fine_model if fine else self.model, self._at_point(fine)
        if self._recent is None:
            return world.simulate(e, dt)
        point = (model.base, model.parameters, model.accepted, tuple(model.point.tolist()))
        return self._recent.get_or_compute((point, e, dt), partial(world.simulate, e, dt))

    def observe(self, e: Episode, dt: float | None, fine: bool = False) -> Frames:
        """Simulate what an observer sees of an episode at the point; the arguments are those of ``simulate``."""
        return self._at_point(fine).observe(self.simulate(e, dt, fine), e)

    def with_typical(self, hypothesis: Hypothesis, fine: bool = False) -> World | None:
        """Return the world with a hypothesis at its typical amplitude; None if there is no such world."""
        h = hypothesis
        return self._get_or_build(
            (h.name, h.typical, fine), lambda: none_if_impossible(lambda: h.apply_to(self._at_point(fine), h.typical))
        )

    def _at_point(self, fine: bool) -> World:
        return self.fine if fine else self.base

    def uses_fine_mesh(self, hypothesis: Hypothesis) -> bool:
        """Tell whether the hypothesis has its slopes on the fine mesh, and there is one."""
        return hypothesis.needs_fine_mesh and self._fine_base is not None

    @property
    def shifted_on_fine_mesh(self) -> list[bool]:
        """Whether each shifted point is simulated on the fine mesh."""
        fine = [*(False for _ in self.model.parameters), *map(self.uses_fine_mesh, self.model.accepted)]
        return [fine[coordinate] for coordinate, _ in self.shifts]

    @property
    def _fine_model(self) -> WorldModel:
        if self._fine_base is None:
            raise ValueError("no fine mesh")
        return replace(self.model, base=self._fine_base)

    def _get_or_build(self, key: object, build: Callable[[], T]) -> T:
        with self._lock:
            if key not in self._worlds:
                self._worlds[key] = build()
            return self._worlds[key]


def none_if_impossible(compute: Callable[[], T]) -> T | None:
    """Return the result of ``compute``, or None if no such world exists or it cannot be simulated."""
    try:
        return compute()
    except IMPOSSIBLE_WORLD_ERRORS:
        return None
