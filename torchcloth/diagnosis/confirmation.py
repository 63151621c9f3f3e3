"""Does the extended model do better on episodes that neither model has seen?"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from .._utils.torch_modes import own_gradients
from ..episodes.world import Model
from ..errors import InvalidInput, RecordingError
from ..identification.result import or_none
from ..recordings import Recording
from ..recordings.consistency import listed, name_of, same_cloth, together
from ..recordings.fingerprints import alike, each_once, mark
from .data.binning import aligned
from .data.data_checks import check
from .data.dataset import Progress, setting_of, somewhere_seen, staged
from .data.replicate_floor import pairs_of, repeats
from .inference.comparison import Gain, Predicted, as_it_is, by_motion, compare
from .inference.fitting import Fitted
from .inference.linearise import Evidence, as_held, as_rough, gather, shared
from .inference.noise import Noise, fit_noise, floor_of, least, unfitted, whitened
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
        known = self.whole.ci95[0] < self.whole.ci95[1]
        return known and min(self.whole.ci95[0], self.whole.explained_ci95[0]) > 0

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
    seen, known = not math.isnan(gain.before), gain.least > -math.inf
    return {
        "rms_before": or_none(gain.before),
        "rms_after": or_none(gain.after),
        "unit": "m",
        "explained_fraction": gain.explained if seen else None,
        "explained_ci95": list(gain.explained_ci95) if seen and known else None,
        "log_density": gain.density,
        "log_density_ci95": list(gain.ci95) if known else None,
    }


@own_gradients()
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
    if faults := check(recordings):
        raise RecordingError(str(faults[0]))
    each_once(recordings)
    scene = together(recordings)
    files = [read_model(path, scene) for path in (base, extended)]
    for path, file in zip((base, extended), files, strict=True):
        same_cloth([replace(file.scene, path=Path(path)), scene], anywhere=True)
    _refuse_no_extension(*(file.model for file in files))
    for recording in recordings:
        _refuse_seen(recording, files)
    settings = [setting_of(file.model, recordings) for file in files]
    somewhere_seen(settings[0])
    found = [
        gather(file.model, setting, (), staged(progress, stage))
        for file, setting, stage in zip(files, settings, ("base", "extended"), strict=True)
    ]
    noise, like = fit_noise(found[1]), shared(found[1], found[:1])
    whole = [as_it_is(_as_fitted(f.model, e, unfitted())) for f, e in zip(files, found, strict=True)]
    before, after = (_judged(f.model, e, w, noise, like) for f, e, w in zip(files, found, whole, strict=True))
    floor, source = min(floor_of(e, least()) for e in found), "sensor only"  # slow errors may be the models' own
    if (repeated := repeats(whole[1], pairs_of(recordings, settings[1].episodes))) is not None:
        floor, source = repeated.rms, "repetitions"
    motions = by_motion(before, after, floor, settings[0].names)
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


def _judged(model: Model, evidence: Evidence, whole: Predicted, noise: Noise, like: Evidence) -> Predicted:
    """Density by ``noise``, on the cells, as rough and with the nuisances of ``like``; metres by nobody's noise.

    So the base's metres are the same whatever it is compared with, on cells that both have.
    """
    alike = as_it_is(_as_fitted(model, as_rough(as_held(evidence, like), like), noise))
    return alike._replace(value=aligned(alike.place, whole.place, whole.value))


def _as_fitted(model: Model, evidence: Evidence, noise: Noise) -> Fitted:
    none = torch.zeros(len(model.point), len(model.point), dtype=torch.float64)
    return Fitted(model, evidence, noise, whitened(evidence, noise), none, 0.0)
