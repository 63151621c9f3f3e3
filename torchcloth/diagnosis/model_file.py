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
import torch
from torch import Tensor

from .._files import atomically
from ..errors import InvalidInput, RecordingError
from ..recordings import ClothInfo, Collider, GraspInfo, Recording
from .base_model import base_model
from .hypotheses import known
from .residual import TERMS
from .world import Model

FORMAT = 1
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

    ``episodes`` are the marks (``identification.saved.mark``) of those that it was fitted to.
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
    with atomically(Path(path)) as part, zipfile.ZipFile(part, "w") as file:
        file.writestr("model.json", json.dumps(content, indent=1, allow_nan=False))
        file.writestr("mesh.npz", buffer.getvalue())
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
        raise InvalidInput("model", got=f"no file {path}", expected="a .tcm file of `torchcloth diagnose`")
    try:
        with zipfile.ZipFile(path) as file:
            content = json.loads(file.read("model.json"))
            with np.load(io.BytesIO(file.read("mesh.npz"))) as arrays:
                mesh = {name: arrays[name] for name in arrays.files}
        if content["format"] != FORMAT:
            raise RecordingError(
                f"{path}: format {content['format']}", expected=f"{FORMAT}", remedy="update torchcloth"
            )
        own = _recording(content["cloth"], mesh)
        numbers = (content.get("residual") if residual else None) or content
        coordinates = {name: float(p["coordinate"]) for name, p in numbers["parameters"].items()}
        causes = [(str(c["effect"]), float(c["amplitude"])) for c in numbers["causes"]]
        matrix, episodes = content["covariance"], list(content.get("episodes", ()))
    except (zipfile.BadZipFile, KeyError, TypeError, ValueError, OSError) as error:
        got = "no archive" if isinstance(error, zipfile.BadZipFile) else f"{type(error).__name__}: {error}"
        raise RecordingError(f"{path}: unreadable", got=got, expected="a .tcm file of `torchcloth diagnose`") from None
    model = base_model(own if scene is None else of_fabric(path, own, scene))
    values = torch.tensor([coordinates[p.name] for p in model.parameters], dtype=torch.float64)
    model = _extended(path, replace(model, values=values), causes)
    return ModelFile(model, None if matrix is None else torch.tensor(matrix, dtype=torch.float64), episodes, own)


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


def _extended(path: Path, model: Model, causes: Sequence[tuple[str, float]]) -> Model:
    by_name = {h.name: h for h in (*known(), *TERMS)}
    for name, amplitude in causes:
        if name not in by_name:
            raise InvalidInput(
                f"{path}: effect {name!r}",
                got="not in the catalogue",
                remedy="name the file that registers it (--causes FILE.py, diagnosis.register_file)",
            )
        model = model.plus(by_name[name], amplitude)
    return model


def _grasp(grasp: GraspInfo) -> dict[str, Any]:
    lists = {name: None if (v := getattr(grasp, name)) is None else v.tolist() for name in ("uv", "vertices")}
    return {**lists, "radius": grasp.radius}


def _recording(facts: dict[str, Any], mesh: dict[str, np.ndarray]) -> Recording:
    array = lambda v: None if v is None else np.asarray(v)  # noqa: E731
    cloth = ClothInfo(
        areal_density=facts["areal_density"],
        areal_density_std=facts["areal_density_std"],
        thickness=facts["thickness"],
        sheet=None if facts["sheet"] is None else tuple(facts["sheet"]),
        nominal=facts["nominal"],
        vertices=mesh.get("vertices"),
        faces=mesh.get("faces"),
        uv=mesh.get("uv"),
    )
    grasps = {
        name: GraspInfo(uv=array(g["uv"]), radius=g["radius"], vertices=array(g["vertices"]))
        for name, g in facts["grasps"].items()
    }
    colliders = {
        name: Collider(np.asarray(c["point"]), np.asarray(c["normal"]), c["friction"])
        for name, c in facts["colliders"].items()
    }
    return Recording(
        cloth=cloth, provenance="model file", grasps=grasps, colliders=colliders, gravity=np.asarray(facts["gravity"])
    )
