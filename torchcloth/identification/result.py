"""The result of a fit: estimates with their errors, distances before and after, and what to mistrust."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from torch import Tensor

from .._utils.files import write_atomically, write_text
from ..cloth import Cloth
from ..recordings import Recording
from .uncertainty.estimates import Combination, Estimate, InfluenceStatement, Profile

IDENTIFICATION_SCHEMA = "torchcloth.identification/1"
IDENTIFICATION_FILE_NAME = "identification.json"
START_MODEL_FILE_NAME = "start.tcm"  # the model that a fit began with, in the folder of its result
IDENTIFICATION_CONVENTION = (
    "SI units. chamfer: one-sided distance, cloud to surface: mean over frames of the mean distance [m] from each "
    "measured point to the nearest point of the simulated triangles. rms: root mean square of the same distances over "
    "all points. Both are null (JSON) where no points were measured. null: the baseline of a cloth that moves rigidly "
    "with the grippers, undeformed, with forces of zero. force_rms: root mean square error [N] of all force readings; "
    "constant: of each gripper's mean reading. std: standard error of the estimate. It accounts for noise that is "
    "correlated within parts of the fabric and between nearby frames, for the noise of a measured first shape where "
    "grippers hold, and for the scatter between three or more episodes: between those that repeat each other "
    "(split.motion or split.replicate_of), and between all others, widened as Student's t. It also covers the "
    "remaining step of a search that was cut short. It does not cover persistent model error. ci95: 95 % interval in "
    "the log (logit) coordinate; for amplitudes of effects and the cone linear, cut at 0; the profile's where there is "
    "one with both ends. identifiable: std is below 25 % of the larger of the value and its typical size. It is also "
    "below half of the prior's standard deviation in that coordinate, unless the prior was measured. The fit beats the "
    "null, and its derivatives hold. With refine (default of the command without --profile, not of the function), "
    "values and std include the correction for the mesh. source 'not in the model' or 'held fixed': value, std and "
    "ci95 are those of the prior. identifiability: rms displacement of the cloth [mm] and rms change of its forces [N] "
    "by one standard deviation of the prior, and by 10 % of the value. nuisances: what differs from episode to "
    "episode, in [m], [s], [rad] or [N]."
)


@dataclass(frozen=True, eq=False)
class Identification:
    """The result of ``identify``.

    Attributes:
        parameters: estimates by name.
        fit: distances [m] before, after and of the null, counts, seconds.
        correlation: of the fitted parameters, name -> name -> correlation.
        warnings: what to mistrust, in sentences.
        history: one entry per iteration: Chamfer distance [m] and parameter values.
        frames_before: [T, V, 3] m of each episode at the start values, as its observer sees them.
        frames_after: [T, V, 3] m of each episode at the fitted values, as its observer sees them.
        frames_null: [T, V, 3] m of each episode, carried rigidly.
        keys: module path by name of the fitted parameters.
        nuisances: estimates by episode of what is not the fabric's: clock, camera, first shape.
        influences: by fitted parameter, how far it moves the cloth, and which experiment would determine it.
        combinations: of parameters, which the data determine together or leave open.
        model: what else a repetition of the simulation needs (see ``io.saved_fit``).
        profiles: of the parameters for which one was asked.
        forces_before: gripper -> [T, 6] N, N m of each episode at the start values, as ``Episode.wrenches``.
        forces_after: the wrenches at the fitted values.
        recordings: the episodes as they were fitted, after the checks.
        likely_reasons: share of the misfit that each error of the recording would explain, by name, the largest first.
            Empty where the fit describes the points.
    """

    parameters: dict[str, Estimate]
    fit: dict[str, Any]
    correlation: dict[str, dict[str, float]]
    warnings: list[str]
    history: list[dict[str, Any]]
    frames_before: list[Tensor] = field(repr=False)
    frames_after: list[Tensor] = field(repr=False)
    frames_null: list[Tensor] = field(repr=False)
    keys: dict[str, str] = field(default_factory=dict, repr=False)
    nuisances: dict[str, dict[str, Estimate]] = field(default_factory=dict)
    influences: dict[str, InfluenceStatement] = field(default_factory=dict)
    combinations: list[Combination] = field(default_factory=list)
    model: dict[str, Any] = field(default_factory=dict, repr=False)
    profiles: dict[str, Profile] = field(default_factory=dict)
    forces_before: list[dict[str, Tensor]] = field(default_factory=list, repr=False)
    forces_after: list[dict[str, Tensor]] = field(default_factory=list, repr=False)
    recordings: list[Recording] = field(default_factory=list, repr=False)
    likely_reasons: dict[str, float] = field(default_factory=dict)

    @property
    def is_withdrawn(self) -> bool:
        """Whether the fit means nothing, so that values and intervals of all fitted parameters are of no use."""
        return bool(self.fit.get("withdrawn"))

    def as_dict(self) -> dict[str, Any]:
        """Return the content of identification.json."""
        return {
            "schema": IDENTIFICATION_SCHEMA,
            "parameters": {name: asdict(estimate) for name, estimate in self.parameters.items()},
            "fit": {name: nan_to_none(value) for name, value in self.fit.items()},
            "correlation": {a: {b: nan_to_none(r) for b, r in row.items()} for a, row in self.correlation.items()},
            "identifiability": {name: asdict(influence) for name, influence in self.influences.items()},
            "combinations": [{"product": c.text, **asdict(c)} for c in self.combinations],
            "nuisances": {
                episode: {name: asdict(estimate) for name, estimate in estimates.items()}
                for episode, estimates in self.nuisances.items()
            },
            "profiles": {name: asdict(profile) for name, profile in self.profiles.items()},
            "likely_reasons": self.likely_reasons,
            "convention": IDENTIFICATION_CONVENTION,
            "warnings": self.warnings,
            "history": [{name: nan_to_none(value) for name, value in entry.items()} for entry in self.history],
            "model": self.model,
        }

    def save(self, folder: str | Path, start_model: str | Path | None = None) -> Path:
        """Write identification.json into ``folder`` atomically, and return its path.

        Args:
            folder: made if it does not exist.
            start_model: .tcm file whose cloth was fitted, if it was one. A copy is stored next to the result, from
                which ``diagnosis.make_start_builder`` makes that cloth again.
        """
        folder, content = Path(folder), self.as_dict()
        folder.mkdir(parents=True, exist_ok=True)
        if start_model is not None:
            with write_atomically(folder / START_MODEL_FILE_NAME) as part:
                shutil.copyfile(start_model, part)
            content["model"] = content["model"] | {"start_model": START_MODEL_FILE_NAME}
        return write_text(folder / IDENTIFICATION_FILE_NAME, json.dumps(content, indent=1, allow_nan=False) + "\n")

    def apply(self, cloth: Cloth) -> Cloth:
        """Set the identified values in ``cloth``, leave the others as they are, and return it."""
        return set_identifiable(cloth, self.keys, self.parameters)


def nan_to_none(value: float) -> float | None:
    """Replace NaN, which stands for what was not measured, by None, which is null in JSON."""
    return None if math.isnan(value) else value


def set_identifiable(cloth: Cloth, keys: Mapping[str, str], parameters: Mapping[str, Estimate]) -> Cloth:
    """Set identified values in ``cloth`` and return it.

    Args:
        cloth: changed in place.
        keys: module path by parameter name.
        parameters: estimates by name.
    """
    for name, path in keys.items():
        if parameters[name].identifiable:
            cloth.get_submodule(path).set(parameters[name].value)  # type: ignore[operator]
    return cloth
