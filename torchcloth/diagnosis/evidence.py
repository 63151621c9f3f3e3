"""What episodes say at a point: mean residuals and how every parameter, hypothesis and nuisance would move them."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TypeVar

import torch
from torch import Tensor

from ..errors import SimulationDiverged, UnstableStep
from ..identification.episodes import Episode, episode
from ..identification.nuisances import Camera, Clock, Held, Rim, Tare
from ..identification.replays import Frames
from ..identification.sheet import Sheet, sheet_for
from ..recordings import Recording
from .cells import Cells, cells_of, directions
from .refined import refined
from .world import Hypothesis, Model, World

CLOCK, SHIFT, TURN, GRASP, RIM, TARE = 3e-3, 5e-4, 1e-3, 1.5e-3, 2e-3, 0.1  # standard deviations between episodes
Progress = Callable[[str], None]
T = TypeVar("T")
U = TypeVar("U")


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

    @property
    def names(self) -> list[str]:
        """Of the motions."""
        return [str(r.split.get("motion") or e.name) for r, e in zip(self.recordings, self.episodes, strict=True)]


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

    The nuisances' slopes, which hardly depend on the point, are taken from ``before`` where that is given. ``shifts``
    are (coordinate, step) of the points beside; None: a small step along each coordinate.
    """
    shifts = _steps(model) if shifts is None else shifts
    asked, trials = _simulable(model, setting, hypotheses, progress)
    cells, stds, numerics = [], [], []
    for k, (e, fine) in enumerate(zip(setting.episodes, finer_residuals(model, setting), strict=True)):
        progress(f"{e.name}: slopes")
        base, own = _own(model, e, setting.dt, shifts)
        moved = directions(base, [*own, *trials[k]], [*(s for _, s in shifts), *(h.typical for h in asked)])
        if before is None:
            other, std = _nuisances(model, base, e, setting.dt)
            moved = _joined(moved, other)
        coarse = cells_of(base, moved, e, setting.sheet, setting.rest)
        if before is not None:
            std = before.stds[k]
            slopes = aligned(coarse.key, before.cells[k].key, before.cells[k].jacobian[:, -len(std) :])
            coarse = coarse._replace(jacobian=torch.cat([coarse.jacobian, slopes], 1))
        kept, difference = _replaced(coarse, fine)
        cells.append(kept)
        numerics.append(difference)
        stds.append(std)
    return Evidence(cells, len(shifts), asked, stds, numerics)


def _simulable(
    model: Model, setting: Setting, hypotheses: Sequence[Hypothesis], progress: Progress
) -> tuple[list[Hypothesis], list[list[Frames]]]:
    """(hypotheses that can be simulated in all episodes; per episode, the frames with each of them)."""
    found: list[dict[str, Frames]] = []
    possible = list(hypotheses)
    for e in setting.episodes:
        progress(f"{e.name}: {len(possible)} hypotheses")
        plain, world = model.world().simulated(e, setting.dt), model.world()
        trials = side_by_side(lambda h, e=e, p=plain, w=world: _tried(w, p, h, e, setting.dt), possible)
        found.append({h.name: frames for h, frames in zip(possible, trials, strict=True) if frames is not None})
        possible = [h for h in possible if h.name in found[-1]]
    return possible, [[own[h.name] for h in possible] for own in found]


def _tried(world: World, plain: Frames, h: Hypothesis, e: Episode, dt: float | None) -> Frames | None:
    """With a hypothesis; where it is only looked at otherwise, ``plain`` is what happens."""
    changed = h.apply(world, h.typical)
    if changed.cloth is world.cloth and changed.motions is world.motions:
        return changed.seen(plain, e)
    try:
        return changed.frames(e, dt)
    except (SimulationDiverged, UnstableStep):
        return None


def side_by_side(work: Callable[[T], U], items: Sequence[T]) -> list[U]:
    """Results in order, on all cores: simulations are independent, and the engine leaves Python alone meanwhile."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return list(pool.map(work, items))


def aligned(key: Tensor, other: Tensor, columns: Tensor) -> Tensor:
    """Rows of ``columns`` [O, ...] of the cells ``other`` in the order of the cells ``key`` [C]; zero where missing."""
    order = torch.argsort(other)
    place = order[torch.searchsorted(other[order], key).clamp(max=len(other) - 1)]
    found = columns[place].clone()
    found[other[place] != key] = 0.0
    return found


def finer_residuals(model: Model, setting: Setting) -> list[Cells]:
    """Cells without derivatives, on the finer mesh."""
    if setting.finer is None:
        raise ValueError("a setting without a finer one")
    finer = setting.finer
    world = replace(model, base=finer.base).world()
    seen = side_by_side(lambda e: world.frames(e, finer.dt), finer.episodes)
    return [cells_of(f, None, e, finer.sheet, finer.rest) for f, e in zip(seen, finer.episodes, strict=True)]


def _replaced(coarse: Cells, fine: Cells) -> tuple[Cells, Tensor]:
    """(cells that both have, with the slopes of the first and the values of the second; first minus second)."""
    both = torch.isin(coarse.key, fine.key)
    kept = Cells(*(column[both] for column in coarse))
    order = torch.argsort(fine.key)
    place = order[torch.searchsorted(fine.key[order], kept.key)]
    return kept._replace(value=fine.value[place], spread=fine.spread[place]), kept.value - fine.value[place]


def _steps(model: Model) -> list[tuple[int, float]]:
    own = [*(p.step for p in model.parameters), *(0.1 * h.typical for h in model.accepted)]
    return list(enumerate(own))


def _own(
    model: Model, e: Episode, dt: float | None, shifts: Sequence[tuple[int, float]]
) -> tuple[Frames, list[Frames]]:
    """(at the point, beside it) along the model's own coordinates."""
    worlds = [model.world()]
    for coordinate, step in shifts:
        beside = model.point
        beside[coordinate] += step
        worlds.append(model.at(beside).world())
    base, *shifted = side_by_side(lambda world: world.frames(e, dt), worlds)
    return base, shifted


def _nuisances(model: Model, base: Frames, e: Episode, dt: float | None) -> tuple[Frames, Tensor]:
    """Derivatives along what differs from episode to episode, and its standard deviations."""
    cloth, shifted, steps, stds = model.base.cloth, [], [], []
    world = model.world()
    for kind, std in ((Clock(), [CLOCK]), (Camera(), [SHIFT] * 3 + [TURN] * 3), (Rim(), [RIM]), (Tare(), None)):
        parts = len(kind.parts(cloth, e))
        for k in range(parts):
            own = TARE if std is None else std[k]
            values = torch.zeros(parts, dtype=base.x.dtype)
            values[k] = 0.5 * own
            shifted.append(kind.see(base, values, e))
            steps.append(0.5 * own)
            stds.append(own)
    moved = [replace(e, initial=e.initial + GRASP * mode, settles=True) for mode in Held().modes(cloth, e)]
    shifted += side_by_side(lambda off: world.frames(off, dt), moved)
    steps += [GRASP] * len(moved)
    stds += [GRASP] * len(moved)
    return directions(base, shifted, steps), torch.tensor(stds, dtype=torch.float64)


def _joined(a: Frames, b: Frames) -> Frames:
    wrench = {name: torch.cat([a.wrench[name], b.wrench[name]]) for name in a.wrench}
    return Frames(torch.cat([a.x, b.x]), torch.cat([a.v, b.v]), wrench, torch.cat([a.edge, b.edge]))
