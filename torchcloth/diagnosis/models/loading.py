"""A model file as what a user needs of it: a layer, a world, a start for fits, a prediction."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch

from ...cloth import Cloth
from ...episodes.observed import DEFAULT_FRAME_RATE_HZ, Episode, build_episode
from ...episodes.replay import Frames, each
from ...episodes.steps import one_way, shifted
from ...episodes.world import Model, World
from ...episodes.world_cache import if_possible
from ...errors import InvalidInput
from ...identification.episode_prediction import EpisodePrediction, with_errors
from ...identification.io.saved_fit import read_saved
from ...identification.result import START
from ...recordings import Recording
from ...recordings.consistency import same_cloth, together
from ...recordings.fingerprints import alike, mark
from ...recordings.size_checks import check_size
from ..data.binning import finite_differences
from ..data.dataset import MAX_CLOCK_DELAY_S
from ..inference.episode_simulation import map_parallel
from .model_file import ModelFile, load_model, of_fabric, read_model

TRIES = 5  # of drawing a world that there is, for each that is wanted
TOLD = 0.5  # of the prior's width: a parameter that is known better is known from data


def load(path: str | Path) -> Cloth:
    """The model of a ``.tcm`` file as a layer, with its fitted values and effects, ready to be called with motions.

    What the robot and the observer do otherwise is no part of a cloth: ``diagnosis.load_world`` has both beside it.
    Where a cause has moved the patches that are held, vertices lie elsewhere on the pattern (``mesh.uv``) than an
    episode's; ``identification.episode`` carries its first shape over.

    Raises:
        InvalidInput: no such file, or a cause that is not in the catalogue.
        RecordingError: a file that is damaged or no model.
    """
    return load_world(path).cloth.requires_grad_(True)


def load_world(path: str | Path) -> World:
    """``cloth``, ``motions`` (what the robot really does), ``views`` (what the observer sees); raises as ``load``."""
    return load_model(path).world()


def cloth_for(path: str | Path, recording: Recording) -> Cloth:
    """The model's fabric and effects in the mesh, grasps and tables of an episode.

    Raises:
        InvalidInput: as ``load``, or an episode with another fabric.
        RecordingError: as ``load``.
    """
    return read_model(path, recording).model.world().cloth.requires_grad_(True)


def start_of(fit: str | Path) -> Callable[[Recording], Cloth] | None:
    """Makes an episode's cloth of the model that a saved fit of ``identify --model`` began with; None: it had none.

    Args:
        fit: identification.json, or the folder that holds it.

    Raises:
        InvalidInput: there is no such file.
        RecordingError: it cannot be read, or does not hold what is needed.
    """
    if not read_saved(fit).begun:
        return None
    folder = Path(fit) if Path(fit).is_dir() else Path(fit).parent
    return partial(cloth_for, folder / START)


def beside_the_cloth(model: Model) -> dict[str, float]:
    """Amplitudes of accepted causes that are in robot or observer and not in the cloth."""
    found, world = {}, model.base  # each once: a patch that is wider already may have no room to be wider yet
    for h, amplitude in zip(model.accepted, model.amplitudes, strict=True):
        if h.applied(world, amplitude).cloth is world.cloth:
            found[h.name] = amplitude
    return found


def uncertain(file: ModelFile) -> dict[str, tuple[float, float]]:
    """By name of the cloth's own parameters that data determine: (value, spread), as the priors of ``identify``."""
    from ...episodes.unknowns import available

    out = {}
    if file.covariance is None:
        return out
    stds, cloth = file.covariance.diagonal().sqrt().tolist(), file.model.world().cloth
    own = available(cloth)
    for p, c, std in zip(file.model.parameters, file.model.values.tolist(), stds, strict=False):
        if std < TOLD * p.std and p.name in own:
            positive = cloth.get_submodule(own[p.name]).domain == "positive"
            up, value, down = p.value(c + std), p.value(c), p.value(c - std)
            out[p.name] = (value, math.sqrt(up / down) if positive else abs(up - down) / 2)
    return out


def drawn_models(file: ModelFile, count: int, seed: int = 0) -> list[Model]:
    """``count`` models: the file's, then with its numbers drawn from their joint errors, where a world has such.

    A residual force, whose errors nobody knows, stays.

    Raises:
        InvalidInput: several are asked for and the file has no errors, or hardly any number within them has a world.
    """
    model, rng, out = file.model, torch.Generator().manual_seed(seed), [file.model]
    if count > 1 and file.covariance is None:
        raise InvalidInput("draws", got=f"{count} of a model without errors", expected="1, or a model with them")
    for _ in range(TRIES * count):
        if len(out) >= count or file.covariance is None:
            return out
        values, vectors = torch.linalg.eigh(file.covariance)
        noise = vectors * values.clamp(min=0.0).sqrt() @ torch.randn(len(values), generator=rng, dtype=values.dtype)
        drawn = model.at(model.point + torch.cat([noise, noise.new_zeros(len(model.point) - len(noise))]))
        out += [] if if_possible(drawn.world) is None else [drawn]
    raise InvalidInput("draws", got=f"{len(out)} of {count} for which there is a world", expected="fewer draws")


def was_fitted(path: str | Path, recording: Recording) -> bool:
    """Whether a model was fitted to this episode; raises as ``read_model``."""
    own = mark(recording)
    return any(alike(kept, own) for kept in read_model(path).episodes)


def begin_with(path: str | Path, recordings: Sequence[Recording]) -> tuple[Model, list[Recording]]:
    """A model file for ``diagnose``: its fabric and causes in the mesh, grasps and tables of episodes.

    Without its residual force, which is no cause. The episodes come back with the data sheet that the model's numbers
    are relative to. Raises as ``read_model``, or InvalidInput for episodes of two scenes.
    """
    same_cloth(recordings)
    own = read_model(path).scene
    told = [of_fabric(path, own, r) for r in recordings]
    file = read_model(path, together(told), residual=False)
    return replace(file.model, met=tuple(file.episodes)), told


def watched(world: World, data: Episode) -> Frames:
    """What an observer whose clock may be late has of all of an episode's frames."""
    return each(world.frames(data.with_lookahead(MAX_CLOCK_DELAY_S)), lambda field: field[: len(data.times)])


def predicted(path: str | Path, recording: Recording) -> EpisodePrediction:
    """Where the cloth goes in any episode, with errors from the covariance of the model's numbers.

    Robot and observer err as the model says. Where nothing was seen there are twenty frames a second. Raises as
    ``cloth_for``, and for what was seen in another unit than metres.
    """
    check_size(recording)
    file = read_model(path, recording)
    model, world = file.model, file.model.world()
    data, every = build_episode(model.base.cloth, recording, DEFAULT_FRAME_RATE_HZ), one_way(model)
    covariance = torch.zeros(len(every), len(every)) if file.covariance is None else file.covariance
    shifts = every[: len(covariance)]  # a residual force, which comes last, has no errors
    worlds = [world, *(shifted(model, k, step).world() for k, step in shifts)]
    frames, *beside = map_parallel(lambda w: watched(w, data), worlds)
    slopes = finite_differences(frames, beside, [step for _, step in shifts])
    return with_errors(world.cloth, data, frames, slopes, covariance, math.nan)
