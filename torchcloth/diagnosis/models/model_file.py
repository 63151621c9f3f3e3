"""``*.tcm``: a base model, its fitted parameters and the causes it was extended by, as JSON and arrays in one zip file.

Nothing is pickled: a model is what its episode said of the cloth, plus numbers by name.
"""

from __future__ import annotations

import io
import json
import math
import zipfile
from collections.abc import Sequence
from dataclasses import replace
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from torch import Tensor

from ..._utils.files import write_atomically
from ...episodes.world import Model
from ...errors import InvalidInput
from ...recordings import GraspInfo, Recording
from ..causes.hypotheses import here, known
from ..unknown.residual_force import TERMS
from .base_model import base_model
from .model_content import ARRAYS, CONTENT, EXPECTED, FORMAT, damage, read_content

MESH = ("vertices", "faces", "uv")
SAME_FABRIC = 0.01  # relative difference of areal density that rounding explains


def save_model(
    path: Path,
    model: Model,
    recording: Recording,
    covariance: Tensor | None = None,
    residual: Model | None = None,
    episodes: Sequence[dict[str, Any]] = (),
) -> Path:
    """Write a model whose base is that of ``recording``, and the same with a residual force; returns the path.

    ``episodes`` are the marks (``recordings.marks.mark``) of those that it was fitted to.
    """
    cloth = recording.cloth
    facts: dict[str, Any] = {
        "areal_density": cloth.areal_density,
        "areal_density_std": cloth.areal_density_std,
        "thickness": cloth.thickness,
        "sheet": None if cloth.sheet is None else list(cloth.sheet),
        "nominal": cloth.nominal,
        "gravity": recording.gravity.tolist(),
        "grasps": {name: _grasp(g) for name, g in recording.grasps.items()},
        "colliders": {
            name: {"point": c.point.tolist(), "normal": c.normal.tolist(), "friction": c.friction}
            for name, c in recording.colliders.items()
        },
    }
    content = {
        "format": FORMAT,
        "torchcloth": metadata.version("torchcloth"),
        "cloth": facts,
        **_numbers(model),
        "residual": None if residual is None else _numbers(residual),
        "covariance": None if covariance is None else covariance.tolist(),
        "episodes": list(episodes),
    }
    arrays = {name: getattr(cloth, name) for name in MESH if getattr(cloth, name) is not None}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)  # type: ignore[arg-type]
    with write_atomically(Path(path)) as part, zipfile.ZipFile(part, "w") as file:
        file.writestr(CONTENT, json.dumps(content, indent=1, allow_nan=False, default=float))
        file.writestr(ARRAYS, buffer.getvalue())
    return Path(path)


def _numbers(model: Model) -> dict[str, Any]:
    values = zip(model.parameters, model.values.tolist(), strict=True)
    causes = zip(model.accepted, model.amplitudes, strict=True)
    return {
        "parameters": {p.name: {"coordinate": c, "value": p.value(c), "unit": p.unit} for p, c in values},
        "causes": [{"effect": h.name, "amplitude": a, "unit": h.unit} for h, a in causes],
    }


class ModelFile(NamedTuple):
    """What a file holds."""

    model: Model
    covariance: Tensor | None  # [P + A, P + A] of the model's coordinates
    episodes: list[dict[str, Any]]  # marks of those that it was fitted to
    scene: Recording  # what it was written with


def load_model(path: str | Path, residual: bool = True) -> Model:
    """A model that was written by ``save_model``; raises as ``read_model``."""
    return read_model(path, residual=residual).model


def read_model(path: str | Path, scene: Recording | None = None, residual: bool = True) -> ModelFile:
    """A model file; with a ``scene``, in that episode's mesh, grasps and tables.

    With its residual force, if it has one, unless that is left out; the covariance is that of all other numbers.

    Raises:
        InvalidInput: no such file, a cause that is not in the catalogue, or a scene with another fabric.
        RecordingError: a file that is damaged or no model.
    """
    path = Path(path)
    if not path.is_file():
        others = ", ".join(sorted(map(str, (path if path.is_dir() else path.parent).glob("*.tcm"))))
        remedy = f"name one: {others}" if others else "correct the path, or diagnose"
        raise InvalidInput("model", got=f"no file {path}", expected=EXPECTED, remedy=remedy)
    said = read_content(path)
    if scene is None:
        with damage(path):
            model = base_model(said.scene)
    else:
        model = base_model(of_fabric(path, said.scene, scene))
    numbers = said.residual if residual and said.residual is not None else said.numbers
    with damage(path):
        *_, values = (n.of(model.parameters) for n in (said.numbers, numbers))
        model = replace(model, values=values)
        covariance = said.covariance()
    model = _extended(path, model, numbers.causes)
    with damage(path):
        model.world()  # refuses numbers that no such parameter or effect can have
    return ModelFile(model, covariance, said.episodes, said.scene)


def of_fabric(path: str | Path, own: Recording, scene: Recording) -> Recording:
    """A scene with the data sheet that the model's coordinates are relative to.

    Raises:
        InvalidInput: it is of another fabric.
    """
    a, b = own.cloth, scene.cloth
    if not math.isclose(a.areal_density, b.areal_density, rel_tol=SAME_FABRIC):
        raise InvalidInput(
            f"{path}: a model of another fabric",
            got=f"an episode with {b.areal_density:.4g} kg/m^2",
            expected=f"{a.areal_density:.4g} kg/m^2",
            remedy="diagnose this cloth, or correct the episode's areal_density",
        )
    sheet = ("areal_density", "areal_density_std", "thickness", "nominal")
    return replace(scene, cloth=replace(b, **{name: getattr(a, name) for name in sheet}))


def _extended(path: Path, model: Model, causes: Sequence[tuple[str, float, str]]) -> Model:
    by_name = {h.name: h for h in (*known(), *TERMS)}
    for name, amplitude, unit in causes:
        if name not in by_name:
            raise InvalidInput(
                f"{path}: effect {name!r}",
                got="not in the catalogue",
                remedy="name the file that registers it (--causes FILE.py, diagnosis.register_file)",
            )
        if unit != by_name[name].unit:
            raise InvalidInput(
                f"{path}: unit of {name!r}",
                got=repr(unit),
                expected=repr(by_name[name].unit),
                remedy="register the cause as it was, or diagnose again",
            )
        model = model.plus(here(by_name[name], model), amplitude)
    return model


def _grasp(grasp: GraspInfo) -> dict[str, Any]:
    lists = {name: None if (v := getattr(grasp, name)) is None else v.tolist() for name in ("uv", "vertices")}
    return {**lists, "radius": grasp.radius}
