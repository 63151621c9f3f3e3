"""What one episode says at a point: all simulations of it, side by side, and the cells that they make."""

from __future__ import annotations

import os
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor

from ..identification.episodes import Episode
from ..identification.nuisances import Camera, Clock, Held, Rim, Tare
from ..identification.replays import Frames
from .cells import Cells, Piece, aligned, cells_of, directions
from .setting import Setting
from .steps import taken
from .world import Hypothesis, World
from .worlds import Worlds, if_possible

CLOCK, SHIFT, TURN, GRASP, RIM, TARE = 3e-3, 5e-4, 1e-3, 1.5e-3, 2e-3, 0.1  # standard deviations between episodes
T = TypeVar("T")
U = TypeVar("U")


def piece_of(
    worlds: Worlds,
    setting: Setting,
    k: int,
    hypotheses: Sequence[Hypothesis],
    known: Sequence[Tensor] | None,
) -> Piece:
    """What the k-th episode says; ``known`` slopes along its nuisances are not taken anew."""
    e, world = setting.episodes[k], worlds.plain
    finer: Setting = setting.finer  # type: ignore[assignment]
    steps = [taken(worlds.model, coordinate, step) for coordinate, step in worlds.shifts]
    fine = partial(worlds.finest.frames, finer.episodes[k], finer.dt)
    found = runs(worlds, e, setting.dt, hypotheses, with_held=known is None, finer=fine)
    able = torch.tensor([t is not None for t in found.trials], dtype=torch.bool)
    typical = [h.typical for h, t in zip(hypotheses, found.trials, strict=True) if t is not None]
    base = world.seen(found.plain, e)
    moved = directions(base, [*found.beside, *(t for t in found.trials if t is not None)], [*steps, *typical])
    if known is None:
        other, std = nuisances(world, base, found.held, e)
        coarse = cells_of(base, joined(moved, other), e, setting.sheet, setting.rest)
    else:
        key, slopes, std = known
        coarse = cells_of(base, moved, e, setting.sheet, setting.rest)
        coarse = coarse._replace(jacobian=torch.cat([coarse.jacobian, aligned(coarse.key, key, slopes)], 1))
    kept, difference = _replaced(coarse, cells_of(found.fine, None, finer.episodes[k], finer.sheet, finer.rest))
    return Piece(kept, std, difference, able)


def asked_piece(worlds: Worlds, setting: Setting, k: int, hypotheses: Sequence[Hypothesis]) -> Piece:
    """Slopes of the k-th episode along hypotheses alone; ``worlds`` without shifts."""
    e = setting.episodes[k]
    found = runs(worlds, e, setting.dt, hypotheses, with_held=False)
    base, moved = worlds.plain.seen(found.plain, e), [t for t in found.trials if t is not None]
    able = torch.tensor([t is not None for t in found.trials], dtype=torch.bool)
    typical = [h.typical for h, t in zip(hypotheses, found.trials, strict=True) if t is not None]
    slopes = directions(base, moved, typical) if moved else None
    none = torch.zeros(0, dtype=torch.float64)
    return Piece(cells_of(base, slopes, e, setting.sheet, setting.rest), none, none, able)


class Runs(NamedTuple):
    """All simulations of one episode."""

    fine: Frames  # on the finer mesh; the plain ones where nobody asked
    plain: Frames  # what happens, whoever looks on
    beside: list[Frames]  # along the model's own coordinates
    held: list[Frames]  # with the held places off
    trials: list[Frames | None]  # with each hypothesis; None: cannot be simulated


def runs(
    worlds: Worlds,
    e: Episode,
    dt: float | None,
    hypotheses: Sequence[Hypothesis],
    with_held: bool,
    finer: Callable[[], Frames] | None = None,
) -> Runs:
    """An episode in a world, in those beside it, with every hypothesis and with held places off, side by side."""
    world = worlds.plain
    beside = [partial(w.frames, e, dt) for w in worlds.beside]
    modes = Held().modes(world.cloth, e) if with_held else ()
    held = [partial(world.frames, replace(e, initial=e.initial + GRASP * m), dt) for m in modes]
    changed = [worlds.changed(h) for h in hypotheses]
    moves = [c is not None and (c.cloth is not world.cloth or c.motions is not world.motions) for c in changed]
    first = [] if finer is None else [finer]  # it takes longest
    jobs = [*first, partial(world.simulated, e, dt), *beside, *held]
    tried = [partial(if_possible, partial(c.frames, e, dt)) for c, own in zip(changed, moves, strict=True) if c and own]
    done: list[Any] = side_by_side(lambda job: job(), [*jobs, *tried])
    plain, *sure = done[len(first) : len(jobs)]
    fine = plain if finer is None else done[0]
    rest = iter(done[len(jobs) :])
    seen = lambda c: c and if_possible(partial(c.seen, plain, e))  # noqa: E731
    trials = [next(rest) if own else seen(c) for c, own in zip(changed, moves, strict=True)]
    return Runs(fine, plain, sure[: len(beside)], sure[len(beside) :], trials)


def side_by_side(work: Callable[[T], U], items: Sequence[T]) -> list[U]:
    """Results in order, on all cores: simulations are independent, and the engine leaves Python alone meanwhile."""
    return list(overlapping(work, items))


def overlapping(work: Callable[[T], U], items: Sequence[T]) -> Generator[U, None, None]:
    """The same, one after the other as they are asked for."""
    # of torch's threads, a new thread has as many as there are cores
    pool = ThreadPoolExecutor(os.cpu_count(), initializer=torch.set_num_threads, initargs=(torch.get_num_threads(),))
    try:
        yield from pool.map(work, items)
    finally:
        pool.shutdown(cancel_futures=True)  # when interrupted, what has begun ends and nothing else begins


def _replaced(coarse: Cells, fine: Cells) -> tuple[Cells, Tensor]:
    """(cells that both have, with the slopes of the first and the values of the second; first minus second)."""
    both = torch.isin(coarse.key, fine.key)
    kept = Cells(*(column[both] for column in coarse))
    order = torch.argsort(fine.key)
    place = order[torch.searchsorted(fine.key[order], kept.key)]
    return kept._replace(value=fine.value[place], spread=fine.spread[place]), kept.value - fine.value[place]


def nuisances(world: World, base: Frames, held: Sequence[Frames], e: Episode) -> tuple[Frames, Tensor]:
    """Derivatives along what differs from episode to episode, and its standard deviations."""
    moved, steps, stds = [], [], []
    for kind, std in ((Clock(), [CLOCK]), (Camera(), [SHIFT] * 3 + [TURN] * 3), (Rim(), [RIM]), (Tare(), None)):
        parts = len(kind.parts(world.cloth, e))
        for k in range(parts):
            own = TARE if std is None else std[k]
            values = torch.zeros(parts, dtype=base.x.dtype)
            values[k] = 0.5 * own
            moved.append(kind.see(base, values, e))
            steps.append(0.5 * own)
            stds.append(own)
    every = [GRASP] * len(held)
    return directions(base, [*moved, *held], [*steps, *every]), torch.tensor([*stds, *every], dtype=torch.float64)


def joined(a: Frames, b: Frames) -> Frames:
    """Directions of both."""
    wrench = {name: torch.cat([a.wrench[name], b.wrench[name]]) for name in a.wrench}
    return Frames(torch.cat([a.x, b.x]), torch.cat([a.v, b.v]), wrench, torch.cat([a.edge, b.edge]))
