"""Uses of a model file: a cloth, a world, a start for fits, a prediction."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch

from ...cloth import Cloth
from ...episodes.observed import DEFAULT_FRAME_RATE_HZ, Episode, build_episode
from ...episodes.replay import Frames, map_frames
from ...episodes.steps import one_sided_steps, shift_model
from ...episodes.world import World, WorldModel
from ...episodes.world_cache import none_if_impossible
from ...errors import InvalidInput
from ...identification.episode_prediction import EpisodePrediction, propagate_errors
from ...identification.io.saved_fit import read_saved_fit
from ...identification.result import START_MODEL_FILE_NAME
from ...recordings import Recording
from ...recordings.consistency import check_same_cloth, merge_scene
from ...recordings.fingerprints import fingerprint, same_episode
from ...recordings.size_checks import check_size
from ..data.binning import finite_differences
from ..data.dataset import MAX_CLOCK_DELAY_S
from ..inference.episode_simulation import map_parallel
from .model_file import ModelFile, adopt_data_sheet, load_model, read_model

MAX_DRAWS_PER_MODEL = 5  # of a model for which there is a world
MAX_FRACTION_OF_PRIOR_STD = 0.5  # a parameter with a smaller standard error is determined by data


def load(path: str | Path) -> Cloth:
    """Load the model of a ``.tcm`` file as a cloth, with its fitted values and effects.

    Errors of the robot and the observer are no part of a cloth: ``diagnosis.load_world`` has them as well. If a cause
    has moved the grasped patches, vertices lie elsewhere on the pattern (``mesh.uv``) than an episode's.
    ``identification.episode`` interpolates its initial shape.

    Raises:
        InvalidInput: no such file, or a cause that is not in the catalogue.
        RecordingError: a file that is damaged or no model.
    """
    return load_world(path).cloth.require_default_gradients_()


def load_world(path: str | Path) -> World:
    """Load a model file as a world: its cloth, and what robot and observer do wrong; raises as ``load``."""
    return load_model(path).build_world()


def load_cloth_for(path: str | Path, recording: Recording) -> Cloth:
    """Load the model's fabric and effects with the mesh, grasps and tables of an episode.

    Args:
        path: model file.
        recording: the episode.

    Raises:
        InvalidInput: as ``load``, or an episode with another fabric.
        RecordingError: as ``load``.
    """
    return read_model(path, recording).model.build_world().cloth.require_default_gradients_()


def make_start_builder(fit: str | Path) -> Callable[[Recording], Cloth] | None:
    """Return a function that builds an episode's cloth from the model that a saved fit started from.

    Args:
        fit: identification.json, or its folder.

    Returns:
        The function; None if the fit did not start from a model file (``identify --model``).

    Raises:
        InvalidInput: no such file.
        RecordingError: a file that cannot be read, or without what is needed.
    """
    if not read_saved_fit(fit).has_start_model:
        return None
    folder = Path(fit) if Path(fit).is_dir() else Path(fit).parent
    return partial(load_cloth_for, folder / START_MODEL_FILE_NAME)


def list_causes_outside_cloth(model: WorldModel) -> dict[str, float]:
    """Return the amplitudes of accepted causes that are in the robot or the observer and not in the cloth."""
    # each cause is applied alone: a patch that is wider already may have no room to be wider
    causes, world = zip(model.accepted, model.amplitudes, strict=True), model.base
    return {h.name: amplitude for h, amplitude in causes if h.apply_to(world, amplitude).cloth is world.cloth}


def derive_priors(file: ModelFile) -> dict[str, tuple[float, float]]:
    """Return priors of ``identify`` for the cloth's parameters that data have determined.

    Args:
        file: a model file.

    Returns:
        (value, spread) by name: a factor for positive parameters, else a difference.
    """
    from ...episodes.unknowns import find_scalar_parameters

    priors = {}
    if file.covariance is None:
        return priors
    stds, cloth = file.covariance.diagonal().sqrt().tolist(), file.model.build_world().cloth
    paths = find_scalar_parameters(cloth)
    for p, c, std in zip(file.model.parameters, file.model.coordinates.tolist(), stds, strict=False):
        if std < MAX_FRACTION_OF_PRIOR_STD * p.prior_std and p.name in paths:
            is_positive = cloth.get_submodule(paths[p.name]).domain == "positive"
            up, value, down = p.value(c + std), p.value(c), p.value(c - std)
            priors[p.name] = (value, math.sqrt(up / down) if is_positive else abs(up - down) / 2)
    return priors


def draw_models(file: ModelFile, count: int, seed: int = 0) -> list[WorldModel]:
    """Draw models from the joint errors of a file's numbers; the first one is the file's model.

    A residual force, whose errors are not known, stays.

    Args:
        file: a model file.
        count: number of models.
        seed: of the draws.

    Raises:
        InvalidInput: several models of a file without errors, or errors within which hardly any world exists.
    """
    model, generator, models = file.model, torch.Generator().manual_seed(seed), [file.model]
    if count > 1 and file.covariance is None:
        raise InvalidInput("draws", got=f"{count} of a model without errors", expected="1, or a model with them")
    for _ in range(MAX_DRAWS_PER_MODEL * count):
        if len(models) >= count or file.covariance is None:
            return models
        values, vectors = torch.linalg.eigh(file.covariance)
        standard = torch.randn(len(values), generator=generator, dtype=values.dtype)
        noise = vectors * values.clamp(min=0.0).sqrt() @ standard
        drawn = model.at_point(model.point + torch.cat([noise, noise.new_zeros(len(model.point) - len(noise))]))
        models += [] if none_if_impossible(drawn.build_world) is None else [drawn]
    raise InvalidInput("draws", got=f"{len(models)} of {count} for which there is a world", expected="fewer draws")


def was_fitted(path: str | Path, recording: Recording) -> bool:
    """Check whether a model was fitted to this episode; raises as ``read_model``."""
    episode = fingerprint(recording)
    return any(same_episode(other, episode) for other in read_model(path).episodes)


def start_from_model(path: str | Path, recordings: Sequence[Recording]) -> tuple[WorldModel, list[Recording]]:
    """Prepare a model file as the start of ``diagnose``, with the mesh, grasps and tables of episodes.

    Its residual force, which is no cause, is left out.

    Args:
        path: model file.
        recordings: the episodes.

    Returns:
        The model, and the episodes with the data sheet that the model's numbers are relative to.

    Raises:
        InvalidInput: as ``read_model``, or episodes of different scenes.
        RecordingError: as ``read_model``.
    """
    check_same_cloth(recordings)
    model_scene = read_model(path).scene
    adopted = [adopt_data_sheet(path, model_scene, r) for r in recordings]
    file = read_model(path, merge_scene(adopted), residual=False)
    return replace(file.model, episode_fingerprints=tuple(file.episodes)), adopted


def simulate_frames(world: World, data: Episode) -> Frames:
    """Simulate what an observer, whose clock may be late, sees at all of an episode's frames."""
    frames = world.simulate_observed(data.with_lookahead(MAX_CLOCK_DELAY_S))
    return map_frames(frames, lambda field: field[: len(data.times)])


def predict_episode(path: str | Path, recording: Recording) -> EpisodePrediction:
    """Predict an episode by a model file, with errors from the covariance of the model's numbers.

    Robot and observer err as the model says. If nothing was observed, there are twenty frames a second.

    Args:
        path: model file.
        recording: the episode.

    Raises:
        InvalidInput: as ``load_cloth_for``, or observations in another unit than metres.
        RecordingError: as ``load_cloth_for``.
    """
    check_size(recording)
    file = read_model(path, recording)
    model, world = file.model, file.model.build_world()
    data, steps = build_episode(model.base.cloth, recording, DEFAULT_FRAME_RATE_HZ), one_sided_steps(model)
    covariance = torch.zeros(len(steps), len(steps)) if file.covariance is None else file.covariance
    steps = steps[: len(covariance)]  # a residual force, which comes last, has no errors
    worlds = [world, *(shift_model(model, k, step).build_world() for k, step in steps)]
    frames, *shifted = map_parallel(lambda w: simulate_frames(w, data), worlds)
    slopes = finite_differences(frames, shifted, [step for _, step in steps])
    return propagate_errors(world.cloth, data, frames, slopes, covariance, math.nan)
