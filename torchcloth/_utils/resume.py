"""What a search has computed, on disk: a search that was stopped is run again and finds its answers there.

A search is deterministic, so the second run takes the same way, bit by bit, and computes only what the first did not.
That holds for every estimator alike, and there is no state of a search that could be forgotten.
"""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import TypeVar

import torch
from torch import Tensor

from ..errors import InvalidInput
from .files import write_atomically, write_text

STORE_FORMAT_VERSION = 2
MAX_WRITE_ATTEMPTS = 3  # of writing an answer
STAMP_FILE_NAME = "problem"  # file that makes a folder a journal
DAMAGED_FILE_ERRORS = (RuntimeError, KeyError, ValueError, EOFError, OSError, pickle.UnpicklingError)  # torch's, of half a file
T = TypeVar("T", bound=Sequence)


class ResumableStore:
    """Answers by question in a folder, one file each; no other problem's, though one may be at work there as well.

    Args:
        folder: made when the first answer is written; it must be a journal's or not exist.
        problem: what the answers depend on beside the questions: data, model, options.
        resume: take up what the folder holds; False: empty it; None: neither, there must be nothing.

    Raises:
        InvalidInput: nothing to resume, a journal of another problem or program, a folder of other things, or, where
            nothing was said, work that was stopped.
    """

    def __init__(self, folder: str | Path, problem: Sequence[object], resume: bool | None) -> None:
        self.folder, self.key = Path(folder), digest([STORE_FORMAT_VERSION, torch.__version__, source_fingerprint(), *problem])
        self.reused_count = 0
        stamp = self.folder / STAMP_FILE_NAME
        if not resume:
            if resume is None and stamp.exists():
                same = stamp.read_text() == self.key
                raise InvalidInput(
                    "resume",
                    got=f"nothing, and in {self.folder} {'the same' if same else 'other'} work, stopped",
                    expected="--resume, to go on from there, or another folder" if same else "another folder",
                    remedy=f"to start over, delete {self.folder}",
                )
            clear_store(self.folder)
            return
        if not stamp.exists():
            raise InvalidInput(
                "resume",
                got=f"no {self.folder}",
                expected="what an interrupted run left",
                remedy="run it without --resume",
            )
        if stamp.read_text() != self.key:
            raise InvalidInput(
                "resume",
                got=f"{self.folder} of another fit, or of another version of torchcloth",
                expected="the same episodes, parameters, options, causes and program",
                remedy=f"to start over, delete {self.folder}",
            )

    def get_or_compute(self, name: str, inputs: Tensor, compute: Callable[[], T]) -> T:
        """The answer of before, or that of ``work``, which is kept: a tuple of tensors."""
        path = self.folder / f"{name}-{digest([self.key, inputs])}.pt"
        try:
            answer = torch.load(path, weights_only=True)
            self.reused_count += 1
            return answer
        except DAMAGED_FILE_ERRORS:
            answer = compute()
        self._write(path, tuple(answer))
        return answer

    def _write(self, path: Path, answer: tuple) -> None:
        for _ in range(MAX_WRITE_ATTEMPTS):  # another run into this folder that has ended takes it away
            with suppress(FileNotFoundError):
                if not (self.folder / STAMP_FILE_NAME).exists():
                    write_text(self.folder / STAMP_FILE_NAME, self.key)  # several answers may come at once
                with write_atomically(path) as part:
                    torch.save(answer, part)
                return


@cache
def source_fingerprint(*more_folders: Path) -> str:
    """A fingerprint of the sources of the library, and of folders beside: what other code said is no answer."""
    folders = [Path(str(files(name))) for name in ("torchcloth", "torchcloth.robots")]
    parts: list[object] = []
    for folder in (*folders, *more_folders):
        sources = sorted(p for p in folder.rglob("*") if p.suffix in (".py", ".h", ".cpp"))
        parts += [part for p in sources for part in (p.relative_to(folder).as_posix(), p.read_bytes())]
    return digest(parts)


def clear_store(folder: Path) -> None:
    """Remove a journal, if there is one: its stamp last, so that what is left by an interruption is a journal still.

    Raises:
        InvalidInput: a folder of other things.
    """
    if not folder.exists():
        return
    stamp = folder / STAMP_FILE_NAME
    inside = [path for path in folder.iterdir() if path != stamp]
    if not stamp.exists() and any(not path.name.startswith(f".{STAMP_FILE_NAME}.") for path in inside):  # these are half a stamp
        raise InvalidInput("journal", got=f"{folder} with other content", expected="a new folder, or a journal")
    for path in (*inside, stamp):
        path.unlink(missing_ok=True)
    with suppress(OSError):  # another run has written there again, or has cleared it too
        folder.rmdir()


def digest(parts: Sequence[object]) -> str:
    """A fingerprint of tensors and of whatever prints in full."""
    found = hashlib.sha256()
    for part in parts:
        data = part.detach().contiguous().numpy().tobytes() if isinstance(part, Tensor) else repr(part).encode()
        found.update(len(data).to_bytes(8, "little") + data)
    return found.hexdigest()[:24]
