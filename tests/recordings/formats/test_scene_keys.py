"""A misspelt word of a scene is refused with the list of the known ones; episode.json keeps what it does not know."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from helpers import foreign_formats

from torchcloth import recordings as rec
from torchcloth.errors import RecordingError
from torchcloth.recordings import formats
from torchcloth.recordings.formats import scene_file_keys

GRASP = {"uv": [[0.0, 0.2]], "radius": 0.012}
PLANE = {"point": [0, 0, 0], "normal": [0, 0, 1]}
WRONG = {
    "top": ({"cloht": {}}, "scene.json: cloht is unknown; expected one of cloth, grasps"),
    "camera": ({"cameras": {"cam0": {"distorsion": [0.1]}}}, "cameras.cam0.distorsion is unknown; .*distortion"),
    "cloth": ({"cloth": {"thicknes": 5e-4}}, "cloth.thicknes is unknown; .*thickness"),
    "sheet": ({"cloth": {"sheet": {"width": 0.3, "hight": 0.2}}}, "cloth.sheet.hight is unknown; .*width, height"),
    "grasp": ({"grasps": {"left": GRASP | {"raduis": 1}}}, "grasps.left.raduis is unknown; .*uv, radius"),
    "robot": ({"robots": {"arm": {"modell": "x"}}}, "robots.arm.modell is unknown; expected one of model"),
    "collider": ({"colliders": {"table": {"plane": PLANE, "frction": 1}}}, "colliders.table.frction is unknown"),
    "plane": ({"colliders": {"table": {"plane": {"norml": [0, 0, 1]}}}}, "table.plane.norml is unknown"),
    "noise": ({"observation_noise": {"sdt": 1e-3}}, "observation_noise.sdt is unknown; expected one of std"),
    "split": ({"split": {"motoin": "swing"}}, "split.motoin is unknown; expected one of motion, replicate_of"),
    "hand": ({"source": {"closed": True}}, "source.closed is unknown; expected one of camera, trajectory"),
    "air": ({"air": {"densty": 1.2}}, "air.densty is unknown; expected one of density"),
    "source": ({"source": {"camra": "cam0"}}, "source.camra is unknown; expected one of camera, trajectory"),
}


@pytest.fixture(scope="module")
def tum(tmp_path_factory):
    return foreign_formats.write_tum(tmp_path_factory.mktemp("tum"))


def scene(folder: Path, values: dict) -> Path:
    file = folder / "scene.json"
    file.write_text(json.dumps(values))
    return file


@pytest.mark.parametrize("case", WRONG)
def test_a_misspelt_word(tum, tmp_path, case):
    values, match = WRONG[case]
    with pytest.raises(RecordingError, match=match):
        formats.read(tum.path, scene=scene(tmp_path, tum.scene | values))


def test_notes_of_ones_own_are_kept(tum, tmp_path):
    cameras = {"cam0": tum.scene["cameras"]["cam0"] | {"x_serial": "A17"}}
    read = formats.read(tum.path, scene=scene(tmp_path, tum.scene | {"cameras": cameras, "notes": "a blue towel"}))
    episode = rec.read(rec.write(read, tmp_path / "ep"))
    assert episode.extra["notes"] == "a blue towel"
    assert episode.cameras["cam0"].extra == {"x_serial": "A17"}


def test_every_word_of_an_episode_is_known(tum, tmp_path):
    """What torchcloth itself writes, it also takes as a scene."""
    written = rec.write(formats.read(tum.path, scene=scene(tmp_path, tum.scene)), tmp_path / "ep")
    scene_file_keys.check_keys(json.loads((written / "episode.json").read_text()), "episode.json")


def test_names_of_cameras_must_match(tum, tmp_path):
    values = tum.scene | {"cameras": {"kamera": tum.scene["cameras"]["cam0"]}}
    with pytest.raises(RecordingError, match=r"cameras.kamera has no images in .*; expected one of cam0"):
        formats.read(tum.path, scene=scene(tmp_path, values))


def test_the_camera_matrix_is_asked_for(tum, tmp_path):
    with pytest.raises(RecordingError, match=r'"cameras": \{"cam0": \{"K": \[\[fx,0,cx\],\[0,fy,cy\],\[0,0,1\]\]\}\}'):
        formats.read(tum.path)


def test_a_grasp_without_motion(tum, tmp_path):
    match = r"scene\.json: grasps\.left has no motion.*leave the grasp out; in a scene, say in source what moves it"
    with pytest.raises(RecordingError, match=match):
        formats.read(tum.path, scene=scene(tmp_path, tum.scene | {"grasps": {"left": GRASP}}))


def test_what_is_not_there_is_said_once(tmp_path):
    with pytest.raises(RecordingError) as caught:
        formats.read(tmp_path / "nope")
    assert str(caught.value).count("expected a recording") == 1
