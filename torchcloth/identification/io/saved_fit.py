"""Restore a fit from disk as a cloth that can be simulated again."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...cloth import Cloth
from ...dynamics.contact import Contact
from ...episodes.observed import DEFAULT_FRAME_RATE_HZ, Episode, build_episode
from ...episodes.recorded_cloth import build_cloth
from ...episodes.replay import Replay
from ...episodes.unknowns import find_scalar_parameters
from ...errors import InvalidInput, RecordingError, UnstableStep
from ...inspection.corrections import check_recording
from ...parameters import PhysicalParameter
from ...recordings import Recording
from ...recordings.consistency import merge_scene
from ...recordings.fingerprints import fingerprint, same_episode
from ...schemas import check_structure
from ..residuals.metrics import distance_metrics
from ..result import IDENTIFICATION_FILE_NAME, IDENTIFICATION_SCHEMA, Identification, nan_to_none
from .result_files import check_number, read_result
from .unrecorded_settings import find_unrecorded_settings

ClothBuilder = Callable[[Recording], Cloth]  # builds the cloth that a fit began with, for an episode

MAX_LOG_SPREAD = 100.0  # of a prior's factor, which says nothing long before
REPLAY_RELATIVE_TOLERANCE = 0.02  # difference of the Chamfer distance from the fit's that other machines explain
THICKNESS_RELATIVE_TOLERANCE = 1e-3
MAX_PARAMETER_VALUE = 1e13  # in SI units; a stiffer fabric would take more steps than can be counted
MIN_STEP_S = 1e-7  # no fit ends that takes shorter steps
MIN_CONTACT_SPACING_M = 1e-5  # no fit ends with a finer contact grid
MAX_NAMES_IN_MESSAGE = 4
FRICTION_SUFFIX = ".friction"  # of a table's parameter, after the table's name
FIT_AGAIN_REMEDY = "run `torchcloth identify` again"


@dataclass(frozen=True, eq=False)
class ReplayedEpisode:
    """An episode simulated with fitted values.

    Attributes:
        cloth: with all values set.
        episode: what drives it, and what it is compared with.
        frames: [T, V, 3] m at ``episode.times``.
        chamfer: [frames with points] m, mean distance of each frame's measured points from the simulated surface.
        was_fitted: whether the fit used the episode; else this is a prediction.
        warning: that the distances are not those of the fit. Empty where they are.
    """

    cloth: Cloth
    episode: Episode
    frames: Tensor
    chamfer: Tensor
    was_fitted: bool
    warning: str


def describe_model(
    cloth: Cloth,
    fit: Identification,
    recordings: Sequence[Recording],
    corrected: Sequence[Recording],
    dt: float | None,
) -> dict[str, Any]:
    """Return the entry "model" of identification.json, with which ``replay_fit`` can repeat the simulation.

    Args:
        cloth: where the fit began.
        fit: the result.
        recordings: the episodes.
        corrected: the same after the checks, as they were fitted.
        dt: largest substep [s].
    """
    values = {name: _parameter(cloth, path).value.item() for name, path in find_scalar_parameters(cloth).items()}
    values |= {name: fit.parameters[name].value for name in fit.keys}
    faces = torch.as_tensor(cloth.mesh.faces)
    episodes = []
    for recording, used, frames in zip(recordings, corrected, fit.frames_after, strict=True):
        chamfer = distance_metrics([frames], [build_episode(cloth, used)], faces).chamfer
        episodes.append({**fingerprint(recording), "chamfer": nan_to_none(chamfer)})
    return {
        "values": values,
        "thickness": getattr(cloth.material, "thickness", None),
        "contact": None if cloth.contact is None else asdict(cloth.contact),
        "dt": dt,
        "unrecorded_settings": find_unrecorded_settings(cloth, merge_scene(recordings)),
        "episodes": episodes,
    }


def replay_fit(
    path: str | Path, recording: Recording, build_start: ClothBuilder | None = None, *, at_start: bool = False
) -> ReplayedEpisode:
    """Simulate an episode with the values of a fit.

    Args:
        path: identification.json, or the folder that holds it.
        recording: one of the fitted episodes, or another of the same cloth.
        build_start: for a fit that began with a .tcm file: ``diagnosis.make_start_builder(path)``.
        at_start: simulate with the values that the search started from instead of the fitted ones.

    Raises:
        InvalidInput: there is no such file, or the fit is of another model.
        RecordingError: the file cannot be read, or does not hold what is needed.
    """
    fit = read_saved_fit(path)
    if at_start:
        fit = replace(fit, values=fit.values | fit.start_values)
    recording_fingerprint = fingerprint(recording)
    fitted_chamfers = [e["chamfer"] for e in fit.episodes if same_episode(e, recording_fingerprint)]
    cloth = rebuild_fitted_cloth(path, fit, recording, build_start)
    data = build_episode(cloth, check_recording(recording).recording, DEFAULT_FRAME_RATE_HZ)
    with torch.no_grad(), explain_unstable_step(path):
        frames = Replay(cloth)(data, fit.dt).x
    metrics = distance_metrics([frames], [data], torch.as_tensor(cloth.mesh.faces))
    warning = ""
    if fitted_chamfers and not at_start:
        before = fitted_chamfers[0]
        if abs(metrics.chamfer - before) > REPLAY_RELATIVE_TOLERANCE * before:
            warning = (
                f"the simulation is {1e3 * metrics.chamfer:.2f} mm from the points, the fit was {1e3 * before:.2f}: "
                "the fitted model had parts that the episode does not describe, or nuisances, which a replay leaves out"
            )
    return ReplayedEpisode(cloth, data, frames, metrics.per_frame, bool(fitted_chamfers), warning)


def load_fitted_cloth(
    path: str | Path, recording: Recording, build_start: ClothBuilder | None = None
) -> tuple[Cloth, dict[str, tuple[float, float]]]:
    """Build the cloth of an episode with a fit's values, and priors for another fit.

    Args:
        path: identification.json, or the folder that holds it.
        recording: an episode of the same cloth, fitted or not.
        build_start: as in ``replay_fit``.

    Returns:
        The cloth, and by name of every fitted parameter (value, spread), as the ``priors`` of ``identify`` take it. The
        spread of a parameter that the data left open is hardly narrower than its prior.

    Raises:
        InvalidInput: there is no such file, or the fit is of another model.
        RecordingError: the file cannot be read, or does not hold what is needed.
    """
    fit = read_saved_fit(path)
    cloth = rebuild_fitted_cloth(path, fit, recording, build_start)
    paths, priors = find_scalar_parameters(cloth), {}
    for name, std in fit.stds.items():
        value = fit.values[name]
        is_positive = name in paths and _parameter(cloth, paths[name]).domain == "positive"
        if name in paths and std > 0:
            priors[name] = (value, math.exp(min(std / value, MAX_LOG_SPREAD)) if is_positive else std)
    return cloth, priors


@dataclass(frozen=True)
class SavedFit:
    """The model in identification.json, and how well it is known.

    Attributes:
        values: by name, fitted or not.
        start_values: of the fitted parameters, where the search started.
        stds: standard errors of the fitted parameters, by name.
        unrecorded_settings: names of settings of the fitted cloth that its first episode does not describe.
        has_start_model: whether the fit began with a .tcm file, a copy of which lies in the same folder.
        unidentified: names of the fitted parameters whose values are no estimates.
        correlation: [K, K] of the fitted parameters, in the order of ``stds``.
        thickness: m, with which moduli [Pa] were fitted; None: the material has none.
        misfit_rms: m, rms distance that the fit left in its own episodes; NaN where there were no points.
        contact: between layers, or None.
        dt: largest substep [s]; None: the stable one.
        episodes: fingerprints of the fitted episodes, each with its Chamfer distance [m].
    """

    values: dict[str, float]
    start_values: dict[str, float]
    stds: dict[str, float]
    unrecorded_settings: list[str]
    has_start_model: bool
    unidentified: tuple[str, ...]
    correlation: np.ndarray
    thickness: float | None
    misfit_rms: float
    contact: Contact | None
    dt: float | None
    episodes: list[dict[str, Any]]


def read_saved_fit(path: str | Path) -> SavedFit:
    """Read a saved fit: identification.json, or the folder that holds it.

    Raises:
        InvalidInput: there is no such file.
        RecordingError: it cannot be read, has another schema, or does not hold what is needed.
    """
    expected = "parameters, correlation, fit and model, all numbers finite"
    return read_result(path, IDENTIFICATION_FILE_NAME, IDENTIFICATION_SCHEMA, _parse_fit, expected, FIT_AGAIN_REMEDY)


def _parse_value(name: str, content: Any) -> float:
    if abs(value := check_number(content, name=name)) > MAX_PARAMETER_VALUE:
        raise ValueError(f"{name} {value:g}, beyond every fabric in SI units")
    return value


def _parse_contact(**content: Any) -> Contact:
    minima = {"spacing": MIN_CONTACT_SPACING_M, "subdivisions": 1, "damping": 0.0, "free_compression": 0.0}
    for name, minimum in minima.items():
        if content.get(name) is not None:
            check_number(content[name], minimum, f"contact {name}")
    if not isinstance(content.get("subdivisions"), int | None):
        raise ValueError(f"contact {content}")
    if not isinstance(content.get("everywhere", False), bool):
        raise ValueError(f"contact {content}")
    return Contact(**content)


def _parse_fit(content: dict[str, Any]) -> SavedFit:
    check_structure(content, "identification")
    model, parameters, correlation = (content[key] for key in ("model", "parameters", "correlation"))
    matrix = np.array([[check_number(row[name], -1.0) for name in correlation] for row in correlation.values()])
    if not len(matrix):
        raise ValueError("no fitted parameter in correlation")
    if (np.abs(matrix) > 1 + 1e-9).any() or not np.allclose(matrix, matrix.T) or not np.allclose(matrix.diagonal(), 1):
        raise ValueError("a correlation that is none")
    if unknown := correlation.keys() - model["values"].keys():
        raise ValueError(f"no value of {min(unknown)}")
    misfit, thickness = content["fit"]["rms_after"], model["thickness"]
    return SavedFit(
        values={str(name): _parse_value(name, value) for name, value in model["values"].items()},
        start_values={name: _parse_value(name, parameters[name]["initial"]) for name in correlation},
        stds={name: check_number(parameters[name]["std"], 0.0, f"{name}'s std") for name in correlation},
        unrecorded_settings=[str(name) for name in model["unrecorded_settings"]],
        has_start_model="start_model" in model,
        unidentified=tuple(name for name in correlation if parameters[name].get("identifiable") is False),
        correlation=matrix,
        thickness=None if thickness is None else check_number(thickness, 0.0, "thickness"),
        misfit_rms=math.nan if misfit is None else check_number(misfit, 0.0),
        contact=None if model["contact"] is None else _parse_contact(**model["contact"]),
        dt=None if model["dt"] is None else check_number(model["dt"], MIN_STEP_S, "dt"),
        episodes=[
            {"name": str(e["name"]), **{key: int(check_number(e[key], 0, key)) for key in ("frames", "points")}}
            | {
                "mean": np.array([check_number(x, name="mean") for x in e["mean"]]).reshape(3),
                "chamfer": math.nan if e["chamfer"] is None else check_number(e["chamfer"], 0.0),
            }
            for e in model["episodes"]
        ],
    )


def is_fitted_episode(path: str | Path, recording: Recording) -> bool:
    """Tell whether the fit used this episode: then nothing about it is a prediction."""
    recording_fingerprint = fingerprint(recording)
    return any(same_episode(e, recording_fingerprint) for e in read_saved_fit(path).episodes)


def rebuild_fitted_cloth(
    path: str | Path, fit: SavedFit, recording: Recording, build_start: ClothBuilder | None = None
) -> Cloth:
    """Build the cloth that an episode describes, or that ``build_start`` makes of it, with the fitted values.

    Raises:
        InvalidInput: it has other parameters than the fitted one, or that has more than its own episode describes.
        RecordingError: a value that no such parameter can have.
    """
    cloth = build_cloth(recording, contact=fit.contact) if build_start is None else build_start(recording)
    thickness = getattr(cloth.material, "thickness", None)
    is_same = (
        thickness is None
        or fit.thickness is None
        or math.isclose(thickness, fit.thickness, rel_tol=THICKNESS_RELATIVE_TOLERANCE)
    )
    if not is_same:
        raise InvalidInput(
            f"{path}: a fit of cloth of another thickness",
            got=f"{thickness:g} m in the episode, {fit.thickness:g} m in the fit",
            expected="one thickness: moduli [Pa] times it are what a motion shows",
            remedy="correct cloth.thickness in episode.json (0.001 m where it says none), or fit this episode",
        )
    paths = find_scalar_parameters(cloth)
    missing_friction = {name for name in fit.values if name.endswith(FRICTION_SUFFIX)} - paths.keys()
    absent_tables = {name for name in missing_friction if name.removesuffix(FRICTION_SUFFIX) not in recording.colliders}
    unrecorded = set(fit.unrecorded_settings) if build_start is None else set()
    if different := ((fit.values.keys() - absent_tables) ^ paths.keys()) | unrecorded:
        with_start = "from Python give build_start=diagnosis.make_start_builder(path)"
        raise InvalidInput(
            f"{path}: a fit of another model",
            got=f"{_list_first(sorted(different))} not alike in both",
            expected="the model that the episode describes",
            remedy=with_start if fit.has_start_model else "fit this episode",
        )
    for name in fit.values.keys() - absent_tables:
        try:
            _parameter(cloth, paths[name]).set(fit.values[name])
        except InvalidInput as error:
            raise RecordingError(f"{path}: {error}", remedy=FIT_AGAIN_REMEDY) from None
    return cloth


def _list_first(names: Sequence[str]) -> str:
    more = len(names) - MAX_NAMES_IN_MESSAGE
    return ", ".join(names[:MAX_NAMES_IN_MESSAGE]) + (f" and {more} more" if more > 0 else "")


@contextmanager
def explain_unstable_step(path: str | Path) -> Iterator[None]:
    """Turn a step that is too long into an error about the file, whose reader has not chosen the step."""
    try:
        yield
    except UnstableStep as error:
        remedy = "fit again without --dt, or with a smaller one"
        raise UnstableStep(f"{path}: dt", got=error.got, expected=error.expected, remedy=remedy) from None


def _parameter(cloth: Cloth, path: str) -> PhysicalParameter:
    return cloth.get_submodule(path)  # type: ignore[return-value]
