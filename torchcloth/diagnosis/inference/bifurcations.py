"""Bins with a discontinuous response: slack cloth has several shapes, and a small change may turn a fold over.

Where the simulation does not follow its slopes, residuals say which branch was taken and nothing about a cause. Clyde
et al. (2017) find several stable equilibria of real fabrics. The same holds where an error of the initial shape
decides: a sheet that is pulled askew buckles, and a millimetre that nobody has measured decides to which side. Such
bins are left out.

If most bins of an episode respond like that to the initial shape, no fold has turned over: cloth that swings for
seconds has forgotten how it began. There only bins are left out that move by more than the simulation is off anyway.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from ...episodes.observed import Episode
from ...episodes.steps import list_steps
from ...episodes.world import World
from ...episodes.world_cache import none_if_impossible
from ...errors import SimulationDiverged, UnstableStep
from ...meshes.mesh import vertex_normals
from ..data.binning import BLOCK_NAMES, BinnedResiduals, align_rows, average_groups, bin_residuals
from ..data.dataset import DiagnosisData, Progress
from ..decide.criteria import CRITERIA
from .episode_simulation import map_parallel
from .fitting import ModelFit, assemble_fit
from .linearise import Linearisation
from .noise import fit_noise


def find_bifurcating_bins(
    fitted: ModelFit, data: DiagnosisData, progress: Progress = lambda _: None, seed: int = 0
) -> tuple[Tensor, ...]:
    """Find bins that respond discontinuously within the uncertainty of the parameters or of the initial shape.

    Parameters move by one standard error in random directions, or by one finite step of the slopes if that is more.

    Args:
        fitted: the model.
        data: the episodes.
        progress: called with one line for each episode.
        seed: of the random directions.

    Returns:
        Per episode, the keys of the bins.
    """
    generator = torch.Generator().manual_seed(seed)
    n_directions = CRITERIA.bifurcation.random_directions
    point = fitted.model.point
    sizes = torch.maximum(
        fitted.covariance.diagonal().sqrt(), torch.tensor([abs(step) for _, step in list_steps(fitted.model)]).to(point)
    )
    directions = torch.randn(n_directions, len(point), generator=generator, dtype=point.dtype)
    steps = directions / directions.norm(dim=1, keepdim=True) * sizes
    shifted_models = [fitted.model.at_point(point + step) for step in torch.cat([steps, -steps])]
    shifted = [(world, m.point - point) for m in shifted_models if (world := none_if_impossible(m.build_world))]
    all_steps = [*(step for _, step in shifted), *[torch.zeros_like(point)] * (2 * n_directions)]
    world, keys = fitted.model.build_world(), []
    for k, e in enumerate(data.episodes):
        progress(f"{e.name}, {k + 1} of {len(data.episodes)}")
        runs = [*((shifted_world, e) for shifted_world, _ in shifted)]
        runs += [(world, other) for other in _perturb_initial_shape(e, world, generator)]
        responses = map_parallel(partial(_simulate_bins, data=data, observed=e), runs)
        keys.append(_select_discontinuous(fitted.linearisation, k, responses, all_steps))
    return tuple(keys)


def _perturb_initial_shape(e: Episode, world: World, generator: torch.Generator) -> list[Episode]:
    """Return the episode from shapes that are off along the normal, by smooth random fields and their opposites."""
    criteria = CRITERIA.bifurcation
    normal = torch.as_tensor(vertex_normals(e.initial.numpy(), world.cloth.mesh.faces))
    size = float((e.initial.amax(0) - e.initial.amin(0)).max())
    waves, out = criteria.initial_shape_waves, []
    for _ in range(criteria.random_directions):
        direction = torch.randn(waves, 3, generator=generator, dtype=torch.float64).to(normal)
        frequency, phase = torch.rand(2, waves, generator=generator, dtype=torch.float64).to(normal)
        shortest = criteria.min_wavelength_fraction * size
        wave = direction * (2 * torch.pi * frequency / (shortest * direction.norm(dim=1)))[:, None]
        field = (e.initial @ wave.mT + 2 * torch.pi * phase).cos().sum(1, keepdim=True)
        offset = criteria.initial_shape_rms_m * field / field.square().mean().sqrt() * normal
        out += [replace(e, initial=e.initial + sign * offset) for sign in (1, -1)]
    return out


def drop_bins(fitted: ModelFit, keys: Sequence[Tensor]) -> ModelFit:
    """Return the fit without bins, with the noise of the others; its slopes account for a change of the solution.

    Args:
        fitted: the fit.
        keys: per episode, the keys of the bins.
    """
    result = fitted.linearisation
    remaining = [~torch.isin(bins.key, k) for bins, k in zip(result.bins, keys, strict=True)]
    bins = [b.select(index) for b, index in zip(result.bins, remaining, strict=True)]
    differences = [d[index] for d, index in zip(result.mesh_differences, remaining, strict=True)]
    result = replace(result, bins=bins, mesh_differences=differences)
    return assemble_fit(fitted.model, result, fit_noise(result))


def _simulate_bins(run: tuple[World, Episode], data: DiagnosisData, observed: Episode) -> BinnedResiduals | None:
    world, e = run
    try:
        frames = world.simulate_observed(e, data.dt)
        return bin_residuals(frames, None, observed, data.surface, data.rest_positions)
    except (SimulationDiverged, UnstableStep):
        return None


def _select_discontinuous(
    result: Linearisation, k: int, responses: Sequence[BinnedResiduals | None], steps: Sequence[Tensor]
) -> Tensor:
    """Return the keys of bins of the k-th episode that deviate too much from the linear prediction."""
    criteria, bins = CRITERIA.bifurcation, result.bins[k]
    before = bins.value + result.mesh_differences[k]  # on the mesh that the responses were simulated on
    floor = torch.tensor([CRITERIA.noise.min_slow_error[name] for name in BLOCK_NAMES], dtype=before.dtype)
    min_prediction = criteria.min_prediction_factor * floor[bins.block]
    misfit = average_groups(bins.block, before.square()).sqrt()
    by_parameters, by_shape, beyond_misfit = torch.zeros(3, len(before), dtype=torch.bool)
    for response, step in zip(responses, steps, strict=True):
        if response is None:
            continue
        deviation = (align_rows(bins.key, response.key, response.value) - before).abs()
        prediction = (bins.jacobian[:, : result.n_coordinates] @ step).abs()
        is_nonlinear = deviation > criteria.nonlinearity_ratio * torch.maximum(prediction, min_prediction)
        is_nonlinear &= torch.isin(bins.key, response.key)
        if step.any():
            by_parameters |= is_nonlinear
        else:
            by_shape |= is_nonlinear
            beyond_misfit |= is_nonlinear & (deviation > misfit)
    has_forgotten_shape = float(by_shape.double().mean()) > criteria.max_turned_fraction
    return bins.key[by_parameters | (beyond_misfit if has_forgotten_shape else by_shape)]
