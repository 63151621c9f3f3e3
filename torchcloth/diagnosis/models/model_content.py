"""Content of a ``.tcm`` file, checked when it is read: any error becomes a message of one line."""

from __future__ import annotations

import reprlib
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..._utils.unpacking import check_archive
from ...episodes.recorded_cloth import build_effects, build_material, build_mesh
from ...episodes.world import BaseParameter
from ...errors import RecordingError, TorchclothError
from ...recordings import ClothInfo, Collider, Recording, checks, scene
from ...recordings.checks import Fields
from ...recordings.files import Folder

FORMAT_VERSION = 2  # version 1 had base models without stiffening
CONTENT_FILE, ARRAYS_FILE = "model.json", "mesh.npz"
EXPECTED_FILE = "a .tcm file of `torchcloth diagnose`"
REPAIR_REMEDY = "run `torchcloth diagnose` again, or restore the file"
MAX_COORDINATE = 14.0  # of logarithms and small fractions: no fabric is a million times its data sheet


@contextmanager
def reporting_damage(path: Path) -> Iterator[None]:
    """Report errors inside the block as damage of the file, with a remedy."""
    try:
        yield
    except TorchclothError as error:
        what = error.what if error.what.startswith(str(path)) else f"{path}: {error.what}"
        raise RecordingError(what, got=error.got, expected=error.expected, remedy=REPAIR_REMEDY) from None


class ModelNumbers(NamedTuple):
    """Numbers of a model's parameters and causes.

    Attributes:
        file: name of the file, for messages.
        place: place in the file, for messages.
        coordinates: coordinate of each parameter.
        causes: (effect, amplitude, unit) of each cause.
    """

    file: str
    place: str
    coordinates: dict[str, float]
    causes: list[tuple[str, float, str]]

    def order_as(self, parameters: Sequence[BaseParameter]) -> Tensor:
        """Return [P] the coordinates in the order of a model's parameters.

        Raises:
            RecordingError: other parameters, or values that no fabric has.
        """
        names = [p.name for p in parameters]
        if unmatched := self.coordinates.keys() ^ set(names):
            got = f"{', '.join(sorted(unmatched))} in only one of the file and its cloth"
            raise RecordingError(self.place, got=got, expected=", ".join(names))
        unlimited = {p.name for p in parameters if not p.value(0.0)}
        for name, value in self.coordinates.items():
            if abs(value) > MAX_COORDINATE and name not in unlimited:
                got, expected = f"a coordinate of {value:g}", f"within {MAX_COORDINATE:g} of the data sheet's 0"
                raise RecordingError(f"{self.place}.{name}", got=got, expected=expected)
        return torch.tensor([self.coordinates[name] for name in names], dtype=torch.float64)


class ModelContent(NamedTuple):
    """Content of a model file.

    Attributes:
        scene: the episode's scene that it was written with.
        numbers: parameters and causes.
        residual: the same with the residual force; None without one.
        matrix: [P + A, P + A] covariance of ``numbers``.
        episodes: fingerprints of the episodes that the model was fitted to.
    """

    scene: Recording
    numbers: ModelNumbers
    residual: ModelNumbers | None
    matrix: np.ndarray | None
    episodes: list[dict[str, Any]]

    def covariance(self) -> Tensor | None:
        """Return the covariance of the numbers; None if it is not known.

        Raises:
            RecordingError: a covariance of another size.
        """
        if self.matrix is None:
            return None
        size = len(self.numbers.coordinates) + len(self.numbers.causes)
        return torch.as_tensor(checks.check_array(self.matrix, f"{self.numbers.file}: covariance", (size, size)))


