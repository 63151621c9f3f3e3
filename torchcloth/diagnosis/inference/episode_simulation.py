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
from ..data.binning import BinnedResiduals, EpisodeEvidence, align_rows, bin_residuals, finite_differences, concatenate_directions
from ..data.dataset import DiagnosisData

CLOCK, SHIFT, TURN, GRASP, RIM, TARE = 3e-3, 5e-4, 1e-3, 1.5e-3, 2e-3, 0.1  # standard deviations between episodes
T = TypeVar("T")
U = TypeVar("U")


def simulate_episode(
    worlds: Worlds,
    setting: DiagnosisData,
    k: int,
    hypotheses: Sequence[Hypothesis],
    known: Sequence[Tensor] | None,
) -> EpisodeEvidence:
    """What the k-th episode says; ``known`` slopes along its nuisances are not taken anew."""
    e, world = setting.episodes[k], worlds.plain
    finer: DiagnosisData = setting.fine_mesh  # type: ignore[assignment]
    steps = [taken(worlds.model, coordinate, step) for coordinate, step in worlds.shifts]
    found = run_episode(worlds, e, setting.dt, hypotheses, known is None, (finer.episodes[k], finer.dt), with_fine=True)
    base, able = found.plain, [t is not None for t in found.with_hypotheses]
    sides = [*zip(found.shifted, steps, worlds.finer_beside, strict=True), *_trials(hypotheses, found)]
    moved, fine = _slopes(base, sides, False), _slopes(found.fine, sides, True)
    if known is None:
        other, std = differentiate_nuisances(world, base, found.grasp_shifted, e)
        coarse = bin_residuals(base, other if moved is None else concatenate_directions(moved, other), e, setting.sheet, setting.rest_positions)
    else:
        key, slopes, std = known
        coarse = bin_residuals(base, moved, e, setting.sheet, setting.rest_positions)
        others, new = align_rows(coarse.key, key, slopes), ~torch.isin(coarse.key, key)
        if bool(new.any()):  # seen there for the first time; how grasps move it would take simulations
            anew = bin_residuals(base, differentiate_nuisances(world, base, [], e)[0], e, setting.sheet, setting.rest_positions)
            others[new, : anew.jacobian.shape[1]] = align_rows(coarse.key, anew.key, anew.jacobian)[new]
        coarse = coarse._replace(jacobian=torch.cat([coarse.jacobian, others], 1))
    finer_cells = bin_residuals(found.fine, fine, finer.episodes[k], finer.sheet, finer.rest_positions)  # type: ignore[arg-type]
    kept, difference = _replaced(_woven(coarse, finer_cells, sides), finer_cells)
    return EpisodeEvidence(kept, std, difference, torch.tensor(able, dtype=torch.bool))


def simulate_hypotheses(worlds: Worlds, setting: DiagnosisData, k: int, hypotheses: Sequence[Hypothesis]) -> EpisodeEvidence:
    """Slopes of the k-th episode along hypotheses alone; ``worlds`` without shifts."""
    e, finer = setting.episodes[k], setting.fine_mesh
    found = run_episode(worlds, e, setting.dt, hypotheses, False, finer and (finer.episodes[k], finer.dt))
    base, able = found.plain, [t is not None for t in found.with_hypotheses]
    sides = list(_trials(hypotheses, found))
    cells = bin_residuals(base, _slopes(base, sides, False), e, setting.sheet, setting.rest_positions)
    if finer is not None and found.fine is not None:
        fine = _slopes(found.fine, sides, True)
        cells = _woven(cells, bin_residuals(found.fine, fine, finer.episodes[k], finer.sheet, finer.rest_positions), sides)
    none = torch.zeros(0, dtype=torch.float64)
    return EpisodeEvidence(cells, none, none, torch.tensor(able, dtype=torch.bool))


Side = tuple[Frames, float, bool]  # beside the point, by which step, and whether on the finer mesh


def _trials(hypotheses: Sequence[Hypothesis], found: EpisodeRuns) -> Iterator[Side]:
    """Of what could be simulated."""
    for k, (h, frames) in enumerate(zip(hypotheses, found.with_hypotheses, strict=True)):
        if frames is not None:
            yield frames, h.typical, k in found.fine_hypotheses


def _slopes(base: Frames | None, sides: Sequence[Side], finer: bool) -> Frames | None:
    """Along those on one mesh; None: there are none."""
    own = [(frames, step) for frames, step, fine in sides if fine == finer]
    return finite_differences(base, *zip(*own, strict=True)) if own and base else None


