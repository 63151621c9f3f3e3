"""Output folders."""

from __future__ import annotations

from pathlib import Path

from ..errors import InvalidInput


def check_folder(path: Path) -> None:
    """Refuse, before any work is done, a folder that cannot be made.

    Raises:
        InvalidInput: the path, or what should be a folder above it, is a file.
    """
    for part in (path, *path.parents):
        if part.exists():
            if not part.is_dir():
                raise InvalidInput("--out", got=f"{part}, a file", expected="a folder, new or existing")
            return
