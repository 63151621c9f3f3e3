"""Atomic writing of files, JSON text, and checks of output folders."""

from __future__ import annotations

import errno
import io
import json
import math
import os
import tempfile
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from ..errors import InvalidInput

PROGRESS_FOLDER_NAME = "progress"  # within an output folder, while the work is not done
DISK_FULL_ERROR_NUMBERS = (errno.ENOSPC, errno.EFBIG, errno.EDQUOT)


@contextmanager
def write_atomically(path: Path) -> Iterator[Path]:
    """Yield a temporary path next to ``path``: renamed to ``path`` when the block ends well, removed otherwise."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.stem}.{uuid.uuid4().hex}{path.suffix}")
    try:
        try:
            yield part
            with part.open("rb") as file:
                os.fsync(file.fileno())
            os.replace(part, path)
        finally:
            part.unlink(missing_ok=True)
    except OSError as error:
        is_full = error.filename is None and error.errno in DISK_FULL_ERROR_NUMBERS
        if is_full or str(error.filename) == str(part):  # the user does not know the temporary name
            error.filename, error.filename2 = str(path), None
        raise


def save_tensors(content: Any, path: Path) -> Path:
    """Write tensors with ``torch.save`` so that a crash leaves the old file or the new, never half; returns its path.

    Raises:
        OSError: the disk is full; ``torch.save`` alone raises an error of its own that does not say so.
    """
    buffer = io.BytesIO()
    torch.save(content, buffer)
    with write_atomically(path) as part:
        part.write_bytes(buffer.getbuffer())
    return path


def write_text(path: Path, text: str) -> Path:
    """Write a text file so that a crash leaves the old content or the new, never half; returns its path."""
    with write_atomically(path) as part:
        part.write_text(text, encoding="utf-8")
    return path


def save_figure(figure: Any, path: Path) -> Path:
    """Write a matplotlib figure as PNG so that a crash leaves the old one or the new, never half."""
    with write_atomically(path) as part:
        figure.savefig(part, dpi=110, bbox_inches="tight")
    return path


def to_json(content: Any) -> str:
    """Return the JSON text of a result; numbers that are not finite become null."""
    return json.dumps(_finite(content), indent=1, allow_nan=False) + "\n"


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(v) for key, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def check_output_folder(path: Path, option: str = "--out") -> None:
    """Check that a folder can be made and written to, before any work is done; leave nothing behind.

    Raises:
        InvalidInput: the path or one of its parents is a file, or the system does not allow to write there.
    """
    plain = Path(os.path.abspath(path))
    above = next(part for part in (plain, *plain.parents) if os.path.lexists(part) or part == part.parent)
    if not above.is_dir():
        raise InvalidInput(option, got=f"{above}, a file", expected="a folder, new or existing")
    try:  # in a temporary folder: two commands may make the same one at once
        with tempfile.TemporaryDirectory(prefix=".torchcloth-", dir=above) as trial:
            (Path(trial) / plain.relative_to(above)).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InvalidInput(
            option,
            got=f"{path}, which cannot be written ({error.strerror})",
            expected="a folder, new or existing, where files can be made",
            remedy="choose another, or change its permissions",
        ) from None
