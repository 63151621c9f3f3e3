"""What one episode says at a point: all simulations of it, side by side, and the cells that they make."""

from __future__ import annotations

import os
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor

from ...episodes.observed import Episode
from ...episodes.replay import Frames
from ...episodes.steps import taken
from ...episodes.world import Hypothesis, World
from ...episodes.world_cache import Worlds, if_possible
from ...identification.nuisances import Camera, Clock, Held, Rim, Tare
from ..data.binning import Cells, Piece, aligned, cells_of, directions, joined
from ..data.dataset import Setting

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
    found = runs(worlds, e, setting.dt, hypotheses, known is None, (finer.episodes[k], finer.dt), with_fine=True)
    base, able = found.plain, [t is not None for t in found.trials]
    sides = [*zip(found.beside, steps, worlds.finer_beside, strict=True), *_trials(hypotheses, found)]
    moved, fine = _slopes(base, sides, False), _slopes(found.fine, sides, True)
    if known is None:
        other, std = nuisances(world, base, found.held, e)
        coarse = cells_of(base, other if moved is None else joined(moved, other), e, setting.sheet, setting.rest)
    else:
        key, slopes, std = known
        coarse = cells_of(base, moved, e, setting.sheet, setting.rest)
        others, new = aligned(coarse.key, key, slopes), ~torch.isin(coarse.key, key)
        if bool(new.any()):  # seen there for the first time; how grasps move it would take simulations
            anew = cells_of(base, nuisances(world, base, [], e)[0], e, setting.sheet, setting.rest)
            others[new, : anew.jacobian.shape[1]] = aligned(coarse.key, anew.key, anew.jacobian)[new]
        coarse = coarse._replace(jacobian=torch.cat([coarse.jacobian, others], 1))
    finer_cells = cells_of(found.fine, fine, finer.episodes[k], finer.sheet, finer.rest)  # type: ignore[arg-type]
    kept, difference = _replaced(_woven(coarse, finer_cells, sides), finer_cells)
    return Piece(kept, std, difference, torch.tensor(able, dtype=torch.bool))


def asked_piece(worlds: Worlds, setting: Setting, k: int, hypotheses: Sequence[Hypothesis]) -> Piece:
    """Slopes of the k-th episode along hypotheses alone; ``worlds`` without shifts."""
    e, finer = setting.episodes[k], setting.finer
    found = runs(worlds, e, setting.dt, hypotheses, False, finer and (finer.episodes[k], finer.dt))
    base, able = found.plain, [t is not None for t in found.trials]
    sides = list(_trials(hypotheses, found))
    cells = cells_of(base, _slopes(base, sides, False), e, setting.sheet, setting.rest)
    if finer is not None and found.fine is not None:
        fine = _slopes(found.fine, sides, True)
        cells = _woven(cells, cells_of(found.fine, fine, finer.episodes[k], finer.sheet, finer.rest), sides)
    none = torch.zeros(0, dtype=torch.float64)
    return Piece(cells, none, none, torch.tensor(able, dtype=torch.bool))


Side = tuple[Frames, float, bool]  # beside the point, by which step, and whether on the finer mesh


def _trials(hypotheses: Sequence[Hypothesis], found: Runs) -> Iterator[Side]:
    """Of what could be simulated."""
    for k, (h, frames) in enumerate(zip(hypotheses, found.trials, strict=True)):
        if frames is not None:
            yield frames, h.typical, k in found.refined


def _slopes(base: Frames | None, sides: Sequence[Side], finer: bool) -> Frames | None:
    """Along those on one mesh; None: there are none."""
    own = [(frames, step) for frames, step, fine in sides if fine == finer]
    return directions(base, *zip(*own, strict=True)) if own and base else None


def _woven(coarse: Cells, fine: Cells, sides: Sequence[Side]) -> Cells:
    """The coarse cells, first with a column for each side, from its own mesh."""
    first = [k for k, (*_, finer) in enumerate(sides) if not finer]
    last = [k for k, (*_, finer) in enumerate(sides) if finer]
    own, rest = coarse.jacobian[:, : len(first)], coarse.jacobian[:, len(first) :]
    columns = torch.cat([own, aligned(coarse.key, fine.key, fine.jacobian)], 1)
    order = torch.argsort(torch.tensor([*first, *last], dtype=torch.int64))
    return coarse._replace(jacobian=torch.cat([columns[:, order], rest], 1))


