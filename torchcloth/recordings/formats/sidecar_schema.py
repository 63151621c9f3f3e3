"""The words of a scene file: a misspelt one is refused, where episode.json keeps what it does not know."""

from __future__ import annotations

from typing import Any

from ...errors import RecordingError
from ..scene import NOMINAL, NOTE

FREE = ("notes", "extra")  # and x_...: kept in the episode as they are
SCENE = [
    *("cloth", "grasps", "robots", "cameras", "colliders", "observation_noise", "clock_offset", "gravity", "air"),
    *("split", "provenance", "licence", "source", "format", "version"),
]
OBJECTS = {
    "cloth": ["mesh", "sheet", "initial_vertices", "areal_density", "areal_density_std", "thickness", "nominal"],
    "cloth.sheet": ["width", "height"],
    "cloth.nominal": [*NOMINAL, NOTE],
    "observation_noise": ["std"],
    "split": ["motion", "replicate_of"],
    "air": ["density"],
}
GROUPS = {  # of objects with names that the user chooses
    "grasps": ["uv", "radius", "vertices"],
    "robots": ["model", "T_world_base", "tool_frame"],
    "cameras": ["width", "height", "K", "T_world_camera", "distortion", "depth_scale"],
    "colliders": ["plane", "friction"],
}
PLANE = ["point", "normal"]


def check(values: dict[str, Any], name: str) -> None:
    """Refuse words that no scene has; values of another type are left to whoever reads them.

    Args:
        values: the scene.
        name: of its file, for messages.

    Raises:
        RecordingError: names the word and lists the known ones.
    """
    _known(values, SCENE, f"{name}: ")
    for path, words in OBJECTS.items():
        found: Any = values
        for key in path.split("."):
            found = found.get(key) if isinstance(found, dict) else None
        _known(found, words, f"{name}: {path}.")
    for group, words in GROUPS.items():
        named = values.get(group)
        for key, found in named.items() if isinstance(named, dict) else ():
            _known(found, words, f"{name}: {group}.{key}.")
            if group == "colliders" and isinstance(found, dict):
                _known(found.get("plane"), PLANE, f"{name}: {group}.{key}.plane.")


def _known(found: Any, words: list[str], place: str) -> None:
    for key in found if isinstance(found, dict) else ():
        if key not in words and key not in FREE and not key.startswith("x_"):
            expected = f"one of {', '.join(words)}"
            remedy = "correct its spelling; notes of your own go under notes, extra or x_..."
            raise RecordingError(f"{place}{key} is unknown", expected=expected, remedy=remedy)
