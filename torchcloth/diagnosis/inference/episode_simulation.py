"""Simulation of one episode at a point of the model: all runs, in parallel, and the bins that they give."""

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
from ...episodes.steps import clip_step
from ...episodes.world import Hypothesis, World
from ...episodes.world_batches import WorldRun, group_runs, simulate_group
from ...episodes.world_cache import WorldCache, none_if_impossible
from ...identification.nuisances import CameraOffset, ClockOffset, ForceTare, GraspOffset, RimOffset
from ..data.binning import (
    BinnedResiduals,
    EpisodeEvidence,
    align_rows,
    bin_residuals,
    concatenate_directions,
    finite_differences,
)
from ..data.dataset import DiagnosisData

# standard deviations of the nuisances, which differ from episode to episode
CLOCK_STD_S = 3e-3
CAMERA_SHIFT_STD_M = 5e-4
CAMERA_TURN_STD_RAD = 1e-3
GRASP_STD_M = 1.5e-3
RIM_STD_M = 2e-3
TARE_STD = 0.1  # of a force [N] and of a torque [N m]
T = TypeVar("T")
U = TypeVar("U")
ShiftedRun = tuple[Frames, float, bool]
"""Frames at a shifted point, the step that leads there, and whether they are on the fine mesh."""


def simulate_episode(
    worlds: WorldCache,
    data: DiagnosisData,
    k: int,
    hypotheses: Sequence[Hypothesis],
    known_nuisances: Sequence[Tensor] | None,
) -> EpisodeEvidence:
    """Compute residuals and derivatives of the k-th episode.

    Args:
        worlds: the model's worlds at its point and at the shifted points.
        data: the episodes.
        k: index of the episode.
        hypotheses: along which derivatives are computed.
        known_nuisances: (keys [B], slopes [B, N], standard deviations [N]) along the nuisances, which are then not
            simulated again.
    """
    e, world = data.episodes[k], worlds.base
    clock_std = (data.clock_stds[k] if data.clock_stds else None) or CLOCK_STD_S
    fine_data: DiagnosisData = data.fine_mesh  # type: ignore[assignment]
    steps = [clip_step(worlds.model, coordinate, step) for coordinate, step in worlds.shifts]
    fine_episode = (fine_data.episodes[k], fine_data.dt)
    runs = run_episode(worlds, e, data.dt, hypotheses, known_nuisances is None, fine_episode, with_fine=True)
    base, is_simulated = runs.plain, [frames is not None for frames in runs.with_hypotheses]
    shifted = [*zip(runs.shifted, steps, worlds.shifted_on_fine_mesh, strict=True), *_hypothesis_runs(hypotheses, runs)]
    slopes, fine_slopes = _differentiate(base, shifted, False), _differentiate(runs.fine, shifted, True)
    if known_nuisances is None:
        along_nuisances, std = differentiate_nuisances(world, base, runs.grasp_shifted, e, clock_std)
        slopes = along_nuisances if slopes is None else concatenate_directions(slopes, along_nuisances)
        coarse = bin_residuals(base, slopes, e, data.surface, data.rest_positions)
    else:
        key, nuisance_slopes, std = known_nuisances
        coarse = bin_residuals(base, slopes, e, data.surface, data.rest_positions)
        nuisance_columns, is_new = align_rows(coarse.key, key, nuisance_slopes), ~torch.isin(coarse.key, key)
        if bool(is_new.any()):  # bins that appear for the first time; slopes along grasps would need simulations
            along_nuisances, _ = differentiate_nuisances(world, base, [], e, clock_std)
            new = bin_residuals(base, along_nuisances, e, data.surface, data.rest_positions)
            nuisance_columns[is_new, : new.jacobian.shape[1]] = align_rows(coarse.key, new.key, new.jacobian)[is_new]
        coarse = coarse._replace(jacobian=torch.cat([coarse.jacobian, nuisance_columns], 1))
    fine_frames: Frames = runs.fine  # type: ignore[assignment]
    fine = bin_residuals(fine_frames, fine_slopes, fine_episode[0], fine_data.surface, fine_data.rest_positions)
    bins, difference = _take_fine_values(_merge_slopes(coarse, fine, shifted), fine)
    return EpisodeEvidence(bins, std, difference, torch.tensor(is_simulated, dtype=torch.bool))


def simulate_hypotheses(
    worlds: WorldCache, data: DiagnosisData, k: int, hypotheses: Sequence[Hypothesis]
) -> EpisodeEvidence:
    """Compute derivatives of the k-th episode along hypotheses alone; ``worlds`` has no shifts."""
    e, fine_data = data.episodes[k], data.fine_mesh
    runs = run_episode(worlds, e, data.dt, hypotheses, False, fine_data and (fine_data.episodes[k], fine_data.dt))
    base, is_simulated = runs.plain, [frames is not None for frames in runs.with_hypotheses]
    shifted = list(_hypothesis_runs(hypotheses, runs))
    bins = bin_residuals(base, _differentiate(base, shifted, False), e, data.surface, data.rest_positions)
    if fine_data is not None and runs.fine is not None:
        slopes = _differentiate(runs.fine, shifted, True)
        fine = bin_residuals(runs.fine, slopes, fine_data.episodes[k], fine_data.surface, fine_data.rest_positions)
        bins = _merge_slopes(bins, fine, shifted)
    none = torch.zeros(0, dtype=torch.float64)
    return EpisodeEvidence(bins, none, none, torch.tensor(is_simulated, dtype=torch.bool))


