"""Residuals of all episodes at a point of the model, with slopes along coordinates, hypotheses and nuisances."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from ...episodes.steps import central_steps
from ...episodes.world import BaseParameter, Hypothesis, WorldModel
from ...episodes.world_cache import WorldCache
from ..data.binning import BinnedResiduals, EpisodeEvidence, align_rows, average_groups, time_blocks
from ..data.dataset import DiagnosisData, Progress
from .episode_simulation import iterate_parallel, simulate_episode, simulate_hypotheses

FINE_MESH_ERROR_FRACTION = 1 / 3  # error of the fine mesh over the difference of two meshes, for second order


@dataclass(frozen=True, eq=False)
class Linearisation:
    """Residuals and slopes of all episodes.

    Attributes:
        bins: one entry for each episode. Columns of the Jacobian: the model's coordinates, ``hypotheses``, nuisances.
        n_coordinates: number of columns of the model's coordinates.
        hypotheses: hypotheses with a column, which could be simulated in every episode.
        nuisance_stds: per episode [N_e], standard deviations of its nuisances.
        mesh_differences: per episode [B], residual on the coarse mesh minus residual on the fine mesh.
    """

    bins: list[BinnedResiduals]
    n_coordinates: int
    hypotheses: list[Hypothesis]
    nuisance_stds: list[Tensor]
    mesh_differences: list[Tensor]


def linearise(
    model: WorldModel,
    data: DiagnosisData,
    hypotheses: Sequence[Hypothesis] = (),
    progress: Progress = lambda _: None,
    before: Linearisation | None = None,
    shifts: Sequence[tuple[int, float]] | None = None,
) -> Linearisation:
    """Simulate every episode at the model's point, at shifted points and with each hypothesis.

    Hypotheses have their typical amplitudes.
    The second difference along the model's coordinates is the roughness of a bin. Another simulator's cloth differs by
    a few per cent in effect, and where ripples turn over within that range, slopes do not say how.

    Args:
        model: at its point.
        data: the episodes.
        hypotheses: along which slopes are computed; those that cannot be simulated in an episode are left out.
        progress: called with one line for each episode.
        before: source of the slopes along nuisances, which hardly depend on the point.
        shifts: (coordinate, step) of the shifted points, with a column each; None: central differences along each
            coordinate.
    """
    has_column_per_shift = shifts is not None
    shifts = central_steps(model) if shifts is None else list(shifts)
    n_shifts = len(shifts)
    worlds = WorldCache(model, shifts, data.fine_mesh and data.fine_mesh.base, data.recent_frames)

    def simulate(k: int, requested: list[Hypothesis]) -> EpisodeEvidence:
        nuisances = None if before is None else _nuisance_slopes(before, k)
        cache_key = [k, [h.name for h in model.accepted], _identify(requested), shifts, *(nuisances or ())]
        return data.cache(cache_key, model.point, partial(simulate_episode, worlds, data, k, requested, nuisances))

    requested = _drop_equivalents(model, hypotheses)
    results, possible = _simulate_all(data, _add_opposites(requested), progress, simulate)
    bins, nuisance_stds, mesh_differences = [], [], []
    for k, (evidence, simulated) in enumerate(results):
        columns = [*range(n_shifts), *(n_shifts + i for i, h in enumerate(simulated) if h in possible)]
        columns += range(n_shifts + len(simulated), evidence.bins.jacobian.shape[1])
        smooth = ~torch.isin(evidence.bins.key, data.bifurcating_bins[k]) if data.bifurcating_bins else slice(None)
        selected = evidence.bins.select(smooth)
        selected = selected._replace(jacobian=selected.jacobian[:, columns])
        bins.append(selected if has_column_per_shift else central_differences(selected, shifts, len(model.parameters)))
        mesh_differences.append(evidence.mesh_difference[smooth])
        nuisance_stds.append(evidence.nuisance_stds)
    n_coordinates = n_shifts if has_column_per_shift else len(model.point)
    result = Linearisation(bins, n_coordinates, possible, nuisance_stds, mesh_differences)
    return _append_equivalents(_average_opposite_slopes(result, requested), model, hypotheses)


def linearise_hypotheses(
    here: Linearisation,
    model: WorldModel,
    data: DiagnosisData,
    hypotheses: Sequence[Hypothesis],
    progress: Progress = lambda _: None,
) -> Linearisation:
    """Replace the hypotheses of a linearisation at the model's point; only the new ones are simulated.

    Args:
        here: linearisation at the model's point.
        model: at its point.
        data: the episodes.
        hypotheses: along which slopes are computed.
        progress: called with one line for each episode.
    """
    worlds = WorldCache(model, (), data.fine_mesh and data.fine_mesh.base, data.recent_frames)

    def simulate(k: int, requested: list[Hypothesis]) -> EpisodeEvidence:
        cache_key = [k, "asked", [h.name for h in model.accepted], _identify(requested)]
        return data.cache(cache_key, model.point, partial(simulate_hypotheses, worlds, data, k, requested))

    requested = _drop_equivalents(model, hypotheses)
    results, possible = _simulate_all(data, _add_opposites(requested), progress, simulate)
    bins = []
    for b, stds, (evidence, simulated) in zip(here.bins, here.nuisance_stds, results, strict=True):
        columns = [i for i, h in enumerate(simulated) if h in possible]
        slopes = align_rows(b.key, evidence.bins.key, evidence.bins.jacobian[:, columns])
        parts = [b.jacobian[:, : here.n_coordinates], slopes, b.jacobian[:, b.jacobian.shape[1] - len(stds) :]]
        bins.append(b._replace(jacobian=torch.cat(parts, 1)))
    result = _average_opposite_slopes(replace(here, bins=bins, hypotheses=possible), requested)
    return _append_equivalents(result, model, hypotheses)


def _drop_equivalents(model: WorldModel, hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Return the hypotheses that equal no parameter of the model."""
    parameters = {p.name for p in model.parameters}
    return [h for h in hypotheses if h.equivalent_parameter not in parameters]


