"""Confirmation: the gain of an extended model on episodes that neither model was fitted to."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from .._utils.torch_modes import isolated_grad_mode
from ..episodes.world import WorldModel
from ..errors import InvalidInput, RecordingError
from ..identification.result import nan_to_none
from ..recordings import Recording
from ..recordings.consistency import as_list, check_same_cloth, display_name, merge_scene
from ..recordings.fingerprints import fingerprint, reject_duplicates, same_episode
from .data.binning import align_rows
from .data.data_checks import check_episodes
from .data.dataset import Progress, check_positions_observed, prefix_progress, prepare_data
from .data.replicate_floor import estimate_replicate_floor, find_replicate_pairs
from .inference.comparison import Gain, HeldOutPrediction, compare, compare_by_motion, predict_as_given
from .inference.fitting import ModelFit
from .inference.linearise import (
    Linearisation,
    linearise,
    restrict_to_common_bins,
    use_noise_inputs,
    use_nuisance_slopes,
)
from .inference.noise import Noise, compute_noise_floor, fit_noise, inflated_noise, minimal_noise, whiten
from .models.model_file import ModelFile, read_model

SCHEMA = "torchcloth.confirmation/1"
CONVENTION = (
    "SI units. rms: root mean square of mean residuals over parts of the fabric and 0.2 s that both models have, "
    "without what clock, camera, grasp, rim and tare explain within their priors. No parameter is fitted. "
    "Intervals: bootstrap over blocks of 0.4 s. explained_fraction: of rms_before^2 - noise_floor^2. log_density: of "
    "the extended over the base model, by the noise that the extended one leaves."
)


@dataclass(frozen=True, eq=False)
class Confirmation:
    """Gain of one model over another, on episodes that neither was fitted to.

    Attributes:
        total_gain: over all episodes.
        gain_by_motion: gain of each motion.
        noise_floor: RMS that a correct model would leave [m].
        floor_source: source of the noise floor.
        models: files of the base and of the extended model.
        episodes: folders, or names of episodes that were not read from one.
    """

    total_gain: Gain
    gain_by_motion: dict[str, Gain]
    noise_floor: float
    floor_source: str
    models: tuple[str, str]
    episodes: list[str]

    @property
    def is_confirmed(self) -> bool:
        """Whether the extended model surely predicts better, by log density and in millimetres.

        A single block of time has no scatter, so an episode of 0.4 s confirms nothing.
        """
        low, high = self.total_gain.log_density_ci95
        return low < high and min(low, self.total_gain.explained_fraction_ci95[0]) > 0

    def as_dict(self) -> dict[str, Any]:
        """Return the content of confirmation.json."""
        return {
            "schema": SCHEMA,
            "is_confirmed": self.is_confirmed,
            "gain": _describe_gain(self.total_gain),
            "motions": {motion: _describe_gain(gain) for motion, gain in self.gain_by_motion.items()},
            "noise_floor": {"value": self.noise_floor, "unit": "m", "source": self.floor_source},
            "models": list(self.models),
            "episodes": self.episodes,
            "convention": CONVENTION,
        }


def _describe_gain(gain: Gain) -> dict[str, Any]:
    """Return a gain; null without positions, or where a single block of time has no interval."""
    has_positions, has_interval = not math.isnan(gain.rms_before), gain.lower_bound_95 > -math.inf
    return {
        "rms_before": nan_to_none(gain.rms_before),
        "rms_after": nan_to_none(gain.rms_after),
        "unit": "m",
        "explained_fraction": gain.explained_fraction if has_positions else None,
        "explained_fraction_ci95": list(gain.explained_fraction_ci95) if has_positions and has_interval else None,
        "log_density": gain.log_density,
        "log_density_ci95": list(gain.log_density_ci95) if has_interval else None,
    }


@isolated_grad_mode()
def confirm(
    base: str | Path, extended: str | Path, recordings: Sequence[Recording], progress: Progress = lambda _: None
) -> Confirmation:
    """Measure the gain of an extended model over its base.

    Args:
        base: model file of ``diagnose``.
        extended: model file of ``diagnose`` with further causes.
        recordings: episodes of the same cloth, with the same data sheet and the same grasps.
        progress: called with one line for each episode that is simulated.

    Raises:
        InvalidInput: no model file, a second model that does not extend the first, an episode that is given twice, one
            of another cloth, or one that a model was fitted to.
        RecordingError: a file that is no model, or an episode that cannot be used.
    """
    recordings = as_list(recordings)
    if faults := check_episodes(recordings):
        raise RecordingError(str(faults[0]))
    reject_duplicates(recordings)
    scene = merge_scene(recordings)
    files = [read_model(path, scene) for path in (base, extended)]
    for path, file in zip((base, extended), files, strict=True):
        check_same_cloth([replace(file.scene, path=Path(path)), scene], any_scene=True)
    _check_is_extension(*(file.model for file in files))
    for recording in recordings:
        _check_not_fitted(recording, files)
    data = [prepare_data(file.model, recordings) for file in files]
    check_positions_observed(data[0])
    results = [
        linearise(file.model, d, (), prefix_progress(progress, stage))
        for file, d, stage in zip(files, data, ("base", "extended"), strict=True)
    ]
    noise, common = fit_noise(results[1]), restrict_to_common_bins(results[1], results[:1])
    plain = [
        predict_as_given(_wrap_as_fit(file.model, result, inflated_noise()))
        for file, result in zip(files, results, strict=True)
    ]
    before, after = (
        _predict_on_common_noise(file.model, result, prediction, noise, common)
        for file, result, prediction in zip(files, results, plain, strict=True)
    )
    # slow errors that were fitted may be the models' own, so the floor has the smallest ones
    floor, source = min(compute_noise_floor(result, minimal_noise()) for result in results), "sensor only"
    pairs = find_replicate_pairs(recordings, data[1].episodes)
    if (replicate_floor := estimate_replicate_floor(plain[1], pairs)) is not None:
        floor, source = replicate_floor.rms, "repetitions"
    return Confirmation(
        total_gain=compare(before, after, floor),
        gain_by_motion=compare_by_motion(before, after, floor, data[0].motions),
        noise_floor=floor,
        floor_source=source,
        models=(str(base), str(extended)),
        episodes=[str(r.path or display_name(r, k)) for k, r in enumerate(recordings)],
    )


def _check_is_extension(base: WorldModel, extended: WorldModel) -> None:
    first, second = ({h.name for h in model.accepted} for model in (base, extended))
    if first == second:
        raise InvalidInput(
            "models",
            got=f"the same causes twice ({', '.join(sorted(first)) or 'none'})",
            expected="an extended model",
            remedy="a diagnosis that added no cause has no gain to confirm",
        )
    if not first < second:
        raise InvalidInput(
            "models",
            got=f"causes {', '.join(sorted(first)) or 'none'}, then {', '.join(sorted(second)) or 'none'}",
            expected="a base model, then one with all its causes and more",
            remedy="DIR/base.tcm DIR/extended.tcm of `diagnose`, in this order",
        )


def _check_not_fitted(recording: Recording, files: Sequence[ModelFile]) -> None:
    episode = fingerprint(recording)
    if any(same_episode(other, episode) for file in files for other in file.episodes):
        raise InvalidInput(
            f"episode {episode['name']!r}",
            got="one that the model was fitted to",
            expected="episodes that neither model was fitted to",
            remedy="record another one; it may have the same motion",
        )


def _predict_on_common_noise(
    model: WorldModel, result: Linearisation, plain: HeldOutPrediction, noise: Noise, common: Linearisation
) -> HeldOutPrediction:
    """Return a prediction whose density uses common bins, noise inputs and nuisances, and whose metres do not.

    So the metres of the base are the same whatever it is compared with, on common bins.
    """
    comparable = use_noise_inputs(use_nuisance_slopes(result, common), common)
    prediction = predict_as_given(_wrap_as_fit(model, comparable, noise))
    return prediction._replace(residual=align_rows(prediction.bin_key, plain.bin_key, plain.residual))


def _wrap_as_fit(model: WorldModel, result: Linearisation, noise: Noise) -> ModelFit:
    covariance = torch.zeros(len(model.point), len(model.point), dtype=torch.float64)
    return ModelFit(model, result, noise, whiten(result, noise), covariance, 0.0)
