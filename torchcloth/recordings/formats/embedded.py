"""Content of an MCAP file by torchcloth besides the standard messages: its own scene, and small files.

/torchcloth/scene (std_msgs/String) is episode.json with the mapping of the topics; /torchcloth/files
(std_msgs/UInt8MultiArray, the label of its first dimension is the name) holds cloth.obj, cloth_initial.npy,
cloth_velocities.npy, markers.npz, truth.npz, and extra.npz with the arrays for which no standard message has a place.
"""

from __future__ import annotations

import json

from ...errors import RecordingError
from .. import streams
from ..files import Folder
from .bag import Bag
from .imported import Imported, report_damage
from .ros2_topics import SCENE_TOPIC
from .scene_file import SceneFile

FILES_TOPIC = "/torchcloth/files"
EXTRA_ARRAYS_FILE = "extra.npz"


def adopt_scene_file(scene: SceneFile, bag: Bag) -> None:
    """Take the scene that the bag carries.

    Raises:
        RecordingError: the user gave another scene.
    """
    if scene.values:
        raise RecordingError(f"{bag.path} carries its own scene", got=scene.name, remedy="leave --scene out")
    files = {}
    for message in bag.messages([SCENE_TOPIC, FILES_TOPIC]):
        with report_damage(message.place, "part of an episode"):
            if message.topic == SCENE_TOPIC:
                scene.values = dict(json.loads(message.body.data))
            else:
                files[message.body.layout.dim[0].label] = bytes(message.body.data)
    scene.name = f"{bag.path}: {SCENE_TOPIC}"
    scene.folder = Folder(bag.path, in_memory=files)


def restore_files(imported: Imported, scene: SceneFile) -> Imported:
    """Add the streams that lie in small files."""
    folder = scene.folder
    if EXTRA_ARRAYS_FILE in folder.in_memory:
        for key, value in folder.read_npz(EXTRA_ARRAYS_FILE).items():
            group, _, last = key.partition("/")
            holder = imported.points
            if group == "motion":
                name, _, last = last.partition("/")
                holder = imported.motion.get(name)
            if holder is None:
                raise RecordingError(f"{folder.location(EXTRA_ARRAYS_FILE)}: {key} belongs to nothing")
            holder[last] = value
    if streams.MARKERS_FILE in folder.in_memory:
        imported.streams["markers"] = streams.read_markers(folder)
    if streams.TRUTH_FILE in folder.in_memory:
        imported.streams["truth"] = streams.read_truth(folder)
    return imported
