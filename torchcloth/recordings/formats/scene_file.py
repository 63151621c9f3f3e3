"""The scene file: what only the user knows of a recording, in the keys of episode.json."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ...errors import RecordingError
from .. import checks, reading, streams
from ..checks import Fields
from ..files import Folder
from ..images import ImageKind, ImageStream
from ..robot_files import locate_urdf_file
from ..types import Recording
from . import scene_file_keys
from .imported import Imported, ImportedCamera

CLOTH_EXAMPLE = '"cloth": {"sheet": {"width": 0.3, "height": 0.3}, "areal_density": 0.15, "thickness": 0.0005}'
PROVENANCE_EXAMPLE = '"provenance": "measured"'
CAMERA_MATRIX_EXAMPLE = '"K": [[fx,0,cx],[0,fy,cy],[0,0,1]]'
CAMERA_POSE_EXAMPLE = '"T_world_camera": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]'
CALIBRATION_TOLERANCE = 1e-3  # relative; two copies of one calibration differ by rounding only


class SceneFile:
    """Content of the scene file; without one it is empty, and messages say what to write.

    Besides the keys of episode.json it may contain ``source``: what each topic, column or track is.
    """

    def __init__(self, values: dict[str, Any], folder: Folder, name: str) -> None:
        self.values, self.folder, self.name = values, folder, name

    @classmethod
    def read(cls, path: Path | None) -> SceneFile:
        """Read a JSON file; None gives an empty scene file."""
        if path is None:
            return cls({}, Folder(Path()), "the scene (--scene FILE)")
        values = Folder(path.parent).read_json(path.name).remaining
        scene_file_keys.check_keys(values, str(path))
        return cls(values, Folder(path.parent), str(path))

    @property
    def source(self) -> Fields:
        """Mapping from the file's names to ours."""
        return Fields(self.values.get("source") or {}, f"{self.name}: source")

    def camera_entry(self, name: str) -> dict[str, Any]:
        """Return the entry of one camera."""
        return self._item("cameras", name)

    def depth_scale(self, name: str) -> float | None:
        """Return the unit [m] of a camera's depth images."""
        fields = Fields(self.camera_entry(name), f"{self.name}: cameras.{name}")
        return fields.optional(fields.number, "depth_scale", above=0, maximum=0.1, suspect="units per metre")

    def frame_pose(self, frame: str) -> np.ndarray:
        """Return the pose [4, 4] in the world of "world", a camera or a robot's base.

        Raises:
            RecordingError: the scene does not place it.
        """
        if frame == "world":
            return np.eye(4)
        for group, key in (("cameras", "T_world_camera"), ("robots", "T_world_base")):
            item = self._item(group, frame)
            if key in item:
                place = f"{self.name}: {group}.{frame}.{key}"
                matrix = checks.check_array(item[key], place, (4, 4))
                return checks.check_transform(matrix, place)
        expected = '"world", or a camera or robot that the scene places'
        raise RecordingError(f"{self.name}: frame {frame!r} is unknown", expected=expected)

    def _item(self, group: str, name: str) -> dict[str, Any]:
        """An object in a group; a value that is no object is refused later, with all others."""
        entries = self.values.get(group)
        entry = entries.get(name) if isinstance(entries, dict) else None
        return entry if isinstance(entry, dict) else {}

    def complete_recording(self, imported: Imported, path: Path) -> Recording:
        """Merge the imported file and the scene file into one checked recording; values that both give must agree."""
        values = {
            key: value for key, value in self.values.items() if key not in ("source", "schema", "format", "version")
        }
        self._check_camera_names(imported, path)
        self._require(values, imported, path)
        values["cameras"] = self._cameras(imported.cameras)
        values["robots"] = self._robots()
        values["source"] = imported.notes
        grippers, joints = streams.parse_motions(imported.motion, str(path))
        points = None if imported.points is None else streams.parse_points(imported.points, str(path))
        contents = {"grippers": grippers, "joints": joints, "points": points, **imported.streams}

        def images_of(name: str, size: tuple[int, int]) -> dict[ImageKind, ImageStream]:
            streams_by_kind = imported.cameras[name].streams if name in imported.cameras else {}
            for kind, stream in streams_by_kind.items():
                checks.check_increasing(stream.t, f"{path}: times of {name}/{kind}")
                if stream.size != size:
                    raise RecordingError(f"{path}: {name}/{kind} has another size", got=stream.size, expected=f"{size}")
            return streams_by_kind

        root = Fields(values, self.name, ": ")
        return reading.assemble_recording(root, self.folder, contents, images_of)

    def _check_camera_names(self, imported: Imported, path: Path) -> None:
        """A camera without images must be described in full; otherwise its name is a mistake."""
        cameras = self.values.get("cameras")
        for name in cameras if isinstance(cameras, dict) and imported.cameras else ():
            if name not in imported.cameras and not {"width", "height", "K"} <= self._item("cameras", name).keys():
                expected = f"one of {', '.join(imported.cameras)}, as in source"
                remedy = "rename it, or give its width, height and K"
                what = f"{self.name}: cameras.{name} has no images in {path}"
                raise RecordingError(what, expected=expected, remedy=remedy)

    def _require(self, values: dict[str, Any], imported: Imported, path: Path) -> None:
        """List in one message everything that neither the file nor the scene file contains."""
        missing_entries = [
            text for key, text in (("cloth", CLOTH_EXAMPLE), ("provenance", PROVENANCE_EXAMPLE)) if not values.get(key)
        ]
        missing_by_camera = {
            name: missing for name, c in imported.cameras.items() if (missing := self._missing_camera_entries(name, c))
        }
        if missing_by_camera:
            missing_entries.append(
                '"cameras": {'
                + ", ".join(f'"{name}": {{{", ".join(w)}}}' for name, w in missing_by_camera.items())
                + "}"
            )
        if missing_entries:
            remedy = "units m, kg/m^2; or cloth.mesh with an OBJ file beside it" if "cloth" not in values else ""
            what = f"{path} does not contain everything"
            raise RecordingError(what, expected=f"{self.name} with {{{', '.join(missing_entries)}}}", remedy=remedy)

    def _missing_camera_entries(self, name: str, camera: ImportedCamera) -> list[str]:
        """What neither the file nor the scene file contains of a camera."""
        entries = {**camera.calibration, **self.camera_entry(name)}
        pose = [] if camera.placed_by or "T_world_camera" in entries else [CAMERA_POSE_EXAMPLE]
        return pose if "K" in entries else [CAMERA_MATRIX_EXAMPLE, *pose]

    def _robots(self) -> Any:
        """Robots of the scene file; a URDF beside it is named by its whole path."""
        robots = self.values.get("robots")
        located = {}
        for name, entry in robots.items() if isinstance(robots, dict) else ():
            model = entry.get("model") if isinstance(entry, dict) else None
            file = locate_urdf_file(model, self.folder.path) if isinstance(model, str) else None
            located[name] = entry if file is None else {**entry, "model": str(file)}
        return located if isinstance(robots, dict) else robots

    def _cameras(self, imported: dict[str, ImportedCamera]) -> dict[str, Any]:
        """Cameras of the scene file and of the file; the file wins, and a contradiction is refused."""
        cameras = self.values.get("cameras") or {}
        merged = dict(cameras) if isinstance(cameras, dict) else {}
        for name, camera in imported.items():
            entry = self.camera_entry(name)
            for key, value in camera.calibration.items():
                if key in entry and not _agree(entry[key], value):
                    place, shown = f"{self.name}: cameras.{name}.{key}", np.array2string(np.asarray(value), precision=6)
                    raise RecordingError(
                        f"{place} contradicts the file", got=entry[key], expected=shown, remedy="leave it out"
                    )
            known = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in camera.calibration.items()}
            merged[name] = {**entry, **known}
        return merged


def _agree(a: Any, b: Any) -> bool:
    try:
        x, y = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    except (TypeError, ValueError, OverflowError):  # text, ragged lists, integers beyond any float
        return a == b
    if x.ndim == 1 and y.ndim == 1:  # trailing zeros of a distortion may be left out
        longest = max(len(x), len(y))
        x, y = (np.pad(v, (0, longest - len(v))) for v in (x, y))
    return x.shape == y.shape and bool(np.allclose(x, y, rtol=CALIBRATION_TOLERANCE, atol=CALIBRATION_TOLERANCE * 1e-2))
