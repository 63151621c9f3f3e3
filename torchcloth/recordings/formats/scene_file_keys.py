"""Known keys of a scene file, from the schema of episode.json.

A typo is refused here, whereas episode.json preserves unknown keys.
"""

from __future__ import annotations

from typing import Any

from ...errors import RecordingError
from ...schemas import list_keys

FREE_KEYS = ("notes", "extra")  # and x_...: preserved in the episode
SOURCE_KEY = "source"  # of a scene file only: which topics, columns and files are what
OBJECT_PATHS = ("cloth", "cloth.sheet", "cloth.nominal", "observation_noise", "split", "air")
NAMED_GROUPS = ("grasps", "robots", "cameras", "colliders")  # of objects with names that the user chooses


def check_keys(values: dict[str, Any], name: str) -> None:
    """Refuse unknown keys of a scene file; values of a wrong type are left to whoever reads them.

    Args:
        values: the scene file.
        name: of its file, for messages.

    Raises:
        RecordingError: names the key and lists the known ones.
    """
    _check_known(values, [*list_keys("episode"), SOURCE_KEY], f"{name}: ")
    for path in OBJECT_PATHS:
        entry: Any = values
        for key in path.split("."):
            entry = entry.get(key) if isinstance(entry, dict) else None
        _check_known(entry, list_keys("episode", *path.split(".")), f"{name}: {path}.")
    for group in NAMED_GROUPS:
        named, words = values.get(group), list_keys("episode", group, "*")
        for key, entry in named.items() if isinstance(named, dict) else ():
            _check_known(entry, words, f"{name}: {group}.{key}.")
            if group == "colliders" and isinstance(entry, dict):
                plane_keys = list_keys("episode", group, "*", "plane")
                _check_known(entry.get("plane"), plane_keys, f"{name}: {group}.{key}.plane.")


def _check_known(entry: Any, words: list[str], place: str) -> None:
    for key in entry if isinstance(entry, dict) else ():
        if key not in words and key not in FREE_KEYS and not key.startswith("x_"):
            expected = f"one of {', '.join(words)}"
            remedy = "correct its spelling; notes of your own go under notes, extra or x_..."
            raise RecordingError(f"{place}{key} is unknown", expected=expected, remedy=remedy)
