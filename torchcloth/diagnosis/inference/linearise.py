"""What episodes say at a point: mean residuals and how every parameter, hypothesis and nuisance would move them."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from ...episodes.steps import both_ways
from ...episodes.world import Hypothesis, Model, Parameter
from ...episodes.world_cache import Worlds
from ..data.binning import BinnedResiduals, EpisodeEvidence, align_rows, average_groups, time_blocks
from ..data.dataset import Progress, DiagnosisData
from .episode_simulation import simulate_hypotheses, iterate_parallel, simulate_episode

FINE_MESH_ERROR_FRACTION = 1 / 3  # of the difference between two meshes is left on the finer one (second order)


@dataclass(frozen=True, eq=False)
class Linearisation:
    """Of every episode: cells, and the columns of their derivatives.

    Attributes:
        cells: one entry per episode; columns are the model's own point first, then ``hypotheses``, then nuisances.
        own: number of the model's columns.
        hypotheses: those that were asked about and could be simulated everywhere.
        stds: per episode, of its nuisances [N_e].
        numerics: per episode [C]: how far the residual on the coarser mesh is from the one on the finer.
    """

    bins: list[BinnedResiduals]
    n_coordinates: int
    hypotheses: list[Hypothesis]
    nuisance_stds: list[Tensor]
    mesh_differences: list[Tensor]


def linearise(
    model: Model,
    setting: DiagnosisData,
    hypotheses: Sequence[Hypothesis] = (),
    progress: Progress = lambda _: None,
    before: Linearisation | None = None,
    shifts: Sequence[tuple[int, float]] | None = None,
) -> Linearisation:
    """Simulate every episode at the model's point, beside it, and with each hypothesis at its typical amplitude.

    The nuisances' slopes, which hardly depend on the point, are taken from ``before`` where that has the cell.
    Hypotheses that cannot be simulated in one of the episodes are left out. ``shifts`` are (coordinate, step) of the
    points beside, with a column each; None: central differences along each coordinate. What these miss, a second
    difference, makes cells ``rough``: another engine's cloth is a few per cent off in effect, and where ripples turn
    over within that, nothing says how.
    """
    raw, shifts = shifts is not None, both_ways(model) if shifts is None else list(shifts)
    own = len(shifts)
    worlds = Worlds(model, shifts, setting.fine_mesh and setting.fine_mesh.base, setting.recent_frames)

    def ask(k: int, asked: list[Hypothesis]) -> EpisodeEvidence:
        slopes = None if before is None else _known_slopes(before, k)
        question = [k, [h.name for h in model.accepted], _told(asked), shifts, *(slopes or ())]
        return setting.cache(question, model.point, partial(simulate_episode, worlds, setting, k, asked, slopes))

    asked = _of_their_own(model, hypotheses)
    pieces, possible = _pieces(setting, _with_opposites(asked), progress, ask)
    cells, stds, numerics = [], [], []
    for k, (piece, simulated) in enumerate(pieces):
        use = [*range(own), *(own + i for i, h in enumerate(simulated) if h in possible)]
        use += range(own + len(simulated), piece.bins.jacobian.shape[1])
        stable = ~torch.isin(piece.bins.key, setting.bifurcating_bins[k]) if setting.bifurcating_bins else slice(None)
        found = piece.bins.select(stable)
        found = found._replace(jacobian=found.jacobian[:, use])
        cells.append(found if raw else central_differences(found, shifts, len(model.parameters)))
        numerics.append(piece.mesh_difference[stable])
        stds.append(piece.nuisance_stds)
    found = Linearisation(cells, own if raw else len(model.point), possible, stds, numerics)
    return _with_twins(_odd(found, asked), model, hypotheses)


def linearise_hypotheses(
    here: Linearisation,
    model: Model,
    setting: DiagnosisData,
    hypotheses: Sequence[Hypothesis],
    progress: Progress = lambda _: None,
) -> Linearisation:
    """``here``, the evidence at the model's point, with slopes along these hypotheses; only they are simulated."""
    worlds = Worlds(model, (), setting.fine_mesh and setting.fine_mesh.base, setting.recent_frames)

    def ask(k: int, asked: list[Hypothesis]) -> EpisodeEvidence:
        question = [k, "asked", [h.name for h in model.accepted], _told(asked)]
        return setting.cache(question, model.point, partial(simulate_hypotheses, worlds, setting, k, asked))

    asked = _of_their_own(model, hypotheses)
    pieces, possible = _pieces(setting, _with_opposites(asked), progress, ask)
    cells = []
    for own, std, (piece, simulated) in zip(here.bins, here.nuisance_stds, pieces, strict=True):
        use = [i for i, h in enumerate(simulated) if h in possible]
        slopes = align_rows(own.key, piece.bins.key, piece.bins.jacobian[:, use])
        parts = [own.jacobian[:, : here.n_coordinates], slopes, own.jacobian[:, own.jacobian.shape[1] - len(std) :]]
        cells.append(own._replace(jacobian=torch.cat(parts, 1)))
    return _with_twins(_odd(replace(here, cells=cells, hypotheses=possible), asked), model, hypotheses)


