"""Known keys of a sidecar file: a typo is refused here, whereas episode.json preserves unknown keys."""

from __future__ import annotations

from typing import Any

from ...errors import RecordingError
from ..scene import NOMINAL_BOUNDS, NOMINAL_UNITS_KEY

FREE_KEYS = ("notes", "extra")  # and x_...: preserved in the episode
SIDECAR_KEYS = [
    *("cloth", "grasps", "robots", "cameras", "colliders", "observation_noise", "clock_offset", "gravity", "air"),
    *("split", "provenance", "licence", "source", "schema", "format", "version"),
]
OBJECT_KEYS = {
    "cloth": ["mesh", "sheet", "initial_vertices", "areal_density", "areal_density_std", "thickness", "nominal"],
    "cloth.sheet": ["width", "height"],
    "cloth.nominal": [*NOMINAL_BOUNDS, NOMINAL_UNITS_KEY],
    "observation_noise": ["std"],
    "split": ["motion", "replicate_of"],
    "air": ["density"],
}
NAMED_GROUP_KEYS = {  # of objects with names that the user chooses
    "grasps": ["uv", "radius", "vertices"],
    "robots": ["model", "T_world_base", "tool_frame"],
    "cameras": ["width", "height", "K", "T_world_camera", "distortion", "depth_scale"],
    "colliders": ["plane", "friction"],
}
PLANE_KEYS = ["point", "normal"]


def check_keys(values: dict[str, Any], name: str) -> None:
    """Refuse unknown keys of a sidecar; values of a wrong type are left to whoever reads them.

    Args:
        values: the sidecar.
        name: of its file, for messages.

    Raises:
        RecordingError: names the key and lists the known ones.
    """
    _check_known(values, SIDECAR_KEYS, f"{name}: ")
    for path, words in OBJECT_KEYS.items():
        entry: Any = values
        for key in path.split("."):
            entry = entry.get(key) if isinstance(entry, dict) else None
        _check_known(entry, words, f"{name}: {path}.")
    for group, words in NAMED_GROUP_KEYS.items():
        named = values.get(group)
        for key, entry in named.items() if isinstance(named, dict) else ():
            _check_known(entry, words, f"{name}: {group}.{key}.")
            if group == "colliders" and isinstance(entry, dict):
                _check_known(entry.get("plane"), PLANE_KEYS, f"{name}: {group}.{key}.plane.")


def _check_known(entry: Any, words: list[str], place: str) -> None:
    for key in entry if isinstance(entry, dict) else ():
        if key not in words and key not in FREE_KEYS and not key.startswith("x_"):
            expected = f"one of {', '.join(words)}"
            remedy = "correct its spelling; notes of your own go under notes, extra or x_..."
            raise RecordingError(f"{place}{key} is unknown", expected=expected, remedy=remedy)
