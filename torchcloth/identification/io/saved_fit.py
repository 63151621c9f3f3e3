"""A fit that was written to disk, as a cloth that can be simulated again."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...cloth import Cloth
from ...dynamics.contact import Contact
from ...episodes.observed import RATE, Episode, cloth_from, episode
from ...episodes.replay import Replay
from ...episodes.unknowns import available
from ...errors import InvalidInput, RecordingError, UnstableStep
from ...parameters import PhysicalParameter
from ...recordings import Recording
from ...recordings.consistency import together
from ...recordings.fingerprints import alike, mark
from ..residuals.metrics import figures
from ..result import Identification, or_none
from .result_files import number, read_result
from .unrecorded_settings import beyond

RESULT = "identification.json"
MOST = 100.0  # of the logarithm of a spread, which says nothing long before
Scene = Callable[[Recording], Cloth]  # the cloth that a fit began with, as an episode's
FRICTION = ".friction"  # of a table, behind its name
FAITHFUL = 0.02  # relative difference of Chamfer between the fit and its replay that other machines explain
ALIKE = 1e-3  # relative, of thicknesses
STIFFEST = 1e13  # in SI units: simulated, a fabric of more would take more steps than can be counted
FEW = 4  # names in a message
SHORTEST, FINEST = 1e-7, 1e-5  # s, m: no fit ends that takes such steps, or has such a contact grid


@dataclass(frozen=True, eq=False)
class Replayed:
    """An episode simulated with fitted values.

    Attributes:
        cloth: with all values set.
        episode: what it was driven by and is compared with.
        frames: [T, V, 3] m at ``episode.times``.
        chamfer: [frames with points] m, mean distance of each frame's measured points from the simulated surface.
        fitted: whether the fit used the episode; else this is a prediction.
        warning: when the distances are not those that the fit had; else empty.
    """

    cloth: Cloth
    episode: Episode
    frames: Tensor
    chamfer: Tensor
    fitted: bool
    warning: str


def model_of(cloth: Cloth, fit: Identification, recordings: Sequence[Recording], dt: float | None) -> dict[str, Any]:
    """What identification.json keeps, beside the estimates, so that ``replayed`` can repeat the simulation."""
    values = {name: _parameter(cloth, path).value.item() for name, path in available(cloth).items()}
    values |= {name: fit.parameters[name].value for name in fit.keys}
    faces = torch.as_tensor(cloth.mesh.faces)
    episodes = []
    for recording, frames in zip(recordings, fit.frames_after, strict=True):
        chamfer = figures([frames], [episode(cloth, recording)], faces).chamfer
        episodes.append({**mark(recording), "chamfer": or_none(chamfer)})
    contact = None if cloth.contact is None else asdict(cloth.contact)
    return {
        "values": values,
        "thickness": getattr(cloth.material, "thickness", None),
        "contact": contact,
        "dt": dt,
        "beyond": beyond(cloth, together(recordings)),
        "episodes": episodes,
    }


def replayed(path: str | Path, recording: Recording, begun: Scene | None = None) -> Replayed:
    """Simulate an episode with the values of a fit.

    Args:
        path: identification.json, or the folder that holds it.
        recording: one of the episodes that were fitted, or another of the same cloth.
        begun: of a fit that began with a .tcm file: ``diagnosis.start_of(path)``.

    Raises:
        InvalidInput: there is no such file, or the fit is of another model.
        RecordingError: the file cannot be read, or does not hold what is needed.
    """
    model = read_saved(path)
    own = mark(recording)
    before = [kept["chamfer"] for kept in model.episodes if alike(kept, own)]
    cloth = rebuilt(path, model, recording, begun)
    data = episode(cloth, recording, RATE)
    with torch.no_grad(), step_of(path):
        frames = Replay(cloth)(data, model.dt).x
    found = figures([frames], [data], torch.as_tensor(cloth.mesh.faces))
    warning = ""
    if before and abs(found.chamfer - before[0]) > FAITHFUL * before[0]:
        warning = (
            f"the simulation is {1e3 * found.chamfer:.2f} mm from the points, the fit was {1e3 * before[0]:.2f}: "
            "the fitted model had parts that the episode does not describe, or nuisances, which a replay leaves out"
        )
    return Replayed(cloth, data, frames, found.per_frame, bool(before), warning)


def fitted(
    path: str | Path, recording: Recording, begun: Scene | None = None
) -> tuple[Cloth, dict[str, tuple[float, float]]]:
    """The cloth of any episode with a fit's values, and what the fit leaves open of them.

    Args:
        path: identification.json, or the folder that holds it.
        recording: an episode of the same cloth, fitted or not.
        begun: as ``replayed``.

    Returns:
        The cloth, and by name of every fitted parameter (value, spread) as the ``priors`` of ``identify`` take it; the
        spread of what the data left open is hardly less than that of its prior.

    Raises:
        InvalidInput: there is no such file, or the fit is of another model.
        RecordingError: the file cannot be read, or does not hold what is needed.
    """
    model = read_saved(path)
    cloth = rebuilt(path, model, recording, begun)
    names, out = available(cloth), {}
    for name, std in model.stds.items():
        value = model.values[name]
        positive = name in names and _parameter(cloth, names[name]).domain == "positive"
        if name in names and std > 0:
            out[name] = (value, math.exp(min(std / value, MOST)) if positive else std)
    return cloth, out


@dataclass(frozen=True)
class SavedModel:
    """What identification.json says of a model and how well it is known.

    Attributes:
        values: by name, fitted or not.
        stds: standard errors of the fitted parameters, by name.
        beyond: names of what the fitted cloth has and its first episode does not describe.
        begun: whether the fit began with a .tcm file, which is kept beside it.
        correlation: [K, K] of the fitted parameters, in the order of ``stds``.
        thickness: m, with which moduli [Pa] were fitted; None: a file of before does not say.
        left: m, rms distance that the fit left in its own episodes; NaN where nothing was seen.
    """

    values: dict[str, float]
    stds: dict[str, float]
    beyond: list[str]
    begun: bool
    correlation: np.ndarray
    thickness: float | None
    left: float
    contact: Contact | None
    dt: float | None
    episodes: list[dict[str, Any]]


def read_saved(path: str | Path) -> SavedModel:
    """A saved fit: identification.json, or the folder that holds it.

    Raises:
        InvalidInput: there is no such file.
        RecordingError: it cannot be read, or does not hold what is needed.
    """
    expected = "parameters, correlation, fit and model, all numbers finite"
    return read_result(path, RESULT, _model, expected, "run `torchcloth identify` again")


def _value(name: str, kept: Any) -> float:
    if abs(found := number(kept, name=name)) > STIFFEST:
        raise ValueError(f"{name} {found:g}, beyond every fabric in SI units")
    return found


def _contact(**kept: Any) -> Contact:
    for name, least in {"spacing": FINEST, "subdivisions": 1, "damping": 0.0, "play": 0.0}.items():
        if kept.get(name) is not None:
            number(kept[name], least, f"contact {name}")
    if not isinstance(kept.get("subdivisions"), int | None) or not isinstance(kept.get("everywhere", False), bool):
        raise ValueError(f"contact {kept}")
    return Contact(**kept)


def _model(content: dict[str, Any]) -> SavedModel:
    model, said, correlation = (content[key] for key in ("model", "parameters", "correlation"))
    matrix = np.array([[number(row[name], -1.0) for name in correlation] for row in correlation.values()])
    if not len(matrix):
        raise ValueError("no fitted parameter in correlation")
    if (np.abs(matrix) > 1 + 1e-9).any() or not np.allclose(matrix, matrix.T) or not np.allclose(matrix.diagonal(), 1):
        raise ValueError("a correlation that is none")
    if unknown := correlation.keys() - model["values"].keys():
        raise ValueError(f"no value of {min(unknown)}")
    left = content["fit"]["rms_after"]
    return SavedModel(
        {str(name): _value(name, value) for name, value in model["values"].items()},
        {name: number(said[name]["std"], 0.0, f"{name}'s std") for name in correlation},
        [str(name) for name in model.get("beyond", ())],  # files of before do not say
        "begun" in model,
        matrix,
        None if (thickness := model.get("thickness")) is None else number(thickness, 0.0, "thickness"),
        math.nan if left is None else number(left, 0.0),
        None if model["contact"] is None else _contact(**model["contact"]),
        None if model["dt"] is None else number(model["dt"], SHORTEST, "dt"),
        [
            {"name": str(e["name"]), **{key: int(number(e[key], 0, key)) for key in ("frames", "points")}}
            | {
                "mean": np.array([number(x, name="mean") for x in e["mean"]]).reshape(3),
                "chamfer": math.nan if e["chamfer"] is None else number(e["chamfer"], 0.0),
            }
            for e in model["episodes"]
        ],
    )


def is_fitted(path: str | Path, recording: Recording) -> bool:
    """Whether the fit used this episode: then nothing about it is a prediction, nor new."""
    own = mark(recording)
    return any(alike(kept, own) for kept in read_saved(path).episodes)


def rebuilt(path: str | Path, model: SavedModel, recording: Recording, begun: Scene | None = None) -> Cloth:
    """The cloth that an episode describes, or that ``begun`` makes of it, at the fitted values.

    Raises:
        InvalidInput: it has other parameters than the fitted one, or that has more than its own episode describes.
        RecordingError: a value that no such parameter can have.
    """
    cloth = cloth_from(recording, contact=model.contact) if begun is None else begun(recording)
    own = getattr(cloth.material, "thickness", None)
    known = model.thickness
    if own is not None and known is not None and not math.isclose(own, known, rel_tol=ALIKE):
        raise InvalidInput(
            f"{path}: a fit of cloth of another thickness",
            got=f"{own:g} m in the episode, {known:g} m in the fit",
            expected="one thickness: moduli [Pa] times it are what a motion shows",
            remedy="correct cloth.thickness in episode.json (0.001 m where it says none), or fit this episode",
        )
    names = available(cloth)
    tables = {name for name in model.values if name.endswith(FRICTION)} - names.keys()  # of tables that are not there
    absent = {name for name in tables if name.removesuffix(FRICTION) not in recording.colliders}
    beyond = model.beyond if begun is None else ()
    if other := ((model.values.keys() - absent) ^ names.keys()) | set(beyond):
        begins = "from Python give begun=diagnosis.start_of(path)" if model.begun else "fit this episode"
        raise InvalidInput(
            f"{path}: a fit of another model",
            got=f"{_few(sorted(other))} not alike in both",
            expected="the model that the episode describes",
            remedy=begins,
        )
    for name in model.values.keys() - absent:
        value = model.values[name]
        try:
            _parameter(cloth, names[name]).set(value)
        except InvalidInput as error:
            raise RecordingError(f"{path}: {error}", remedy="run `torchcloth identify` again") from None
    return cloth


def _few(names: Sequence[str]) -> str:
    """As many as one reads."""
    more = len(names) - FEW
    return ", ".join(names[:FEW]) + (f" and {more} more" if more > 0 else "")


@contextmanager
def step_of(path: str | Path) -> Iterator[None]:
    """A step that is too long for an episode's mesh is the file's: nobody who reads one has chosen it."""
    try:
        yield
    except UnstableStep as error:
        remedy = "fit again without --dt, or with a smaller one"
        raise UnstableStep(f"{path}: dt", got=error.got, expected=error.expected, remedy=remedy) from None


def _parameter(cloth: Cloth, path: str) -> PhysicalParameter:
    return cloth.get_submodule(path)  # type: ignore[return-value]