def _hypothesis_runs(hypotheses: Sequence[Hypothesis], runs: EpisodeRuns) -> Iterator[ShiftedRun]:
    for k, (h, frames) in enumerate(zip(hypotheses, runs.with_hypotheses, strict=True)):
        if frames is not None:
            yield frames, h.typical, k in runs.fine_hypotheses


def _differentiate(base: Frames | None, shifted: Sequence[ShiftedRun], on_fine: bool) -> Frames | None:
    """Return the derivatives along the runs on one mesh; None without any."""
    runs = [(frames, step) for frames, step, is_fine in shifted if is_fine == on_fine]
    return finite_differences(base, *zip(*runs, strict=True)) if runs and base else None


def _merge_slopes(coarse: BinnedResiduals, fine: BinnedResiduals, shifted: Sequence[ShiftedRun]) -> BinnedResiduals:
    """Return the coarse bins with one column for each shifted run, from its own mesh, before all others."""
    on_coarse = [k for k, (*_, is_fine) in enumerate(shifted) if not is_fine]
    on_fine = [k for k, (*_, is_fine) in enumerate(shifted) if is_fine]
    slopes, others = coarse.jacobian[:, : len(on_coarse)], coarse.jacobian[:, len(on_coarse) :]
    columns = torch.cat([slopes, align_rows(coarse.key, fine.key, fine.jacobian)], 1)
    order = torch.argsort(torch.tensor([*on_coarse, *on_fine], dtype=torch.int64))
    return coarse._replace(jacobian=torch.cat([columns[:, order], others], 1))


class EpisodeRuns(NamedTuple):
    """All simulations of one episode.

    Attributes:
        fine: at the point, on the fine mesh; None if not asked for.
        plain: at the point.
        shifted: along the model's coordinates, each on the mesh of its slopes.
        grasp_shifted: with grasped vertices shifted.
        with_hypotheses: with each hypothesis; None: it cannot be simulated.
        fine_hypotheses: indices of the hypotheses that were simulated on the fine mesh.
    """

    fine: Frames | None
    plain: Frames
    shifted: list[Frames]
    grasp_shifted: list[Frames]
    with_hypotheses: list[Frames | None]
    fine_hypotheses: set[int]


def run_episode(
    worlds: WorldCache,
    e: Episode,
    dt: float | None,
    hypotheses: Sequence[Hypothesis],
    with_grasp_shifts: bool,
    fine_episode: tuple[Episode, float | None] | None = None,
    with_fine: bool = False,
) -> EpisodeRuns:
    """Simulate an episode at the model's point, at shifted points and with each hypothesis, in parallel.

    Args:
        worlds: around the model's point.
        e: the episode.
        dt: its substep [s]; None: the stable one.
        hypotheses: each is simulated at its typical amplitude.
        with_grasp_shifts: whether to simulate shifted grasps as well.
        fine_episode: the same episode and its substep on the fine mesh; None: the worlds have no fine mesh.
        with_fine: whether to simulate the fine mesh in any case, and not only if a slope needs it.
    """
    world = worlds.base
    shifted = [
        WorldRun(w, *(fine_episode if on_fine and fine_episode else (e, dt)))
        for w, on_fine in zip(worlds.shifted, worlds.shifted_on_fine_mesh, strict=True)
    ]
    modes = GraspOffset().initial_shape_modes(world.cloth, e) if with_grasp_shifts else ()
    grasps = [WorldRun(world, replace(e, initial=e.initial + GRASP_STD_M * mode), dt) for mode in modes]
    changed = [worlds.with_typical(h) for h in hypotheses]
    # only what changes more than the observer is simulated again
    needs_run = [
        c is not None and (c.cloth is not world.cloth or c.motion_transforms is not world.motion_transforms)
        for c in changed
    ]
    hypothesis_runs = [
        WorldRun(c, e, dt, may_fail=True) for c, run in zip(changed, needs_run, strict=True) if c and run
    ]
    fine_jobs = [partial(worlds.observe, *fine_episode, fine=True)] if with_fine and fine_episode else []  # the longest
    results, others = _run_parallel(
        [*fine_jobs, partial(worlds.simulate, e, dt)], [*shifted, *grasps, *hypothesis_runs]
    )
    simulated, count = results[-1], len(shifted) + len(grasps)
    required, hypothesis_results = [f for f in others[:count] if f is not None], iter(others[count:])
    with_hypotheses: list[Frames | None] = []
    for c, run in zip(changed, needs_run, strict=True):
        with_hypotheses.append(
            next(hypothesis_results) if run else c and none_if_impossible(partial(c.observe, simulated, e))
        )
    fine, plain = results[0] if fine_jobs else None, world.observe(simulated, e)
    fine_hypotheses = {
        k: h
        for k, (h, frames) in enumerate(zip(hypotheses, with_hypotheses, strict=True))
        if worlds.uses_fine_mesh(h) and frames is not None and not torch.equal(frames.x, plain.x)
    }
    if fine_episode and fine_hypotheses:
        fine, repeated = _run_on_fine_mesh(worlds, list(fine_hypotheses.values()), fine_episode, fine)
        for k, frames in zip(fine_hypotheses, repeated, strict=True):
            with_hypotheses[k] = frames
    n_shifted = len(shifted)
    return EpisodeRuns(fine, plain, required[:n_shifted], required[n_shifted:], with_hypotheses, set(fine_hypotheses))