def _add_opposites(hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Add the opposite of a hypothesis that implies another one: the implied one is the same both ways."""
    both = [h for h in hypotheses if h.implies and h.opposite.typical == -h.typical]
    return [*hypotheses, *(h.opposite for h in both if h.opposite not in hypotheses)]


def _average_opposite_slopes(result: Linearisation, requested: Sequence[Hypothesis]) -> Linearisation:
    """Average the slopes of both ways: drag, which wind implies, would otherwise brake one way only."""
    hypotheses, n = result.hypotheses, result.n_coordinates
    indices = [k for k, h in enumerate(hypotheses) if h in requested]
    pairs = [
        [k, *(j for j, h in enumerate(hypotheses) if hypotheses[k].implies and h == hypotheses[k].opposite)]
        for k in indices
    ]
    bins = []
    for b in result.bins:
        slopes, others = b.jacobian[:, n : n + len(hypotheses)], b.jacobian[:, n + len(hypotheses) :]
        columns = [slopes[:, pair].mean(1, keepdim=True) for pair in pairs]
        bins.append(b._replace(jacobian=torch.cat([b.jacobian[:, :n], *columns, others], 1)))
    return replace(result, bins=bins, hypotheses=[hypotheses[k] for k in indices])


def _append_equivalents(result: Linearisation, model: WorldModel, hypotheses: Sequence[Hypothesis]) -> Linearisation:
    """Append hypotheses that equal a parameter, with the parameter's slopes.

    Simulated separately, ripples would seem to distinguish the two.
    """
    names, bins, n_columns = [p.name for p in model.parameters], [], result.n_coordinates + len(result.hypotheses)
    equivalents = [h for h in hypotheses if h.equivalent_parameter in names]
    places = [names.index(h.equivalent_parameter) for h in equivalents]
    factors = torch.tensor(
        [_coordinate_per_amplitude(model.parameters[k], float(model.coordinates[k])) for k in places]
    )
    for b in result.bins:
        first, last = b.jacobian[:, :n_columns], b.jacobian[:, n_columns:]
        bins.append(b._replace(jacobian=torch.cat([first, first[:, places] * factors.to(first), last], 1)))
    return replace(result, bins=bins, hypotheses=[*result.hypotheses, *equivalents])


def _coordinate_per_amplitude(parameter: BaseParameter, coordinate: float) -> float:
    up, down = (parameter.relative_change(coordinate + sign * parameter.step, coordinate) for sign in (1.0, -1.0))
    return 2 * parameter.step / (up - down)


def _simulate_all(
    data: DiagnosisData,
    hypotheses: Sequence[Hypothesis],
    progress: Progress,
    simulate: Callable[[int, list[Hypothesis]], EpisodeEvidence],
) -> tuple[list[tuple[EpisodeEvidence, list[Hypothesis]]], list[Hypothesis]]:
    """Return ([(result of an episode, hypotheses that could be simulated there)], those that could everywhere).

    Episodes overlap: while bins of one are computed, others are simulated.
    """
    requested, results, start, count = list(hypotheses), [], time.monotonic(), len(data.episodes)
    with closing(iterate_parallel(lambda k: simulate(k, requested), range(count))) as episodes:
        for k, e in enumerate(data.episodes):
            remaining = f", {(time.monotonic() - start) / k * (count - k):.0f} s left" if k else ""
            progress(f"{e.name}, {k + 1} of {count}{remaining}")
            evidence = next(episodes)
            is_simulated = evidence.is_simulated.tolist()
            results.append((evidence, [h for h, is_able in zip(requested, is_simulated, strict=True) if is_able]))
    return results, [h for h in requested if all(h in simulated for _, simulated in results)]


def _identify(hypotheses: Sequence[Hypothesis]) -> list[tuple[str, float]]:
    return [(h.name, h.typical) for h in hypotheses]


def _nuisance_slopes(source: Linearisation, k: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return (keys [B], slopes [B, N] along the nuisances, their standard deviations [N])."""
    stds = source.nuisance_stds[k]
    return source.bins[k].key, source.bins[k].jacobian[:, -len(stds) :], stds


def use_nuisance_slopes(target: Linearisation, source: Linearisation) -> Linearisation:
    """Replace the slopes along nuisances by those of another linearisation, so that all models have the same.

    Bins that ``source`` does not have keep their slopes.
    """
    bins = []
    for k, b in enumerate(target.bins):
        key, slopes, _ = _nuisance_slopes(source, k)
        count = b.jacobian.shape[1] - len(target.nuisance_stds[k])
        columns = align_rows(b.key, key, slopes)
        if len(source.nuisance_stds[k]) == len(target.nuisance_stds[k]):
            columns = torch.where(torch.isin(b.key, key)[:, None], columns, b.jacobian[:, count:])
        bins.append(b._replace(jacobian=torch.cat([b.jacobian[:, :count], columns], 1)))
    return replace(target, bins=bins, nuisance_stds=source.nuisance_stds)


def restrict_to_common_bins(target: Linearisation, others: Sequence[Linearisation]) -> Linearisation:
    """Return ``target`` on the bins that all others have as well."""
    bins, mesh_differences = [], []
    for k, (b, difference) in enumerate(zip(target.bins, target.mesh_differences, strict=True)):
        is_common = torch.ones_like(b.key, dtype=torch.bool)
        for other in others:
            is_common &= torch.isin(b.key, other.bins[k].key)
        bins.append(b.select(is_common))
        mesh_differences.append(difference[is_common])
    return replace(target, bins=bins, mesh_differences=mesh_differences)


def use_noise_inputs(target: Linearisation, source: Linearisation) -> Linearisation:
    """Replace everything that enters the noise by another linearisation's values, on its bins.

    Log densities of two models can be compared only with the same covariance.
    """
    bins, mesh_differences = [], []
    common = restrict_to_common_bins(target, [source]).bins
    for b, other, difference in zip(common, source.bins, source.mesh_differences, strict=True):
        columns = torch.stack(
            [other.count, other.row_std, other.roughness, other.depth_slope, other.time, difference], 1
        )
        columns = torch.cat([columns, other.rest_position], 1)
        count, row_std, roughness, depth_slope, bin_time, difference, *position = align_rows(
            b.key, other.key, columns
        ).unbind(1)
        bins.append(
            b._replace(
                count=count,
                row_std=row_std,
                roughness=roughness,
                depth_slope=depth_slope,
                time=bin_time,
                rest_position=torch.stack(position, 1),
            )
        )
        mesh_differences.append(difference)
    return replace(target, bins=bins, mesh_differences=mesh_differences)


def central_differences(
    bins: BinnedResiduals, shifts: Sequence[tuple[int, float]], n_parameters: int
) -> BinnedResiduals:
    """Combine the columns of the shifts into one for each coordinate, and set the roughness.

    Ripples that are independent at -h, 0 and h give a central slope whose mean square is a third of the mean square
    of half the difference of the two one-sided slopes. Slopes are shrunk by that share in each time block, because
    noise in them would pass as knowledge.

    Args:
        bins: first columns of the Jacobian: one for each shift.
        shifts: (coordinate, step) of each shift.
        n_parameters: number of parameters, which come first. Only they enter the roughness.
    """
    columns, square, block = [], torch.zeros_like(bins.value), time_blocks([bins])
    for k in range(1 + max((coordinate for coordinate, _ in shifts), default=-1)):
        sides = [j for j, (coordinate, _) in enumerate(shifts) if coordinate == k]
        slope = bins.jacobian[:, sides].mean(1)
        if k < n_parameters and len(sides) == 2:
            asymmetry = 0.5 * (bins.jacobian[:, sides[0]] - bins.jacobian[:, sides[1]])
            square = square + (shifts[sides[0]][1] * asymmetry).square()
            noise, power = average_groups(block, asymmetry**2 / 3), average_groups(block, slope**2)
            slope = slope * (1 - noise / power.clamp(min=1e-30)).clamp(min=0.0)
        columns.append(slope)
    jacobian = torch.cat([*(c[:, None] for c in columns), bins.jacobian[:, len(shifts) :]], 1)
    return bins._replace(jacobian=jacobian, roughness=square.sqrt())
