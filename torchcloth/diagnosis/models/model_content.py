"""What a ``.tcm`` file says, checked where it is read: whatever is wrong with it becomes one line."""

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

from ...episodes.observed import build_effects, build_material, build_mesh
from ...episodes.world import Parameter
from ...errors import RecordingError, TorchclothError
from ...recordings import ClothInfo, Collider, Recording, checks, scene
from ...recordings.checks import Fields
from ...recordings.files import Folder

FORMAT = 2  # 1: of base models without stiffening
CONTENT, ARRAYS = "model.json", "mesh.npz"
EXPECTED, AGAIN = "a .tcm file of `torchcloth diagnose`", "run `torchcloth diagnose` again, or restore the file"
FARTHEST = 14.0  # of logarithms and small shares: no fabric is a million times what its data sheet says


@contextmanager
def damage(path: Path) -> Iterator[None]:
    """What is wrong inside the block is wrong with the file: it is named, and so is the way to a good one."""
    try:
        yield
    except TorchclothError as error:
        what = error.what if error.what.startswith(str(path)) else f"{path}: {error.what}"
        raise RecordingError(what, got=error.got, expected=error.expected, remedy=AGAIN) from None


class Numbers(NamedTuple):
    """Of a model's parameters and causes, by name."""

    file: str  # for messages, like the place in it
    place: str
    coordinates: dict[str, float]
    causes: list[tuple[str, float, str]]

    def of(self, parameters: Sequence[Parameter]) -> Tensor:
        """[P] coordinates in the order of a model's parameters.

        Raises:
            RecordingError: they are of other parameters, or not of this world.
        """
        names = [p.name for p in parameters]
        if other := self.coordinates.keys() ^ set(names):
            got = f"{', '.join(sorted(other))} in only one of the file and its cloth"
            raise RecordingError(self.place, got=got, expected=", ".join(names))
        plain = {p.name for p in parameters if not p.value(0.0)}
        for name, value in self.coordinates.items():
            if abs(value) > FARTHEST and name not in plain:
                got, expected = f"a coordinate of {value:g}", f"within {FARTHEST:g} of the data sheet's 0"
                raise RecordingError(f"{self.place}.{name}", got=got, expected=expected)
        return torch.tensor([self.coordinates[name] for name in names], dtype=torch.float64)


class Content(NamedTuple):
    """Of a file."""

    scene: Recording  # what it was written with
    numbers: Numbers
    residual: Numbers | None  # likewise, with the residual force
    matrix: np.ndarray | None  # [P + A, P + A], covariance of ``numbers``
    episodes: list[dict[str, Any]]  # marks of those that it was fitted to

    def covariance(self) -> Tensor | None:
        """Of the numbers, when these are known to be a model's.

        Raises:
            RecordingError: it is of others.
        """
        if self.matrix is None:
            return None
        size = len(self.numbers.coordinates) + len(self.numbers.causes)
        return torch.as_tensor(checks.array(self.matrix, f"{self.numbers.file}: covariance", (size, size)))


def read_content(path: Path) -> Content:
    """All that a file says.

    Raises:
        RecordingError: it is damaged, or no model, or of another version.
    """
    folder = _opened(path)
    with damage(path):
        fields = folder.json(CONTENT)
        found = fields.take("format")
    if found != FORMAT:
        remedy = AGAIN if found == 1 else "update torchcloth"
        raise RecordingError(f"{path}: format", got=reprlib.repr(found), expected=f"{FORMAT}", remedy=remedy)
    with damage(path):
        own = _scene(fields.inside("cloth"), Fields(folder.npz(ARRAYS), folder.place(ARRAYS), ": "))
        for part in (build_mesh, build_material, build_effects):  # they refuse what is none, also where another takes its place
            part(own)
        numbers = _numbers(fields)
        return Content(
            own,
            numbers,
            _numbers(fields.inside("residual")) if fields.has("residual") else None,
            fields.maybe(_covariance, "covariance", fields),
            [_mark(mark) for mark in _objects(fields, "episodes")] if fields.has("episodes") else [],
        )


def _opened(path: Path) -> Folder:
    try:
        with zipfile.ZipFile(path) as file:
            return Folder(path, held={name: file.read(name) for name in (CONTENT, ARRAYS)})
    except Exception as error:  # a damaged archive can raise almost anything: zlib, struct, memory
        raise RecordingError(f"{path}: unreadable", got=str(error) or repr(error), expected=EXPECTED) from None


def _scene(facts: Fields, arrays: Fields) -> Recording:
    sheet = facts.maybe(facts.array, "sheet", 2)
    mesh: dict[str, Any] = {}
    if sheet is None or arrays.rest:
        mesh = {"vertices": arrays.array("vertices", "V", 3), "faces": arrays.array("faces", "F", 3, kind="int")}
        flat = np.ndim(arrays.rest.get("uv", 0.0)) == 2
        mesh["uv"] = arrays.maybe(arrays.array, "uv", *(("V", 2) if flat else ("F", 3, 2)))  # or of sewn panels
    cloth = ClothInfo(
        **scene.fabric(facts), sheet=None if sheet is None else (float(sheet[0]), float(sheet[1])), **mesh
    )
    return Recording(
        cloth=cloth,
        provenance="model file",
        grasps={name: scene.grasp(grasp) for name, grasp in facts.each("grasps").items()},
        colliders={name: _collider(table) for name, table in facts.each("colliders").items()},
        gravity=facts.array("gravity", 3),
    )


def _collider(fields: Fields) -> Collider:
    point, normal = fields.array("point", 3), fields.array("normal", 3)
    checks.unit(normal, fields.at("normal"))
    return Collider(point, normal, fields.maybe(fields.number, "friction", least=0))


def _numbers(fields: Fields) -> Numbers:
    coordinates = {name: said.number("coordinate") for name, said in fields.each("parameters").items()}
    causes = [(c.text("effect"), c.number("amplitude"), c.text("unit")) for c in _objects(fields, "causes")]
    return Numbers(fields.place, fields.at("parameters"), coordinates, causes)


def _covariance(key: str, fields: Fields) -> np.ndarray:
    matrix = fields.array(key, "N", "N")
    if (matrix.diagonal() < 0).any():
        raise RecordingError(f"{fields.at(key)} has a negative variance", got=f"{matrix.diagonal().min():g}")
    return matrix


def _mark(fields: Fields) -> dict[str, Any]:
    counts = {key: int(fields.number(key, least=0)) for key in ("frames", "points")}
    return {"name": fields.text("name"), **counts, "mean": fields.array("mean", 3).tolist()}


def _objects(fields: Fields, key: str) -> list[Fields]:
    found = fields.take(key)
    if not isinstance(found, list):
        raise RecordingError(f"{fields.at(key)} is not a list", got=reprlib.repr(found))
    return [Fields(value, f"{fields.at(key)}[{k}]") for k, value in enumerate(found)]
