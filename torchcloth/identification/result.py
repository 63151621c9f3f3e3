"""What a fit says: numbers with their errors, distances before and after, and what to mistrust."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from torch import Tensor

from .._utils.files import atomically, write_text
from ..cloth import Cloth
from .uncertainty.estimates import Combination, Estimate, Influence, Profile

START = "start.tcm"  # beside identification.json: the model that a fit began with
CONVENTION = (
    "SI units. chamfer: one-sided, cloud to surface: mean over frames of the mean distance [m] from each measured "
    "point to the nearest point of the simulated triangles. rms: root mean square of the same distances over all "
    "points; both are null (JSON) where nothing was seen. null: the cloth moves rigidly with the grippers, undeformed, "
    "and its forces are zero. force_rms: root mean square distance [N] from all force readings; constant: of each "
    "gripper's mean reading. std: standard error of the estimate; noise "
    "correlated within patches of the fabric and nearby frames is allowed for, and the noise of a measured first shape "
    "where grippers hold, and the scatter between three or more episodes (among those that repeat each other by "
    "split.motion or split.replicate_of, and among all others), widened as Student's t, and the way left to a search "
    "cut short; "
    "persistent model error is not. ci95: in the log (logit) coordinate; linear, cut at 0, for amplitudes of effects "
    "and the cone; the profile's where there is one with both ends. identifiable: std below a "
    "quarter of the value (of a typical amplitude, where the amplitude is smaller), and the fit beats the null. "
    "source 'not in the model' or 'held fixed': value, std and ci95 are those of the prior. identifiability: how far "
    "one standard deviation of the prior and 10 % of the value move the cloth [mm] and its forces [N], rms. nuisances: "
    "what differs from episode to episode, [m], [s], [rad] or [N]."
)


@dataclass(frozen=True, eq=False)
class Identification:
    """The result of ``identify``.

    Attributes:
        parameters: estimates by name.
        fit: distances [m] before, after and for the null, counts, seconds.
        correlation: of the fitted parameters, name -> name -> correlation.
        warnings: what to mistrust, in sentences.
        history: one entry per iteration: chamfer [m] and parameter values.
        frames_before, frames_after, frames_null: [T, V, 3] m for each episode, as its observer sees them.
        influences: what the data can tell of each fitted parameter, and which experiment would tell more.
        combinations: of parameters, that the data determine together or leave open.
        nuisances: by episode, estimates of what is not the fabric's: clock, camera, first shape.
        profiles: of the parameters for which one was asked.
        forces_before, forces_after: gripper -> [T, 6] N, N m for each episode, as ``Episode.wrenches``.
        keys: module path by name of the fitted parameters.
        model: what else a repetition of the simulation needs (see ``saved``).
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
    influences: dict[str, Influence] = field(default_factory=dict)
    combinations: list[Combination] = field(default_factory=list)
    model: dict[str, Any] = field(default_factory=dict, repr=False)
    profiles: dict[str, Profile] = field(default_factory=dict)
    forces_before: list[dict[str, Tensor]] = field(default_factory=list, repr=False)
    forces_after: list[dict[str, Tensor]] = field(default_factory=list, repr=False)

    def as_dict(self) -> dict[str, Any]:
        """The content of identification.json."""
        return {
            "parameters": {name: asdict(estimate) for name, estimate in self.parameters.items()},
            "fit": {name: or_none(value) for name, value in self.fit.items()},
            "correlation": {a: {b: or_none(r) for b, r in row.items()} for a, row in self.correlation.items()},
            "identifiability": {name: asdict(influence) for name, influence in self.influences.items()},
            "combinations": [{"of": c.text, **asdict(c)} for c in self.combinations],
            "nuisances": {
                episode: {name: asdict(estimate) for name, estimate in own.items()}
                for episode, own in self.nuisances.items()
            },
            "profiles": {name: asdict(profile) for name, profile in self.profiles.items()},
            "convention": CONVENTION,
            "warnings": self.warnings,
            "history": [{name: or_none(value) for name, value in entry.items()} for entry in self.history],
            "model": self.model,
        }

    def save(self, folder: str | Path, begun: str | Path | None = None) -> Path:
        """Write identification.json into ``folder``, atomically; returns its path.

        ``begun`` is the .tcm file whose cloth was fitted, if it was one: a copy is kept beside it, from which
        ``diagnosis.start_of`` makes that cloth again.
        """
        folder, content = Path(folder), self.as_dict()
        folder.mkdir(parents=True, exist_ok=True)
        if begun is not None:
            with atomically(folder / START) as part:
                shutil.copyfile(begun, part)
            content["model"] = content["model"] | {"begun": START}
        return write_text(folder / "identification.json", json.dumps(content, indent=1, allow_nan=False) + "\n")

    def apply(self, cloth: Cloth) -> Cloth:
        """Set the fitted values in ``cloth``, leaving what is not identifiable as it is; returns it."""
        return set_identified(cloth, self.keys, self.parameters)


def or_none(value: float) -> float | None:
    """What was not measured is null in JSON."""
    return None if math.isnan(value) else value


def set_identified(cloth: Cloth, keys: Mapping[str, str], parameters: Mapping[str, Estimate]) -> Cloth:
    """Set what is identifiable in ``cloth``; ``keys``: parameter name -> module path."""
    for name, path in keys.items():
        if parameters[name].identifiable:
            cloth.get_submodule(path).set(parameters[name].value)  # type: ignore[operator]
    return cloth