def _of_their_own(model: Model, hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Those that no parameter of the model does already."""
    fitted = {p.name for p in model.parameters}
    return [h for h in hypotheses if h.equivalent_parameter not in fitted]


def _with_opposites(hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Asked about both ways where a cause brings another one along, which is the same either way."""
    both = [h for h in hypotheses if h.implies and h.opposite.typical == -h.typical]
    return [*hypotheses, *(h.opposite for h in both if h.opposite not in hypotheses)]


def _odd(evidence: Linearisation, asked: Sequence[Hypothesis]) -> Linearisation:
    """Slopes of these alone, less what is the same both ways: drag, in those along wind, would brake one way only."""
    every, own = evidence.hypotheses, evidence.n_coordinates
    kept = [k for k, h in enumerate(every) if h in asked]
    pairs = [[k, *(j for j, h in enumerate(every) if every[k].implies and h == every[k].opposite)] for k in kept]
    cells = []
    for c in evidence.bins:
        slopes, rest = c.jacobian[:, own : own + len(every)], c.jacobian[:, own + len(every) :]
        columns = [slopes[:, pair].mean(1, keepdim=True) for pair in pairs]
        cells.append(c._replace(jacobian=torch.cat([c.jacobian[:, :own], *columns, rest], 1)))
    return replace(evidence, cells=cells, hypotheses=[every[k] for k in kept])


def _with_twins(evidence: Linearisation, model: Model, hypotheses: Sequence[Hypothesis]) -> Linearisation:
    """The others have their parameter's slopes: simulated beside it, ripples would seem to tell one from the other."""
    names, cells, after = [p.name for p in model.parameters], [], evidence.n_coordinates + len(evidence.hypotheses)
    rest = [h for h in hypotheses if h.equivalent_parameter in names]
    places = [names.index(h.equivalent_parameter) for h in rest]
    shares = torch.tensor([_by_twin(model.parameters[k], float(model.values[k])) for k in places])
    for own in evidence.bins:
        first, last = own.jacobian[:, :after], own.jacobian[:, after:]
        cells.append(own._replace(jacobian=torch.cat([first, first[:, places] * shares.to(first), last], 1)))
    return replace(evidence, cells=cells, hypotheses=[*evidence.hypotheses, *rest])


def _by_twin(parameter: Parameter, coordinate: float) -> float:
    """Derivative of the coordinate by its twin's amplitude."""
    up, down = (parameter.more(coordinate + sign * parameter.step, coordinate) for sign in (1.0, -1.0))
    return 2 * parameter.step / (up - down)


def _pieces(
    setting: DiagnosisData,
    hypotheses: Sequence[Hypothesis],
    progress: Progress,
    ask: Callable[[int, list[Hypothesis]], EpisodeEvidence],
) -> tuple[list[tuple[EpisodeEvidence, list[Hypothesis]]], list[Hypothesis]]:
    """([(answer of an episode, hypotheses that could be simulated there)], those that could in all).

    Episodes overlap: while cells of one are computed, others are simulated.
    """
    asked, out, began, count = list(hypotheses), [], time.monotonic(), len(setting.episodes)
    with closing(iterate_parallel(lambda k: ask(k, asked), range(count))) as pieces:
        for k, e in enumerate(setting.episodes):
            progress(f"{e.name}, {k + 1} of {count}{_left(began, k, count)}")
            piece = next(pieces)
            out.append((piece, [h for h, able in zip(asked, piece.is_simulated.tolist(), strict=True) if able]))
    return out, [h for h in asked if all(h in able for _, able in out)]


def _told(hypotheses: Sequence[Hypothesis]) -> list[tuple[str, float]]:
    return [(h.name, h.typical) for h in hypotheses]


def _left(began: float, done: int, total: int) -> str:
    """What a person wants to know of a stage that has ``done`` of ``total`` parts behind it."""
    return f", {(time.monotonic() - began) / done * (total - done):.0f} s left" if done else ""


def _known_slopes(before: Linearisation, k: int) -> tuple[Tensor, Tensor, Tensor]:
    """(keys [C], slopes [C, N] along the nuisances, their standard deviations [N])."""
    std = before.nuisance_stds[k]
    return before.bins[k].key, before.bins[k].jacobian[:, -len(std) :], std


def use_nuisance_slopes(evidence: Linearisation, like: Linearisation) -> Linearisation:
    """With another's slopes along nuisances: what episodes may differ by is the same for all models.

    Cells that the other has not keep their own.
    """
    cells = []
    for k, own in enumerate(evidence.bins):
        key, slopes, _ = _known_slopes(like, k)
        count = own.jacobian.shape[1] - len(evidence.nuisance_stds[k])
        theirs = align_rows(own.key, key, slopes)
        if len(like.nuisance_stds[k]) == len(evidence.nuisance_stds[k]):
            theirs = torch.where(torch.isin(own.key, key)[:, None], theirs, own.jacobian[:, count:])
        cells.append(own._replace(jacobian=torch.cat([own.jacobian[:, :count], theirs], 1)))
    return replace(evidence, cells=cells, stds=like.nuisance_stds)


def restrict_to_common_bins(like: Linearisation, others: Sequence[Linearisation]) -> Linearisation:
    """The same on the cells that all the others have, too."""
    cells, numerics = [], []
    for k, (own, difference) in enumerate(zip(like.bins, like.mesh_differences, strict=True)):
        kept = torch.ones_like(own.key, dtype=torch.bool)
        for other in others:
            kept &= torch.isin(own.key, other.bins[k].key)
        cells.append(own.select(kept))
        numerics.append(difference[kept])
    return replace(like, cells=cells, numerics=numerics)


def use_noise_inputs(evidence: Linearisation, like: Linearisation) -> Linearisation:
    """With all of another's that makes the noise, on its cells: by the same covariance alone densities compare."""
    cells, numerics = [], []
    for own, other, difference in zip(restrict_to_common_bins(evidence, [like]).bins, like.bins, like.mesh_differences, strict=True):
        columns = torch.stack([other.count, other.row_std, other.roughness, other.depth_slope, other.time, difference], 1)
        columns = torch.cat([columns, other.rest_position], 1)
        count, spread, rough, ray, time, difference, *place = align_rows(own.key, other.key, columns).unbind(1)
        same = own._replace(count=count, spread=spread, rough=rough, ray=ray, time=time, place=torch.stack(place, 1))
        cells.append(same)
        numerics.append(difference)
    return replace(evidence, cells=cells, numerics=numerics)


def central_differences(cells: BinnedResiduals, shifts: Sequence[tuple[int, float]], parameters: int) -> BinnedResiduals:
    """One column for each coordinate, from those for each shift; ``parameters`` come first and tell of roughness.

    Of ripples that are strangers at -h, 0 and h, a central slope has a third of the mean square of the difference of
    both sides' slopes from their mean. Slopes are shrunk by what this is of theirs in each stretch: noise in them would
    pass for knowledge.
    """
    columns, square, stretch = [], torch.zeros_like(cells.value), time_blocks([cells])
    for k in range(1 + max((coordinate for coordinate, _ in shifts), default=-1)):
        sides = [j for j, (coordinate, _) in enumerate(shifts) if coordinate == k]
        slope = cells.jacobian[:, sides].mean(1)
        if k < parameters and len(sides) == 2:
            miss = 0.5 * (cells.jacobian[:, sides[0]] - cells.jacobian[:, sides[1]])
            square = square + (shifts[sides[0]][1] * miss).square()
            noise, power = average_groups(stretch, miss**2 / 3), average_groups(stretch, slope**2)
            slope = slope * (1 - noise / power.clamp(min=1e-30)).clamp(min=0.0)
        columns.append(slope)
    jacobian = torch.cat([*(c[:, None] for c in columns), cells.jacobian[:, len(shifts) :]], 1)
    return cells._replace(jacobian=jacobian, rough=square.sqrt())
