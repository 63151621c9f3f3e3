"""What episodes say at a point: mean residuals and how every parameter, hypothesis and nuisance would move them."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor

from ..errors import InvalidInput, SimulationDiverged, UnstableStep
from ..identification.episodes import Episode, episode
from ..identification.nuisances import Camera, Clock, Held, Rim, Tare
from ..identification.replays import Frames
from ..identification.replicates import keys_of
from ..identification.sheet import Sheet, sheet_for
from ..recordings import Recording
from .cells import Cells, cells_of, directions, mean_over, stretches
from .refined import refined
from .world import Hypothesis, Model, World

IMPOSSIBLE = (InvalidInput, SimulationDiverged, UnstableStep)  # no world has such values, or none that is stable
CLOCK, SHIFT, TURN, GRASP, RIM, TARE = 3e-3, 5e-4, 1e-3, 1.5e-3, 2e-3, 0.1  # standard deviations between episodes
Progress = Callable[[str], None]
Kept = Callable[[Sequence[object], Tensor, Callable[[], "Piece"]], "Piece"]  # (question, point, work) -> answer
T = TypeVar("T")
U = TypeVar("U")


def simply(question: Sequence[object], point: Tensor, work: Callable[[], Piece]) -> Piece:
    """Keeps nothing."""
    return work()


def motions_of(recordings: Sequence[Recording]) -> list[str]:
    """What each episode says its motion is, or that of the one it repeats; one that does not say is one of its own."""
    originals = {r.split.get("replicate_of") for r in recordings} - {None}
    out = []
    for k, (r, key) in enumerate(zip(recordings, keys_of(recordings), strict=True)):
        original = r.path is not None and r.path.name in originals
        says = original or r.split.get("motion") or r.split.get("replicate_of")
        out.append(str(key) if says else f"episode {k}")
    return out


@dataclass(frozen=True, eq=False)
class Setting:
    """Episodes as tensors, and the surface that their points are compared with."""

    base: World
    recordings: tuple[Recording, ...]
    episodes: tuple[Episode, ...]
    sheet: Sheet
    rest: Tensor  # [V, 3] m, the pattern
    dt: float | None = None
    finer: Setting | None = None
    unstable: tuple[Tensor, ...] = ()  # per episode, keys of cells that jump; empty: not looked for
    kept: Kept = simply  # where finished episodes are kept

    @property
    def names(self) -> list[str]:
        """Of the motions."""
        return motions_of(self.recordings)


def setting_of(model: Model, recordings: Sequence[Recording]) -> Setting:
    """Checks the recordings against the model, and prepares the same on a mesh twice as fine."""
    return replace(_setting(model, recordings), finer=_setting(*refined(model, recordings)))


def _setting(model: Model, recordings: Sequence[Recording]) -> Setting:
    cloth = model.base.cloth
    episodes = tuple(episode(cloth, r) for r in recordings)
    mesh = cloth.mesh
    pattern = torch.as_tensor(mesh.vertices).double()
    if mesh.uv is not None:
        pattern = torch.nn.functional.pad(torch.as_tensor(mesh.uv).double(), (0, 1))
    else:  # its first two axes pass for u and v, so the thinnest comes last
        thin = int((pattern.amax(0) - pattern.amin(0)).argmin())
        pattern = pattern[:, [*(k for k in range(3) if k != thin), thin]]
    return Setting(model.base, tuple(recordings), episodes, sheet_for(cloth, episodes), pattern)


@dataclass(frozen=True, eq=False)
class Evidence:
    """Of every episode: cells, and the columns of their derivatives.

    Attributes:
        cells: one entry per episode; columns are the model's own point first, then ``hypotheses``, then nuisances.
        own: number of the model's columns.
        hypotheses: those that were asked about and could be simulated everywhere.
        stds: per episode, of its nuisances [N_e].
        numerics: per episode [C]: how far the residual on the coarser mesh is from the one on the finer.
    """

    cells: list[Cells]
    own: int
    hypotheses: list[Hypothesis]
    stds: list[Tensor]
    numerics: list[Tensor]


def gather(
    model: Model,
    setting: Setting,
    hypotheses: Sequence[Hypothesis] = (),
    progress: Progress = lambda _: None,
    before: Evidence | None = None,
    shifts: Sequence[tuple[int, float]] | None = None,
) -> Evidence:
    """Simulate every episode at the model's point, beside it, and with each hypothesis at its typical amplitude.

    The nuisances' slopes, which hardly depend on the point, are taken from ``before`` where that is given. Hypotheses
    that cannot be simulated in one of the episodes are left out. ``shifts`` are (coordinate, step) of the points
    beside, with a column each; None: central differences along each coordinate. What these miss, a second difference,
    makes cells ``rough``: another engine's cloth is a few per cent off in effect, and where ripples turn over within
    that, nothing says how.
    """
    raw, shifts = shifts is not None, both_ways(model) if shifts is None else list(shifts)
    own, possible, pieces, began = len(shifts), list(hypotheses), [], time.monotonic()
    for k, e in enumerate(setting.episodes):
        progress(f"{e.name}, {k + 1} of {len(setting.episodes)}{_left(began, k, len(setting.episodes))}")
        slopes = None if before is None else _known_slopes(before, k)
        asked = [(h.name, h.typical) for h in possible]
        question = [k, [h.name for h in model.accepted], asked, shifts, *(slopes or ())]
        work = partial(_piece, model, setting, k, possible, slopes, shifts)
        piece = setting.kept(question, model.point, work)
        pieces.append((piece, possible))
        possible = [h for h, able in zip(possible, piece.able.tolist(), strict=True) if able]
    cells, stds, numerics = [], [], []
    for k, (piece, asked) in enumerate(pieces):
        simulated = [h for h, able in zip(asked, piece.able.tolist(), strict=True) if able]
        use = [*range(own), *(own + i for i, h in enumerate(simulated) if h in possible)]
        use += range(own + len(simulated), piece.cells.jacobian.shape[1])
        stable = ~torch.isin(piece.cells.key, setting.unstable[k]) if setting.unstable else slice(None)
        found = Cells(*(column[stable] for column in piece.cells))
        found = found._replace(jacobian=found.jacobian[:, use])
        cells.append(found if raw else _central(found, shifts, len(model.parameters)))
        numerics.append(piece.numerics[stable])
        stds.append(piece.std)
    return Evidence(cells, own if raw else len(model.point), possible, stds, numerics)


def asked_about(
    here: Evidence,
    model: Model,
    setting: Setting,
    hypotheses: Sequence[Hypothesis],
    progress: Progress = lambda _: None,
) -> Evidence:
    """``here``, the evidence at the model's point, with slopes along these hypotheses; only they are simulated."""
    possible, pieces, began = list(hypotheses), [], time.monotonic()
    for k, e in enumerate(setting.episodes):
        progress(f"{e.name}, {k + 1} of {len(setting.episodes)}{_left(began, k, len(setting.episodes))}")
        question = [k, "asked", [h.name for h in model.accepted], [(h.name, h.typical) for h in possible]]
        piece = setting.kept(question, model.point, partial(_asked_piece, model, setting, k, possible))
        pieces.append((piece, possible))
        possible = [h for h, able in zip(possible, piece.able.tolist(), strict=True) if able]
    cells = []
    for own, std, (piece, asked) in zip(here.cells, here.stds, pieces, strict=True):
        simulated = [h for h, able in zip(asked, piece.able.tolist(), strict=True) if able]
        use = [i for i, h in enumerate(simulated) if h in possible]
        slopes = aligned(own.key, piece.cells.key, piece.cells.jacobian[:, use])
        parts = [own.jacobian[:, : here.own], slopes, own.jacobian[:, own.jacobian.shape[1] - len(std) :]]
        cells.append(own._replace(jacobian=torch.cat(parts, 1)))
    return replace(here, cells=cells, hypotheses=possible)


