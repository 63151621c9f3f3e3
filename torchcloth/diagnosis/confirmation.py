"""Does the extended model do better on episodes that neither model has seen?"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from .._utils.torch_modes import isolated_grad_mode
from ..episodes.world import Model
from ..errors import InvalidInput, RecordingError
from ..identification.result import or_none
from ..recordings import Recording
from ..recordings.consistency import listed, name_of, same_cloth, together
from ..recordings.fingerprints import alike, each_once, mark
from .data.binning import align_rows
from .data.data_checks import check_episodes
from .data.dataset import Progress, prepare_data, check_positions_observed, prefix_progress
from .data.replicate_floor import find_replicate_pairs, estimate_replicate_floor
from .inference.comparison import Gain, HeldOutPrediction, predict_as_given, compare_by_motion, compare
from .inference.fitting import ModelFit
from .inference.linearise import Linearisation, use_nuisance_slopes, use_noise_inputs, linearise, restrict_to_common_bins
from .inference.noise import Noise, fit_noise, compute_noise_floor, minimal_noise, inflated_noise, whiten
from .models.model_file import ModelFile, read_model

CONVENTION = (
    "SI units. rms: root mean square of mean residuals over parts of the fabric and 0.2 s that both models meet, "
    "without what clock, camera, grasp, rim and tare of the episode explain within their priors. No parameter was "
    "fitted. ci95: by resampling stretches of 0.4 s. explained: share of rms_before^2 - floor^2. log_density: of the "
    "extended over the base model, by the noise that the extended one leaves."
)


@dataclass(frozen=True, eq=False)
class Confirmation:
    """The gain of one model over another, on episodes that neither was fitted to.

    Attributes:
        whole: over all episodes.
        motions: by motion.
        floor: m, what a true model would leave; ``source`` says where it is known from.
        models: files of the base and of the extended model.
        episodes: folders, or names of what was not read from one.
    """

    whole: Gain
    motions: dict[str, Gain]
    floor: float
    source: str
    models: tuple[str, str]
    episodes: list[str]

    @property
    def confirmed(self) -> bool:
        """Whether the extended model predicts better beyond doubt, by density and in millimetres.

        Never by stretches of time that nothing can be compared with: an episode of 0.4 s is one.
        """
        known = self.whole.log_density_ci95[0] < self.whole.log_density_ci95[1]
        return known and min(self.whole.log_density_ci95[0], self.whole.explained_fraction_ci95[0]) > 0

    def as_dict(self) -> dict[str, Any]:
        """The content of confirmation.json."""
        return {
            "confirmed": self.confirmed,
            "gain": _told(self.whole),
            "motions": {name: _told(gain) for name, gain in self.motions.items()},
            "floor": {"value": self.floor, "unit": "m", "source": self.source},
            "models": list(self.models),
            "episodes": self.episodes,
            "convention": CONVENTION,
        }


def _told(gain: Gain) -> dict[str, Any]:
    """Shares are of positions: null where none were seen. Of single stretches of time no interval is known."""
    seen, known = not math.isnan(gain.rms_before), gain.lower_bound_95 > -math.inf
    return {
        "rms_before": or_none(gain.rms_before),
        "rms_after": or_none(gain.rms_after),
        "unit": "m",
        "explained_fraction": gain.explained_fraction if seen else None,
        "explained_ci95": list(gain.explained_fraction_ci95) if seen and known else None,
        "log_density": gain.log_density,
        "log_density_ci95": list(gain.log_density_ci95) if known else None,
    }


@isolated_grad_mode()
def confirm(
    base: str | Path, extended: str | Path, recordings: Sequence[Recording], progress: Progress = lambda _: None
) -> Confirmation:
    """Measure the gain of an extended model over its base.

    Args:
        base, extended: model files; ``diagnose`` writes both.
        recordings: episodes of the same cloth and by the same data sheet, held by the same grasps.
        progress: called with one line for each episode that is simulated.

    Raises:
        InvalidInput: no model file, a second model that does not extend the first, an episode that is given twice, of
            another cloth, or one that a model was fitted to.
        RecordingError: a file that is no model, or an episode that cannot be believed.
    """
    recordings = listed(recordings)
    if faults := check_episodes(recordings):
        raise RecordingError(str(faults[0]))
    each_once(recordings)
    scene = together(recordings)
    files = [read_model(path, scene) for path in (base, extended)]
    for path, file in zip((base, extended), files, strict=True):
        same_cloth([replace(file.scene, path=Path(path)), scene], anywhere=True)
    _refuse_no_extension(*(file.model for file in files))
    for recording in recordings:
        _refuse_seen(recording, files)
    settings = [prepare_data(file.model, recordings) for file in files]
    check_positions_observed(settings[0])
    found = [
        linearise(file.model, setting, (), prefix_progress(progress, stage))
        for file, setting, stage in zip(files, settings, ("base", "extended"), strict=True)
    ]
    noise, like = fit_noise(found[1]), restrict_to_common_bins(found[1], found[:1])
    whole = [predict_as_given(_as_fitted(f.model, e, inflated_noise())) for f, e in zip(files, found, strict=True)]
    before, after = (_judged(f.model, e, w, noise, like) for f, e, w in zip(files, found, whole, strict=True))
    floor, source = min(compute_noise_floor(e, minimal_noise()) for e in found), "sensor only"  # slow errors may be the models' own
    if (repeated := estimate_replicate_floor(whole[1], find_replicate_pairs(recordings, settings[1].episodes))) is not None:
        floor, source = repeated.rms, "repetitions"
    motions = compare_by_motion(before, after, floor, settings[0].motions)
    told = [str(r.path or name_of(r, k)) for k, r in enumerate(recordings)]
    return Confirmation(compare(before, after, floor), motions, floor, source, (str(base), str(extended)), told)


def _refuse_no_extension(base: Model, extended: Model) -> None:
    first, second = ({h.name for h in model.accepted} for model in (base, extended))
    if first == second:
        raise InvalidInput(
            "models",
            got=f"the same causes twice ({', '.join(sorted(first)) or 'none'})",
            expected="an extended model",
            remedy="where a diagnosis added nothing there is no gain to confirm",
        )
    if not first < second:
        raise InvalidInput(
            "models",
            got=f"causes {', '.join(sorted(first)) or 'none'}, then {', '.join(sorted(second)) or 'none'}",
            expected="a base model, then one with all its causes and more",
            remedy="DIR/base.tcm DIR/extended.tcm of `diagnose`, in this order",
        )


def _refuse_seen(recording: Recording, files: Sequence[ModelFile]) -> None:
    own = mark(recording)
    if any(alike(kept, own) for file in files for kept in file.episodes):
        raise InvalidInput(
            f"episode {own['name']!r}",
            got="one that the model was fitted to",
            expected="episodes that neither model has seen",
            remedy="record another, also of the same motion",
        )


def _judged(model: Model, evidence: Linearisation, whole: HeldOutPrediction, noise: Noise, like: Linearisation) -> HeldOutPrediction:
    """Density by ``noise``, on the cells, as rough and with the nuisances of ``like``; metres by nobody's noise.

    So the base's metres are the same whatever it is compared with, on cells that both have.
    """
    alike = predict_as_given(_as_fitted(model, use_noise_inputs(use_nuisance_slopes(evidence, like), like), noise))
    return alike._replace(value=align_rows(alike.bin_key, whole.bin_key, whole.residual))


def _as_fitted(model: Model, evidence: Linearisation, noise: Noise) -> ModelFit:
    none = torch.zeros(len(model.point), len(model.point), dtype=torch.float64)
    return ModelFit(model, evidence, noise, whiten(evidence, noise), none, 0.0)
