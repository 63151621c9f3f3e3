"""What an MCAP file written by torchcloth carries beside the standard messages: its own scene, and small files.

/torchcloth/scene (std_msgs/String) is episode.json with the mapping of the topics; /torchcloth/files
(std_msgs/UInt8MultiArray, the label of its first dimension is the name) holds cloth.obj, cloth_initial.npy,
markers.npz, truth.npz, and extra.npz with the arrays that no standard message has a place for.
"""

from __future__ import annotations

import json

from ...errors import RecordingError
from .. import streams
from ..files import Folder
from .bag import Bag
from .imported import Imported, damaged
from .sidecar import Scene

SCENE, FILES = "/torchcloth/scene", "/torchcloth/files"
EXTRA = "extra.npz"


def adopt(scene: Scene, bag: Bag) -> None:
    """Take the scene that the bag carries."""
    if scene.values:
        raise RecordingError(f"{bag.path} carries its own scene", got=scene.name, remedy="leave --scene out")
    held = {}
    for message in bag.messages([SCENE, FILES]):
        with damaged(message.place, "part of an episode"):
            if message.topic == SCENE:
                scene.values = dict(json.loads(message.body.data))
            else:
                held[message.body.layout.dim[0].label] = bytes(message.body.data)
    scene.name = f"{bag.path}: {SCENE}"
    scene.folder = Folder(bag.path, held=held)


def restore(found: Imported, scene: Scene) -> Imported:
    """Add the streams that lie in small files."""
    folder = scene.folder
    if EXTRA in folder.held:
        for key, value in folder.npz(EXTRA).items():
            group, _, last = key.partition("/")
            holder = found.points
            if group == "motion":
                name, _, last = last.partition("/")
                holder = found.motion.get(name)
            if holder is None:
                raise RecordingError(f"{folder.place(EXTRA)}: {key} belongs to nothing")
            holder[last] = value
    if streams.MARKERS in folder.held:
        found.held["markers"] = streams.markers(folder)
    if streams.TRUTH in folder.held:
        found.held["truth"] = streams.truth(folder)
    return found