def _woven(coarse: BinnedResiduals, fine: BinnedResiduals, sides: Sequence[Side]) -> BinnedResiduals:
    """The coarse cells, first with a column for each side, from its own mesh."""
    first = [k for k, (*_, finer) in enumerate(sides) if not finer]
    last = [k for k, (*_, finer) in enumerate(sides) if finer]
    own, rest = coarse.jacobian[:, : len(first)], coarse.jacobian[:, len(first) :]
    columns = torch.cat([own, align_rows(coarse.key, fine.key, fine.jacobian)], 1)
    order = torch.argsort(torch.tensor([*first, *last], dtype=torch.int64))
    return coarse._replace(jacobian=torch.cat([columns[:, order], rest], 1))


class EpisodeRuns(NamedTuple):
    """All simulations of one episode."""

    fine: Frames | None  # on the finer mesh; None where nobody asked
    plain: Frames  # at the point
    shifted: list[Frames]  # along the model's own coordinates, each on the mesh of its slopes
    grasp_shifted: list[Frames]  # with the held places off
    with_hypotheses: list[Frames | None]  # with each hypothesis; None: cannot be simulated
    fine_hypotheses: set[int]  # which of these are on the finer mesh


def run_episode(
    worlds: Worlds,
    e: Episode,
    dt: float | None,
    hypotheses: Sequence[Hypothesis],
    with_grasp_shifts: bool,
    finer: tuple[Episode, float | None] | None = None,
    with_fine: bool = False,
) -> EpisodeRuns:
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
    modes = Held().modes(world.cloth, e) if with_grasp_shifts else ()
    held = [partial(world.frames, replace(e, initial=e.initial + GRASP * m), dt) for m in modes]
    changed = [worlds.changed(h) for h in hypotheses]
    moves = [c is not None and _moves(c, world) for c in changed]
    first = [partial(worlds.seen, *finer, finer=True)] if with_fine and finer else []  # it takes longest
    jobs = [*first, partial(worlds.happens, e, dt), *beside, *held]
    tried = [
        partial(if_possible, partial(c.frames, *own)) for c, other in zip(changed, moves, strict=True) if c and other
    ]
    done: list[Any] = map_parallel(lambda job: job(), [*jobs, *tried])
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
    return EpisodeRuns(fine, plain, sure[: len(beside)], sure[len(beside) :], trials, set(folds))


def _refined(
    worlds: Worlds, hypotheses: Sequence[Hypothesis], finer: tuple[Episode, float | None], fine: Frames | None
) -> tuple[Frames, list[Frames | None]]:
    """On the finer mesh: (the episode, if it is not there yet, the episode with each hypothesis)."""
    first = [] if fine else [partial(worlds.seen, *finer, finer=True)]
    changed = [worlds.changed(h, finer=True) for h in hypotheses]
    tried = [partial(if_possible, partial(c.frames, *finer)) if c else lambda: None for c in changed]
    done: list[Any] = map_parallel(lambda job: job(), [*first, *tried])
    return fine or done[0], done[len(first) :]


def _moves(changed: World, world: World) -> bool:
    """More than how it is looked at has changed."""
    return changed.cloth is not world.cloth or changed.motions is not world.motions


def map_parallel(work: Callable[[T], U], items: Sequence[T]) -> list[U]:
    """Results in order, on all cores: simulations are independent, and the engine leaves Python alone meanwhile."""
    return list(iterate_parallel(work, items))


def iterate_parallel(work: Callable[[T], U], items: Sequence[T]) -> Generator[U, None, None]:
    """The same, one after the other as they are asked for."""
    # of torch's threads, a new thread has as many as there are cores
    pool = ThreadPoolExecutor(os.cpu_count(), initializer=torch.set_num_threads, initargs=(torch.get_num_threads(),))
    try:
        yield from pool.map(work, items)
    finally:
        pool.shutdown(cancel_futures=True)  # when interrupted, what has begun ends and nothing else begins


def _replaced(coarse: BinnedResiduals, fine: BinnedResiduals) -> tuple[BinnedResiduals, Tensor]:
    """(cells that both have, with the slopes of the first and the values of the second; first minus second)."""
    both = torch.isin(coarse.key, fine.key)
    kept = coarse.select(both)
    order = torch.argsort(fine.key)
    place = order[torch.searchsorted(fine.key[order], kept.key)]
    return kept._replace(value=fine.value[place], spread=fine.row_std[place]), kept.value - fine.value[place]


def differentiate_nuisances(world: World, base: Frames, held: Sequence[Frames], e: Episode) -> tuple[Frames, Tensor]:
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
    return finite_differences(base, [*moved, *held], [*steps, *every]), torch.tensor([*stds, *every], dtype=torch.float64)