def _run_on_fine_mesh(
    worlds: WorldCache,
    hypotheses: Sequence[Hypothesis],
    fine_episode: tuple[Episode, float | None],
    fine: Frames | None,
) -> tuple[Frames, list[Frames | None]]:
    """Return the episode on the fine mesh, simulated if ``fine`` is None, and the episode with each hypothesis."""
    jobs = [] if fine else [partial(worlds.observe, *fine_episode, fine=True)]
    changed = [worlds.with_typical(h, fine=True) for h in hypotheses]
    results, frames = _run_parallel(jobs, [WorldRun(c, *fine_episode, may_fail=True) for c in changed if c])
    simulated = iter(frames)
    return fine or results[0], [next(simulated) if c else None for c in changed]


def _run_parallel(jobs: Sequence[Callable[[], Any]], runs: Sequence[WorldRun]) -> tuple[list[Any], list[Frames | None]]:
    """Return the results of jobs, and the frames of runs; runs that differ in numbers only share a batch."""
    groups, frames = group_runs(runs), dict[int, Frames | None]()
    batches = [partial(simulate_group, [runs[k] for k in group]) for group in groups]
    results: list[Any] = map_parallel(lambda job: job(), [*jobs, *batches])
    for group, simulated in zip(groups, results[len(jobs) :], strict=True):
        frames |= zip(group, simulated, strict=True)
    return results[: len(jobs)], [frames[k] for k in range(len(runs))]


def map_parallel(work: Callable[[T], U], items: Sequence[T]) -> list[U]:
    """Apply a function to items on all cores, and return the results in order.

    Threads suffice: simulations are independent, and the engine releases Python's lock.
    """
    return list(iterate_parallel(work, items))


def iterate_parallel(work: Callable[[T], U], items: Sequence[T]) -> Generator[U, None, None]:
    """Yield the results of ``map_parallel`` one after the other."""
    # torch gives a new thread as many threads of its own as there are cores, so their number is set
    pool = ThreadPoolExecutor(os.cpu_count(), initializer=torch.set_num_threads, initargs=(torch.get_num_threads(),))
    try:
        yield from pool.map(work, items)
    finally:
        pool.shutdown(cancel_futures=True)  # when interrupted, running jobs end and no other begins


def _take_fine_values(coarse: BinnedResiduals, fine: BinnedResiduals) -> tuple[BinnedResiduals, Tensor]:
    """Return (common bins with the slopes of the coarse and the values of the fine mesh, coarse minus fine value)."""
    bins = coarse.select(torch.isin(coarse.key, fine.key))
    order = torch.argsort(fine.key)
    index = order[torch.searchsorted(fine.key[order], bins.key)]
    return bins._replace(value=fine.value[index], row_std=fine.row_std[index]), bins.value - fine.value[index]


def differentiate_nuisances(
    world: World, base: Frames, grasp_shifted: Sequence[Frames], e: Episode, clock_std: float = CLOCK_STD_S
) -> tuple[Frames, Tensor]:
    """Return the derivatives along the nuisances of an episode, and their standard deviations [N].

    Args:
        world: the model's world.
        base: the episode at the model's point.
        grasp_shifted: the episode with shifted grasps.
        e: the episode.
        clock_std: prior standard deviation of its clock [s].
    """
    camera_stds = [CAMERA_SHIFT_STD_M] * 3 + [CAMERA_TURN_STD_RAD] * 3
    shifted, steps, stds = [], [], []
    for nuisance, known_stds in (
        (ClockOffset(), [clock_std]), (CameraOffset(), camera_stds), (RimOffset(), [RIM_STD_M]), (ForceTare(), None)
    ):  # fmt: skip
        parts = len(nuisance.number_names(world.cloth, e))
        for k in range(parts):
            std = TARE_STD if known_stds is None else known_stds[k]
            values = torch.zeros(parts, dtype=base.x.dtype)
            values[k] = 0.5 * std
            shifted.append(nuisance.observe(base, values, e))
            steps.append(0.5 * std)
            stds.append(std)
    grasp_stds = [GRASP_STD_M] * len(grasp_shifted)
    derivatives = finite_differences(base, [*shifted, *grasp_shifted], [*steps, *grasp_stds])
    return derivatives, torch.tensor([*stds, *grasp_stds], dtype=torch.float64)
