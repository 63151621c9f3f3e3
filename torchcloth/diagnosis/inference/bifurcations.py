"""Cells that jump: slack cloth has several shapes, and a change that should move it a little turns a fold over.

Where the simulation does not do what its slopes say, residuals tell of the branch and not of a cause (Clyde et al.
2017 find several stable equilibria of real fabrics). The same where an error of the first shape decides: a sheet that
is pulled askew buckles, and to which side a millimetre says that nobody has measured. Such cells are left out.
Where that would be most cells of an episode, no fold has turned over, but cloth that swings for seconds has forgotten
how it began: there only cells are left out that are moved by more than the simulation is off anyway.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from ...episodes.observed import Episode
from ...episodes.steps import step_sizes
from ...episodes.world import World
from ...episodes.world_cache import if_possible
from ...errors import SimulationDiverged, UnstableStep
from ...meshes.mesh import vertex_normals
from ..data.binning import BLOCK_NAMES, BinnedResiduals, align_rows, bin_residuals, average_groups
from ..data.dataset import Progress, DiagnosisData
from .episode_simulation import map_parallel
from .fitting import ModelFit, assemble_fit
from .linearise import Linearisation
from .noise import FLOOR, fit_noise

DIRECTIONS = 2  # random ones of parameters, and as many of the first shape, each there and back
FIRST, WAVES, SHORTEST = 1e-3, 8, 0.5  # m RMS, that a first shape may be off; plane waves in it; of the cloth's size
TIMES = 5.0  # the linear prediction, beyond which a cell has jumped
MOST = 0.5  # of an episode's cells, that folds turn over: 0.34 in ten development cases, in IRI swings 0.53 to 0.65
LEAST = 3.0  # of the noise's floor: predictions below count as this


def find_bifurcating_bins(found: ModelFit, setting: DiagnosisData, progress: Progress = lambda _: None, seed: int = 0) -> tuple[Tensor, ...]:
    """Per episode, the keys of cells that jump within the uncertainty of the parameters, or of the first shape.

    By one standard error in random directions, or by one finite step of the slopes where that is more.
    """
    rng = torch.Generator().manual_seed(seed)
    point = found.model.point
    sizes = torch.maximum(
        found.covariance.diagonal().sqrt(), torch.tensor([abs(step) for _, step in step_sizes(found.model)]).to(point)
    )
    drawn = torch.randn(DIRECTIONS, len(point), generator=rng, dtype=point.dtype)
    steps = drawn / drawn.norm(dim=1, keepdim=True) * sizes
    steps = torch.cat([steps, -steps])
    beside = [found.model.at(point + step) for step in steps]
    there = [(world, near.point - point) for near in beside if (world := if_possible(near.world))]
    worlds, moved = [world for world, _ in there], [step for _, step in there]
    moved += [torch.zeros_like(point)] * (2 * DIRECTIONS)
    plain, keys = found.model.world(), []
    for k, e in enumerate(setting.episodes):
        progress(f"{e.name}, {k + 1} of {len(setting.episodes)}")
        tried = [*((world, e) for world in worlds), *((plain, other) for other in _begun(e, plain, rng))]
        seen = map_parallel(partial(_cells, setting=setting, seen=e), tried)
        keys.append(_jumped(found.linearisation, k, seen, moved))
    return tuple(keys)


def _begun(e: Episode, world: World, rng: torch.Generator) -> list[Episode]:
    """The episode from shapes that are off, along the normal, by smooth random fields and by their opposites."""
    normal = torch.as_tensor(vertex_normals(e.initial.numpy(), world.cloth.mesh.faces))
    size = float((e.initial.amax(0) - e.initial.amin(0)).max())
    out = []
    for _ in range(DIRECTIONS):
        drawn = torch.randn(WAVES, 3, generator=rng, dtype=torch.float64).to(normal)
        share, phase = torch.rand(2, WAVES, generator=rng, dtype=torch.float64).to(normal)
        wave = drawn * (2 * torch.pi * share / (SHORTEST * size * drawn.norm(dim=1)))[:, None]
        field = (e.initial @ wave.mT + 2 * torch.pi * phase).cos().sum(1, keepdim=True)
        off = FIRST * field / field.square().mean().sqrt() * normal
        out += [replace(e, initial=e.initial + sign * off) for sign in (1, -1)]
    return out


def drop_bins(found: ModelFit, keys: Sequence[Tensor]) -> ModelFit:
    """The same fit, weighed anew by the cells that do not jump; slopes take care of what moves the solution."""
    stable = [~torch.isin(c.key, k) for c, k in zip(found.linearisation.bins, keys, strict=True)]
    cells = [c.select(s) for c, s in zip(found.linearisation.bins, stable, strict=True)]
    numerics = [n[s] for n, s in zip(found.linearisation.mesh_differences, stable, strict=True)]
    evidence = replace(found.linearisation, cells=cells, numerics=numerics)
    return assemble_fit(found.model, evidence, fit_noise(evidence))


def _cells(tried: tuple[World, Episode], setting: DiagnosisData, seen: Episode) -> BinnedResiduals | None:
    world, e = tried
    try:
        return bin_residuals(world.frames(e, setting.dt), None, seen, setting.sheet, setting.rest_positions)
    except (SimulationDiverged, UnstableStep):
        return None


def _jumped(evidence: Linearisation, k: int, seen: Sequence[BinnedResiduals | None], moved: Sequence[Tensor]) -> Tensor:
    cells = evidence.bins[k]
    before = cells.value + evidence.mesh_differences[k]  # on the mesh that the others are simulated on
    least = LEAST * torch.tensor([FLOOR[name] for name in BLOCK_NAMES], dtype=before.dtype)[cells.block]
    off = average_groups(cells.block, before.square()).sqrt()
    jumped, turned, beyond = torch.zeros(3, len(before), dtype=torch.bool)
    for found, step in zip(seen, moved, strict=True):
        if found is None:
            continue
        deviation = (align_rows(cells.key, found.key, found.value) - before).abs()
        expected = torch.maximum((cells.jacobian[:, : evidence.n_coordinates] @ step).abs(), least)
        far = torch.isin(cells.key, found.key) & (deviation > TIMES * expected)
        if step.any():
            jumped |= far
        else:
            turned |= far
            beyond |= far & (deviation > off)
    forgetful = float(turned.double().mean()) > MOST
    return cells.key[jumped | (beyond if forgetful else turned)]