def staged(progress: Progress, stage: str) -> Progress:
    """The same, with what all lines are about in front."""
    return lambda text: progress(f"{stage}: {text}")


def _left(began: float, done: int, total: int) -> str:
    """What a person wants to know of a stage that has ``done`` of ``total`` parts behind it."""
    return f", {(time.monotonic() - began) / done * (total - done):.0f} s left" if done else ""


class Piece(NamedTuple):
    """What one episode says."""

    cells: Cells  # columns: the model's own, the hypotheses that could be simulated, nuisances
    std: Tensor  # of the nuisances
    numerics: Tensor  # [C]
    able: Tensor  # [hypotheses] bool, could be simulated


def _known_slopes(before: Evidence, k: int) -> tuple[Tensor, Tensor, Tensor]:
    """(keys [C], slopes [C, N] along the nuisances, their standard deviations [N])."""
    std = before.stds[k]
    return before.cells[k].key, before.cells[k].jacobian[:, -len(std) :], std


def _piece(
    model: Model,
    setting: Setting,
    k: int,
    hypotheses: Sequence[Hypothesis],
    known: Sequence[Tensor] | None,
    shifts: Sequence[tuple[int, float]],
) -> Piece:
    """What the k-th episode says; ``known`` slopes along its nuisances are not taken anew."""
    e, world = setting.episodes[k], model.world()
    steps = [_taken(model, coordinate, step) for coordinate, step in shifts]
    beside = [shifted(model, coordinate, step).world() for coordinate, step in shifts]
    runs = _runs(model, world, setting, k, hypotheses, beside, with_held=known is None)
    able = torch.tensor([t is not None for t in runs.trials], dtype=torch.bool)
    typical = [h.typical for h, t in zip(hypotheses, runs.trials, strict=True) if t is not None]
    base = world.seen(runs.plain, e)
    moved = directions(base, [*runs.beside, *(t for t in runs.trials if t is not None)], [*steps, *typical])
    if known is None:
        other, std = nuisances(world, base, runs.held, e)
        coarse = cells_of(base, joined(moved, other), e, setting.sheet, setting.rest)
    else:
        key, slopes, std = known
        coarse = cells_of(base, moved, e, setting.sheet, setting.rest)
        coarse = coarse._replace(jacobian=torch.cat([coarse.jacobian, aligned(coarse.key, key, slopes)], 1))
    finer: Setting = setting.finer  # type: ignore[assignment]
    kept, difference = _replaced(coarse, cells_of(runs.fine, None, finer.episodes[k], finer.sheet, finer.rest))
    return Piece(kept, std, difference, able)


