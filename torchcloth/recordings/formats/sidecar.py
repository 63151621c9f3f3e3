"""The side file: what only the user knows of a recording, in the words of episode.json."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ...errors import RecordingError
from .. import checks, reading, streams
from ..checks import Fields
from ..files import Folder
from ..images import ImageStream, Kind
from ..types import Recording
from . import sidecar_schema
from .imported import Imported, ImportedCamera

CLOTH = '"cloth": {"sheet": {"width": 0.3, "height": 0.3}, "areal_density": 0.15, "thickness": 0.0005}'
PROVENANCE = '"provenance": "measured"'
MATRIX = '"K": [[fx,0,cx],[0,fy,cy],[0,0,1]]'
POSE = '"T_world_camera": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]'
AGREE = 1e-3  # relative, or in metres and pixels: a calibration written twice differs by rounding only


class Scene:
    """What the side file says; without one it is empty, and messages say what to write.

    Beside the words of episode.json it may hold ``source``: which topic, column or track is what.
    """

    def __init__(self, values: dict[str, Any], folder: Folder, name: str) -> None:
        self.values, self.folder, self.name = values, folder, name

    @classmethod
    def read(cls, path: Path | None) -> Scene:
        """Read a JSON file; None gives an empty scene."""
        if path is None:
            return cls({}, Folder(Path()), "the scene (--scene FILE)")
        values = Folder(path.parent).json(path.name).rest
        sidecar_schema.check(values, str(path))
        return cls(values, Folder(path.parent), str(path))

    @property
    def source(self) -> Fields:
        """The mapping from the file's names to ours."""
        return Fields(self.values.get("source") or {}, f"{self.name}: source")

    def camera(self, name: str) -> dict[str, Any]:
        """What it says of one camera."""
        return self._item("cameras", name)

    def depth_scale(self, name: str) -> float | None:
        """The unit [m] of a camera's depth images."""
        fields = Fields(self.camera(name), f"{self.name}: cameras.{name}")
        return fields.maybe(fields.number, "depth_scale", above=0, most=0.1, suspect="units per metre")

    def transform(self, frame: str) -> np.ndarray:
        """The pose [4, 4] in the world of "world", a camera or a robot's base.

        Raises:
            RecordingError: the scene does not place it.
        """
        if frame == "world":
            return np.eye(4)
        for group, key in (("cameras", "T_world_camera"), ("robots", "T_world_base")):
            item = self._item(group, frame)
            if key in item:
                place = f"{self.name}: {group}.{frame}.{key}"
                matrix = checks.array(item[key], place, (4, 4))
                return checks.transform(matrix, place)
        expected = '"world", or a camera or robot that the scene places'
        raise RecordingError(f"{self.name}: frame {frame!r} is unknown", expected=expected)

    def _item(self, group: str, name: str) -> dict[str, Any]:
        """An object in a group; what is none is refused later, with all others."""
        every = self.values.get(group)
        found = every.get(name) if isinstance(every, dict) else None
        return found if isinstance(found, dict) else {}

    def complete(self, imported: Imported, path: Path) -> Recording:
        """Put the file and the scene together into one checked recording; where both speak they must agree."""
        values = {key: value for key, value in self.values.items() if key not in ("source", "format", "version")}
        self._refuse_strangers(imported, path)
        self._require(values, imported, path)
        values["cameras"] = self._cameras(imported.cameras)
        values["source"] = imported.notes
        grippers, joints = streams.motions(imported.motion, str(path))
        points = None if imported.points is None else streams.points(imported.points, str(path))
        held = {"grippers": grippers, "joints": joints, "points": points, **imported.held}

        def images_of(name: str, size: tuple[int, int]) -> dict[Kind, ImageStream]:
            found = imported.cameras[name].streams if name in imported.cameras else {}
            for kind, stream in found.items():
                checks.increasing(stream.t, f"{path}: times of {name}/{kind}")
                if stream.size != size:
                    raise RecordingError(f"{path}: {name}/{kind} has another size", got=stream.size, expected=f"{size}")
            return found

        root = Fields(values, self.name, ": ")
        return reading.assemble(root, self.folder, held, images_of)

    def _refuse_strangers(self, imported: Imported, path: Path) -> None:
        """A camera that has no images must be described in full; else its name is a mistake."""
        cameras = self.values.get("cameras")
        for name in cameras if isinstance(cameras, dict) and imported.cameras else ():
            if name not in imported.cameras and not {"width", "height", "K"} <= self._item("cameras", name).keys():
                expected = f"one of {', '.join(imported.cameras)}, as in source"
                remedy = "rename it, or give its width, height and K"
                what = f"{self.name}: cameras.{name} has no images in {path}"
                raise RecordingError(what, expected=expected, remedy=remedy)

    def _require(self, values: dict[str, Any], imported: Imported, path: Path) -> None:
        """Say at once everything that the file cannot tell and the scene does not."""
        lacks = [text for key, text in (("cloth", CLOTH), ("provenance", PROVENANCE)) if not values.get(key)]
        lost = {name: said for name, c in imported.cameras.items() if (said := self._lost(name, c))}
        if lost:
            lacks.append('"cameras": {' + ", ".join(f'"{name}": {{{", ".join(w)}}}' for name, w in lost.items()) + "}")
        if lacks:
            remedy = "units m, kg/m^2; or cloth.mesh with an OBJ file beside it" if "cloth" not in values else ""
            what = f"{path} does not tell everything"
            raise RecordingError(what, expected=f"{self.name} with {{{', '.join(lacks)}}}", remedy=remedy)

    def _lost(self, name: str, camera: ImportedCamera) -> list[str]:
        """What neither the file nor the scene says of a camera."""
        said = {**camera.known, **self.camera(name)}
        pose = [] if camera.placed_by or "T_world_camera" in said else [POSE]
        return pose if "K" in said else [MATRIX, *pose]

    def _cameras(self, found: dict[str, ImportedCamera]) -> dict[str, Any]:
        """Cameras of the scene and of the file; what the file says wins, a contradiction is refused."""
        cameras = self.values.get("cameras") or {}
        merged = dict(cameras) if isinstance(cameras, dict) else {}
        for name, camera in found.items():
            said = self.camera(name)
            for key, value in camera.known.items():
                if key in said and not _agree(said[key], value):
                    place, shown = f"{self.name}: cameras.{name}.{key}", np.array2string(np.asarray(value), precision=6)
                    raise RecordingError(
                        f"{place} contradicts the file", got=said[key], expected=shown, remedy="leave it out"
                    )
            known = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in camera.known.items()}
            merged[name] = {**said, **known}
        return merged


def _agree(a: Any, b: Any) -> bool:
    try:
        x, y = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    except (TypeError, ValueError, OverflowError):  # words, ragged lists, whole numbers beyond any float
        return a == b
    if x.ndim == 1 and y.ndim == 1:  # trailing zeros of a distortion may be left out
        longest = max(len(x), len(y))
        x, y = (np.pad(v, (0, longest - len(v))) for v in (x, y))
    return x.shape == y.shape and bool(np.allclose(x, y, rtol=AGREE, atol=AGREE * 1e-2))
