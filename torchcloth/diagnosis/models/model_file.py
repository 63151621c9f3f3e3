"""``*.tcm``: a base model, its fitted parameters and its causes, as JSON and arrays in one zip file.

Nothing is pickled: a model is what its episode states about the cloth, and numbers by name.
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
from ...episodes.world import WorldModel
from ...errors import InvalidInput
from ...recordings import GraspInfo, Recording
from ..causes.hypotheses import adapt_hypothesis, list_known_hypotheses
from ..unknown.residual_force import RESIDUAL_HYPOTHESES
from .base_model import build_base_model
from .model_content import (
    ARRAYS_FILE,
    CONTENT_FILE,
    EXPECTED_FILE,
    FORMAT_VERSION,
    read_content,
    reporting_damage,
)

MESH_ARRAYS = ("vertices", "faces", "uv")
SAME_DENSITY_TOLERANCE = 0.01  # relative difference of areal densities that rounding explains


def save_model(
    path: Path,
    model: WorldModel,
    recording: Recording,
    covariance: Tensor | None = None,
    residual: WorldModel | None = None,
    episodes: Sequence[dict[str, Any]] = (),
) -> Path:
    """Write a model file, and return its path.

    Args:
        path: of the file.
        model: a model whose base is that of ``recording``.
        recording: states the cloth and its scene.
        covariance: [P + A, P + A] of the model's coordinates.
        residual: the same model with a residual force.
        episodes: fingerprints of the episodes that it was fitted to (``recordings.fingerprints.fingerprint``).
    """
    cloth = recording.cloth
    facts: dict[str, Any] = {
        "areal_density": cloth.areal_density,
        "areal_density_std": cloth.areal_density_std,
        "thickness": cloth.thickness,
        "layer_gap": cloth.layer_gap,
        "sheet": None if cloth.sheet is None else list(cloth.sheet),
        "nominal": cloth.nominal,
        "gravity": recording.gravity.tolist(),
        "grasps": {name: _write_grasp(g) for name, g in recording.grasps.items()},
        "colliders": {
            name: {"point": c.point.tolist(), "normal": c.normal.tolist(), "friction": c.friction}
            for name, c in recording.colliders.items()
        },
    }
    content = {
        "format": FORMAT_VERSION,
        "torchcloth": metadata.version("torchcloth"),
        "cloth": facts,
        **_write_numbers(model),
        "residual": None if residual is None else _write_numbers(residual),
        "covariance": None if covariance is None else covariance.tolist(),
        "episodes": list(episodes),
    }
    arrays = {name: getattr(cloth, name) for name in MESH_ARRAYS if getattr(cloth, name) is not None}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)  # type: ignore[arg-type]
    with write_atomically(Path(path)) as part, zipfile.ZipFile(part, "w") as file:
        file.writestr(CONTENT_FILE, json.dumps(content, indent=1, allow_nan=False, default=float))
        file.writestr(ARRAYS_FILE, buffer.getvalue())
    return Path(path)


def _write_numbers(model: WorldModel) -> dict[str, Any]:
    values = zip(model.parameters, model.coordinates.tolist(), strict=True)
    causes = zip(model.accepted, model.amplitudes, strict=True)
    return {
        "parameters": {p.name: {"coordinate": c, "value": p.value(c), "unit": p.unit} for p, c in values},
        "causes": [{"effect": h.name, "amplitude": a, "unit": h.unit} for h, a in causes],
    }


class ModelFile(NamedTuple):
    """A model file.

    Attributes:
        model: the model.
        covariance: [P + A, P + A] of the model's coordinates, without a residual force.
        episodes: fingerprints of the episodes that it was fitted to.
        scene: the episode's scene that it was written with.
    """

    model: WorldModel
    covariance: Tensor | None
    episodes: list[dict[str, Any]]
    scene: Recording


def load_model(path: str | Path, residual: bool = True) -> WorldModel:
    """Load a model that ``save_model`` wrote; raises as ``read_model``."""
    return read_model(path, residual=residual).model


def read_model(path: str | Path, scene: Recording | None = None, residual: bool = True) -> ModelFile:
    """Read a model file.

    Args:
        path: of the file.
        scene: an episode whose mesh, grasps and tables the model takes; None: those that it was written with.
        residual: whether to keep a residual force, whose numbers have no covariance.

    Raises:
        InvalidInput: no such file, a cause that is not in the catalogue, or a scene with another fabric.
        RecordingError: a file that is damaged or no model.
    """
    path = Path(path)
    if not path.is_file():
        others = ", ".join(sorted(map(str, (path if path.is_dir() else path.parent).glob("*.tcm"))))
        remedy = f"name one: {others}" if others else "correct the path, or diagnose"
        raise InvalidInput("model", got=f"no file {path}", expected=EXPECTED_FILE, remedy=remedy)
    content = read_content(path)
    if scene is None:
        with reporting_damage(path):
            model = build_base_model(content.scene)
    else:
        model = build_base_model(adopt_data_sheet(path, content.scene, scene))
    numbers = content.residual if residual and content.residual is not None else content.numbers
    with reporting_damage(path):
        content.numbers.order_as(model.parameters)
        coordinates = numbers.order_as(model.parameters)
        model = replace(model, coordinates=coordinates)
        covariance = content.covariance()
    model = _add_causes(path, model, numbers.causes)
    with reporting_damage(path):
        model.build_world()  # raises for values that no such parameter or effect can have
    return ModelFile(model, covariance, content.episodes, content.scene)


def adopt_data_sheet(path: str | Path, model_scene: Recording, scene: Recording) -> Recording:
    """Return a scene with the data sheet that a model's coordinates are relative to.

    Args:
        path: of the model file, for messages.
        model_scene: scene that the model was written with.
        scene: the scene to change.

    Raises:
        InvalidInput: a scene with another fabric.
    """
    a, b = model_scene.cloth, scene.cloth
    if not math.isclose(a.areal_density, b.areal_density, rel_tol=SAME_DENSITY_TOLERANCE):
        raise InvalidInput(
            f"{path}: a model of another fabric",
            got=f"an episode with {b.areal_density:.4g} kg/m^2",
            expected=f"{a.areal_density:.4g} kg/m^2",
            remedy="diagnose this cloth, or correct the episode's areal_density",
        )
    sheet = ("areal_density", "areal_density_std", "thickness", "layer_gap", "nominal")
    return replace(scene, cloth=replace(b, **{name: getattr(a, name) for name in sheet}))


def _add_causes(path: Path, model: WorldModel, causes: Sequence[tuple[str, float, str]]) -> WorldModel:
    by_name = {h.name: h for h in (*list_known_hypotheses(), *RESIDUAL_HYPOTHESES)}
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
        model = model.with_hypothesis(adapt_hypothesis(by_name[name], model), amplitude)
    return model


def _write_grasp(grasp: GraspInfo) -> dict[str, Any]:
    lists = {name: None if (v := getattr(grasp, name)) is None else v.tolist() for name in ("uv", "vertices")}
    return {**lists, "radius": grasp.radius}