def _asked_piece(model: Model, setting: Setting, k: int, hypotheses: Sequence[Hypothesis]) -> Piece:
    """Slopes of the k-th episode along hypotheses alone."""
    e, world = setting.episodes[k], model.world()
    runs = _runs(model, world, setting, k, hypotheses, (), with_held=False, finer=False)
    base, moved = world.seen(runs.plain, e), [t for t in runs.trials if t is not None]
    able = torch.tensor([t is not None for t in runs.trials], dtype=torch.bool)
    typical = [h.typical for h, t in zip(hypotheses, runs.trials, strict=True) if t is not None]
    slopes = directions(base, moved, typical) if moved else None
    none = torch.zeros(0, dtype=torch.float64)
    return Piece(cells_of(base, slopes, e, setting.sheet, setting.rest), none, none, able)


class _Runs(NamedTuple):
    """All simulations of one episode."""

    fine: Frames  # on the finer mesh; the plain ones where nobody asked
    plain: Frames  # what happens, whoever looks on
    beside: list[Frames]  # along the model's own coordinates
    held: list[Frames]  # with the held places off
    trials: list[Frames | None]  # with each hypothesis; None: cannot be simulated


def _runs(
    model: Model,
    world: World,
    setting: Setting,
    k: int,
    hypotheses: Sequence[Hypothesis],
    near: Sequence[World],
    with_held: bool,
    finer: bool = True,
) -> _Runs:
    e, dt = setting.episodes[k], setting.dt
    beside = [partial(w.frames, e, dt) for w in near]
    modes = Held().modes(world.cloth, e) if with_held else ()
    held = [partial(world.frames, replace(e, initial=e.initial + GRASP * m, settles=True), dt) for m in modes]
    changed = [_if_possible(partial(h.apply, world, h.typical)) for h in hypotheses]
    moves = [c is not None and (c.cloth is not world.cloth or c.motions is not world.motions) for c in changed]
    first = [partial(_finest, model, setting, k)] if finer else []  # it takes longest
    jobs = [*first, partial(world.simulated, e, dt), *beside, *held]
    tried = [
        partial(_if_possible, partial(c.frames, e, dt)) for c, own in zip(changed, moves, strict=True) if c and own
    ]
    done: list[Any] = side_by_side(lambda job: job(), [*jobs, *tried])
    plain, *sure = done[len(first) : len(jobs)]
    fine = done[0] if finer else plain
    rest = iter(done[len(jobs) :])
    seen = lambda c: c and _if_possible(partial(c.seen, plain, e))  # noqa: E731
    trials = [next(rest) if own else seen(c) for c, own in zip(changed, moves, strict=True)]
    return _Runs(fine, plain, sure[: len(beside)], sure[len(beside) :], trials)


def _finest(model: Model, setting: Setting, k: int) -> Frames:
    """The episode on the finer mesh."""
    if setting.finer is None:
        raise ValueError("a setting without a finer one")
    return replace(model, base=setting.finer.base).world().frames(setting.finer.episodes[k], setting.finer.dt)


def _if_possible(work: Callable[[], T]) -> T | None:
    try:
        return work()
    except IMPOSSIBLE:
        return None


def side_by_side(work: Callable[[T], U], items: Sequence[T]) -> list[U]:
    """Results in order, on all cores: simulations are independent, and the engine leaves Python alone meanwhile."""
    pool = ThreadPoolExecutor(os.cpu_count())
    try:
        return list(pool.map(work, items))
    finally:
        pool.shutdown(cancel_futures=True)  # when interrupted, what has begun ends and nothing else begins