class Runs(NamedTuple):
    """All simulations of one episode."""

    fine: Frames | None  # on the finer mesh; None where nobody asked
    plain: Frames  # at the point
    beside: list[Frames]  # along the model's own coordinates, each on the mesh of its slopes
    held: list[Frames]  # with the held places off
    trials: list[Frames | None]  # with each hypothesis; None: cannot be simulated
    refined: set[int]  # which of these are on the finer mesh


def runs(
    worlds: Worlds,
    e: Episode,
    dt: float | None,
    hypotheses: Sequence[Hypothesis],
    with_held: bool,
    finer: tuple[Episode, float | None] | None = None,
    with_fine: bool = False,
) -> Runs:
    """An episode in a world, in those beside it, with every hypothesis and with held places off, side by side.

    Args:
        worlds: about the model's point.
        e: the episode.
        dt: its substep [s]; None: the stable one.
        hypotheses: with each of which it is simulated.
        with_held: with held places off, too.
        finer: the same episode and substep on the finer mesh; None: the worlds have none.
        with_fine: on the finer mesh in any case, and not only if something has its slopes there.
    """
    world, own = worlds.plain, (e, dt)
    on = lambda fine: finer if fine and finer else own  # noqa: E731
    beside = [partial(w.frames, *on(fine)) for w, fine in zip(worlds.beside, worlds.finer_beside, strict=True)]
    modes = Held().modes(world.cloth, e) if with_held else ()
    held = [partial(world.frames, replace(e, initial=e.initial + GRASP * m), dt) for m in modes]
    changed = [worlds.changed(h) for h in hypotheses]
    moves = [c is not None and _moves(c, world) for c in changed]
    first = [partial(worlds.seen, *finer, finer=True)] if with_fine and finer else []  # it takes longest
    jobs = [*first, partial(worlds.happens, e, dt), *beside, *held]
    tried = [
        partial(if_possible, partial(c.frames, *own)) for c, other in zip(changed, moves, strict=True) if c and other
    ]
    done: list[Any] = side_by_side(lambda job: job(), [*jobs, *tried])
    happens, *sure = done[len(first) : len(jobs)]
    rest = iter(done[len(jobs) :])
    seen = lambda c: c and if_possible(partial(c.seen, happens, e))  # noqa: E731
    trials = [next(rest) if other else seen(c) for c, other in zip(changed, moves, strict=True)]
    fine, plain = done[0] if first else None, world.seen(happens, e)
    folds = {
        k: h
        for k, (h, t) in enumerate(zip(hypotheses, trials, strict=True))
        if worlds.is_finer(h) and t is not None and not torch.equal(t.x, plain.x)
    }
    if finer and folds:
        fine, again = _refined(worlds, list(folds.values()), finer, fine)
        for k, frames in zip(folds, again, strict=True):
            trials[k] = frames
    return Runs(fine, plain, sure[: len(beside)], sure[len(beside) :], trials, set(folds))


def _refined(
    worlds: Worlds, hypotheses: Sequence[Hypothesis], finer: tuple[Episode, float | None], fine: Frames | None
) -> tuple[Frames, list[Frames | None]]:
    """On the finer mesh: (the episode, if it is not there yet, the episode with each hypothesis)."""
    first = [] if fine else [partial(worlds.seen, *finer, finer=True)]
    changed = [worlds.changed(h, finer=True) for h in hypotheses]
    tried = [partial(if_possible, partial(c.frames, *finer)) if c else lambda: None for c in changed]
    done: list[Any] = side_by_side(lambda job: job(), [*first, *tried])
    return fine or done[0], done[len(first) :]


def _moves(changed: World, world: World) -> bool:
    """More than how it is looked at has changed."""
    return changed.cloth is not world.cloth or changed.motions is not world.motions


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
    kept = coarse.rows(both)
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