def read_content(path: Path) -> ModelContent:
    """Read a model file.

    Raises:
        RecordingError: a file that is damaged, no model, or of another version.
    """
    folder = _open(path)
    with reporting_damage(path):
        fields = folder.read_json(CONTENT_FILE)
        version = fields.take("format")
    if version != FORMAT_VERSION:
        remedy = REPAIR_REMEDY if version == 1 else "update torchcloth"
        raise RecordingError(f"{path}: format", got=reprlib.repr(version), expected=f"{FORMAT_VERSION}", remedy=remedy)
    with reporting_damage(path):
        arrays = Fields(folder.read_npz(ARRAYS_FILE), folder.location(ARRAYS_FILE), ": ")
        recorded = _read_scene(fields.group("cloth"), arrays)
        for build in (build_mesh, build_material, build_effects):  # each raises for invalid input
            build(recorded)
        numbers = _read_numbers(fields)
        return ModelContent(
            recorded,
            numbers,
            _read_numbers(fields.group("residual")) if fields.has("residual") else None,
            fields.optional(_read_covariance, "covariance", fields),
            [_read_fingerprint(f) for f in _list_objects(fields, "episodes")] if fields.has("episodes") else [],
        )


def _open(path: Path) -> Folder:
    try:
        with zipfile.ZipFile(path) as file:
            members = (CONTENT_FILE, ARRAYS_FILE)
            check_archive(file, path.stat().st_size, str(path), members)
            return Folder(path, in_memory={name: file.read(name) for name in members})
    except TorchclothError:
        raise
    except Exception as error:  # a damaged archive can raise almost anything: zlib, struct, memory
        raise RecordingError(f"{path}: unreadable", got=str(error) or repr(error), expected=EXPECTED_FILE) from None


def _read_scene(facts: Fields, arrays: Fields) -> Recording:
    sheet = facts.optional(facts.array, "sheet", 2)
    mesh: dict[str, Any] = {}
    if sheet is None or arrays.remaining:
        mesh = {"vertices": arrays.array("vertices", "V", 3), "faces": arrays.array("faces", "F", 3, kind="int")}
        flat = np.ndim(arrays.remaining.get("uv", 0.0)) == 2
        mesh["uv"] = arrays.optional(arrays.array, "uv", *(("V", 2) if flat else ("F", 3, 2)))  # or of sewn panels
    cloth = ClothInfo(
        **scene.read_fabric(facts), sheet=None if sheet is None else (float(sheet[0]), float(sheet[1])), **mesh
    )
    return Recording(
        cloth=cloth,
        provenance="model file",
        grasps={name: scene.read_grasp(grasp) for name, grasp in facts.named_groups("grasps").items()},
        colliders={name: _read_collider(table) for name, table in facts.named_groups("colliders").items()},
        gravity=facts.array("gravity", 3),
    )


def _read_collider(fields: Fields) -> Collider:
    point, normal = fields.array("point", 3), fields.array("normal", 3)
    checks.normalise_unit(normal, fields.location("normal"))
    return Collider(point, normal, fields.optional(fields.number, "friction", minimum=0))


def _read_numbers(fields: Fields) -> ModelNumbers:
    coordinates = {name: row.number("coordinate") for name, row in fields.named_groups("parameters").items()}
    causes = [(c.text("effect"), c.number("amplitude"), c.text("unit")) for c in _list_objects(fields, "causes")]
    return ModelNumbers(fields.place, fields.location("parameters"), coordinates, causes)


def _read_covariance(key: str, fields: Fields) -> np.ndarray:
    matrix = fields.array(key, "N", "N")
    if (matrix.diagonal() < 0).any():
        raise RecordingError(f"{fields.location(key)} has a negative variance", got=f"{matrix.diagonal().min():g}")
    return matrix


def _read_fingerprint(fields: Fields) -> dict[str, Any]:
    counts = {key: int(fields.number(key, minimum=0)) for key in ("frames", "points")}
    return {"name": fields.text("name"), **counts, "mean": fields.array("mean", 3).tolist()}


def _list_objects(fields: Fields, key: str) -> list[Fields]:
    values = fields.take(key)
    if not isinstance(values, list):
        raise RecordingError(f"{fields.location(key)} is not a list", got=reprlib.repr(values))
    return [Fields(value, f"{fields.location(key)}[{k}]") for k, value in enumerate(values)]