def aligned(key: Tensor, other: Tensor, columns: Tensor) -> Tensor:
    """Rows of ``columns`` [O, ...] of the cells ``other`` in the order of the cells ``key`` [C]; zero where missing."""
    order = torch.argsort(other)
    place = order[torch.searchsorted(other[order], key).clamp(max=len(other) - 1)]
    found = columns[place].clone()
    found[other[place] != key] = 0.0
    return found


def as_held(evidence: Evidence, like: Evidence) -> Evidence:
    """With another's slopes along nuisances: what episodes may differ by is the same for all models."""
    cells = []
    for k, own in enumerate(evidence.cells):
        key, slopes, _ = _known_slopes(like, k)
        kept = own.jacobian[:, : own.jacobian.shape[1] - len(evidence.stds[k])]
        cells.append(own._replace(jacobian=torch.cat([kept, aligned(own.key, key, slopes)], 1)))
    return replace(evidence, cells=cells, stds=like.stds)


def as_rough(evidence: Evidence, like: Evidence) -> Evidence:
    """With another's roughness: densities of models are compared by the same covariance only."""
    cells = [
        own._replace(rough=aligned(own.key, other.key, other.rough))
        for own, other in zip(evidence.cells, like.cells, strict=True)
    ]
    return replace(evidence, cells=cells)


def _replaced(coarse: Cells, fine: Cells) -> tuple[Cells, Tensor]:
    """(cells that both have, with the slopes of the first and the values of the second; first minus second)."""
    both = torch.isin(coarse.key, fine.key)
    kept = Cells(*(column[both] for column in coarse))
    order = torch.argsort(fine.key)
    place = order[torch.searchsorted(fine.key[order], kept.key)]
    return kept._replace(value=fine.value[place], spread=fine.spread[place]), kept.value - fine.value[place]


def step_sizes(model: Model) -> list[tuple[int, float]]:
    """(coordinate, small step) along each of the model's own."""
    return list(enumerate([*(p.step for p in model.parameters), *(h.step * h.typical for h in model.accepted)]))


def both_ways(model: Model) -> list[tuple[int, float]]:
    """(coordinate, step) there and back along each of the model's own, but for what lies beyond its ends."""
    low, high = (end.tolist() for end in model.ends)
    here = model.point.tolist()
    every = [(k, sign * step) for k, step in step_sizes(model) for sign in (1.0, -1.0)]
    return [(k, step) for k, step in every if low[k] <= here[k] + step <= high[k]]


def one_way(model: Model) -> list[tuple[int, float]]:
    """(coordinate, step) along each of the model's own, back where there lies beyond an end."""
    ways: dict[int, float] = {}
    for k, step in [*both_ways(model), *step_sizes(model)]:
        ways.setdefault(k, step)
    return sorted(ways.items())


def _central(cells: Cells, shifts: Sequence[tuple[int, float]], parameters: int) -> Cells:
    """One column for each coordinate, from those for each shift; ``parameters`` come first and tell of roughness.

    Of ripples that are strangers at -h, 0 and h, a central slope has a third of the mean square of the difference of
    both sides' slopes from their mean. Slopes are shrunk by what this is of theirs in each stretch: noise in them would
    pass for knowledge.
    """
    columns, square, stretch = [], torch.zeros_like(cells.value), stretches([cells])
    for k in range(1 + max((coordinate for coordinate, _ in shifts), default=-1)):
        sides = [j for j, (coordinate, _) in enumerate(shifts) if coordinate == k]
        slope = cells.jacobian[:, sides].mean(1)
        if k < parameters and len(sides) == 2:
            miss = 0.5 * (cells.jacobian[:, sides[0]] - cells.jacobian[:, sides[1]])
            square = square + (shifts[sides[0]][1] * miss).square()
            noise, power = mean_over(stretch, miss**2 / 3), mean_over(stretch, slope**2)
            slope = slope * (1 - noise / power.clamp(min=1e-30)).clamp(min=0.0)
        columns.append(slope)
    jacobian = torch.cat([*(c[:, None] for c in columns), cells.jacobian[:, len(shifts) :]], 1)
    return cells._replace(jacobian=jacobian, rough=square.sqrt())


def shifted(model: Model, coordinate: int, step: float) -> Model:
    """Beside the model's point."""
    beside = model.point
    beside[coordinate] += step
    return model.at(beside)


def _taken(model: Model, coordinate: int, step: float) -> float:
    """The step as far as the coordinate's ends allow; one of no length tells nothing, whatever it is divided by."""
    low, high = (float(end[coordinate]) for end in model.ends)
    here = float(model.point[coordinate])
    there = min(max(here + step, low), high)
    return step if there == here + step else there - here or step


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
